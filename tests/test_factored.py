"""Several discrete choices with more combinations than can be numbered: a column, a score or an embedding per choice."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from sb3_contrib.common.maskable.evaluation import evaluate_policy as evaluate_masked_policy
from stable_baselines3.common.env_util import make_vec_env
from torch.distributions import Categorical, Normal

from sb3_chdp import HPPO, PATD3, PDQNTD3, FlattenHybridAction, HyARTD3, HybridActionSpec, check_hybrid_env
from sb3_chdp.common.evaluation import evaluate_policy
from sb3_chdp.common.hybrid_box import ConcatenatedBox
from sb3_chdp.common.masks import read_masks
from sb3_chdp.envs.hard_move import motion_table, unit_motions
from sb3_chdp.hppo.distributions import HybridDistribution
from sb3_chdp.hyar_td3.representation import ActionBatch, FactoredActionRepresentation
from tests.algorithms import ALGORITHMS, has_learnt, make_model, snapshot
from tests.hybrid_envs import LayoutEnv, box, gym_make

CLASSES = [algorithm for algorithm in ALGORITHMS if algorithm.takes_factored]
# 2^76 * 5 * 3 * 4 joint actions
HUGE = spaces.Dict(
    {"a": spaces.MultiDiscrete([3, 4]), "b": spaces.MultiBinary(76), "c": spaces.Discrete(5, start=-2), "x": box(-1, 3, 2)}
)


def bits_space(n):
    return spaces.Tuple((spaces.MultiBinary(n), box(-1, 1, 1)))


class FactoredMaskedEnv(LayoutEnv):
    """Allows about half of the values of every choice; any other one is an error."""

    def __init__(self, space=HUGE):
        super().__init__(space)
        self.codec = HybridActionSpec(space)
        self.starts = np.cumsum((0, *self.codec.radices[:-1]))
        self.masks = np.ones(self.codec.n_mask_values, dtype=bool)

    def action_masks(self):
        return self.masks

    def step(self, action):
        values = self.codec.to_row(action)[: len(self.starts)].astype(int)
        if not self.masks[self.starts + values].all():
            raise ValueError(f"{action} is masked")
        self.masks = self.np_random.random(len(self.masks)) < 0.5
        for start, radix in zip(self.starts, self.codec.radices, strict=True):
            self.masks[start + self.np_random.integers(radix)] = True
        return super().step(action)


class BitsEnv(gym.Env):
    """Reward: the share of 11 bits that equal the observed ones, less the distance of the parameter from 0.5."""

    action_space = bits_space(11)
    observation_space = spaces.Box(0.0, 1.0, (11,), dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.bits = self.np_random.integers(2, size=11)
        return self.bits.astype(np.float32), {}

    def step(self, action):
        reward = float((action[0] == self.bits).mean() - abs(float(action[1][0]) - 0.5))
        return self.reset()[0], reward, True, False, {}


@pytest.mark.parametrize(
    "space, layout, radices",
    [
        (bits_space(6), "auto", (64,)),
        (bits_space(7), "auto", (2,) * 7),
        (bits_space(11), "shared", (2,) * 11),
        (bits_space(11), "joint", (2048,)),
        (bits_space(2), "factored", (2, 2)),
        (HUGE, "auto", (3, 4, *(2,) * 76, 5)),
        # A single choice is one index, however many values it has
        (spaces.Tuple((spaces.Discrete(5000), box(0, 1, 1))), "auto", (5000,)),
        (spaces.OneOf([box(0, 1, 1)] * 1500), "auto", (1500,)),
    ],
)
def test_what_is_factored(space, layout, radices):
    spec = HybridActionSpec(space, layout)
    assert spec.radices == radices and spec.is_factored == (len(radices) > 1)
    assert spec.columns.width == len(radices) + spec.max_parameters
    row = spec.sample_rows(np.random.default_rng(0), 1)[0]
    assert (
        space.contains(spec.to_native(row)) and (spec.to_row(spec.to_native(row))[: len(radices)] == row[: len(radices)]).all()
    )


def test_layouts_that_do_not_fit():
    with pytest.raises(ValueError, match="action_layout='factored' needs several discrete parts"):
        HybridActionSpec(spaces.Tuple((spaces.Discrete(3), box(0, 1, 1))), "factored")
    with pytest.raises(ValueError, match=r"131072 joint discrete actions are more than the 65536.*'factored' has no limit"):
        HybridActionSpec(bits_space(17), "joint")
    with pytest.raises(ValueError, match="'factored' does not apply to a OneOf"):
        HybridActionSpec(spaces.OneOf([box(0, 1, 1)] * 2), "factored")
    with pytest.raises(ValueError, match=r"The first 2 columns of a row must be in 0\.\.1, 0\.\.1"):
        HybridActionSpec(bits_space(2), "factored").to_native([0, 2, 0.0])


@pytest.mark.parametrize("algorithm", CLASSES)
@pytest.mark.parametrize("masked", [False, True], ids=["free", "masked"])
def test_training(algorithm, masked, tmp_path):
    """Actions outside of the space and masked ones are errors."""
    env = make_vec_env(FactoredMaskedEnv if masked else lambda: LayoutEnv(HUGE), 4)
    model = make_model(algorithm, env)
    before = snapshot(model)
    model.learn(120)
    assert has_learnt(model, before) and bool(model.use_masking) == masked
    evaluate_policy(model, env, 4, deterministic=False)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=env)
    obs, masks = np.zeros((3, 2), dtype=np.float32), np.ones((3, 164), dtype=bool)
    np.testing.assert_equal(*(m.predict(obs, deterministic=True, action_masks=masks)[0] for m in (model, loaded)))
    loaded.learn(40)


@pytest.mark.parametrize("algorithm", CLASSES)
def test_a_mask_of_one_value_per_choice_decides(algorithm):
    model = make_model(
        algorithm, LayoutEnv(spaces.Tuple((spaces.MultiDiscrete([3, 4]), box(0, 1, 2)))), action_layout="factored"
    )
    masks = np.array([[0, 1, 0, 0, 0, 0, 1], [1, 0, 0, 1, 0, 0, 0]], dtype=bool)
    actions = model.predict(np.zeros((2, 2), dtype=np.float32), action_masks=masks)[0]
    assert [action[0].tolist() for action in actions] == [[1, 3], [0, 0]]
    # The second choice has no value
    with pytest.raises(ValueError, match=r"those of environment\(s\) \[0\] allow none"):
        model.predict(np.zeros((1, 2), dtype=np.float32), action_masks=np.array([[1, 1, 1, 0, 0, 0, 0]]))
    with pytest.raises(ValueError, match=r"7 booleans for each of 1 environment\(s\), got shape \(1, 12\)"):
        model.predict(np.zeros((1, 2), dtype=np.float32), action_masks=np.ones((1, 12)))


def test_an_algorithm_that_needs_one_index():
    with pytest.raises(
        ValueError,
        match=r"PDQNTD3 needs one index for all joint discrete actions.*, such as CHDP",
    ):
        make_model(PDQNTD3, LayoutEnv(bits_space(20)))
    with pytest.raises(ValueError, match="PDQNTD3 needs one index"):
        make_model(PDQNTD3, LayoutEnv(bits_space(3)), action_layout="factored")
    model = make_model(PDQNTD3, LayoutEnv(bits_space(11))).learn(20)
    assert model.hybrid_space.spec.radices == (2048,) and model.action_layout == "auto"


@pytest.mark.parametrize("algorithm", [algorithm for algorithm in CLASSES if algorithm is not HPPO])
def test_buffers_grow_with_the_sum_of_the_radices(algorithm):
    widths = [make_model(algorithm, LayoutEnv(bits_space(n))).replay_buffer.action_dim for n in (20, 40)]
    assert widths[1] - widths[0] <= 40


def test_a_large_buffer_says_what_it_will_take():
    # None of it is used
    with pytest.warns(UserWarning, match=r"will take 1\.2 GB: 1025 numbers for each of buffer_size=300000"):
        make_model(PATD3, LayoutEnv(bits_space(10)), buffer_size=300_000, action_layout="joint")


def test_log_prob_of_several_choices():
    space = ConcatenatedBox(spaces.Tuple((spaces.MultiDiscrete([3, 2, 4]), box(-1, 1, 2))), "factored")
    outputs, log_std = th.randn(5, 9 + 2), th.full((2,), -0.5)
    distribution = HybridDistribution(space).proba_distribution(outputs, log_std)
    rows = distribution.sample()
    log_prob, entropy = distribution.log_prob(rows), distribution.entropy()
    for i, row in enumerate(rows):
        heads = [Categorical(logits=logits) for logits in outputs[i, :9].split([3, 2, 4])]
        expected = sum(head.log_prob(value) for head, value in zip(heads, row[:3], strict=True))
        assert log_prob[i, 0].item() == pytest.approx(expected.item(), abs=1e-5)
        assert log_prob[i, 1].item() == pytest.approx(
            Normal(outputs[i, 9:], log_std.exp()).log_prob(row[3:]).sum().item(), abs=1e-5
        )
        assert entropy[i].item() == pytest.approx(sum(head.entropy() for head in heads).item(), abs=1e-5)
    best = [logits.argmax(dim=1) for logits in outputs[:, :9].split([3, 2, 4], dim=1)]
    assert (distribution.mode()[:, :3] == th.stack(best, dim=1)).all()


def test_pa_td3_sees_a_factored_space_as_the_flattened_environment_does():
    env = FlattenHybridAction(LayoutEnv(HUGE))
    assert env.action_space.shape == make_model(PATD3, LayoutEnv(HUGE)).hybrid_space.shape == (164 + 2,)


def test_embeddings_of_several_choices():
    th.manual_seed(0)
    representation = FactoredActionRepresentation(2, (3, 2, 5), 2, embedding_dim=3, parameter_latent_dim=2, hidden_dim=16)
    # Two dimensions tell three values apart, one two
    assert representation.embedding_dim == 2 + 1 + 3
    k = th.stack([th.randint(n, (40,)) for n in (3, 2, 5)], dim=1)
    embeddings = representation.embed(k)
    assert (representation.nearest_action(embeddings) == k).all()
    parameters = th.rand(40, 2) * 2 - 1
    batch = ActionBatch(th.rand(40, 2), k, parameters, th.rand(40, 2))
    assert representation.decode(batch.features, k, th.zeros(40, 2))[0].shape == (40, 2)
    latents, kept = representation.relabel(batch, th.cat([embeddings, th.zeros(40, 2)], dim=1))
    assert kept[:, 0].all() and th.allclose(latents[:, :6], embeddings)
    # One choice that has drifted leaves the others where they were
    embeddings[:, 2] = -representation.embed(k)[:, 2]
    latents, kept = representation.relabel(batch, th.cat([embeddings, th.zeros(40, 2)], dim=1))
    assert th.allclose(latents[:, [0, 1, 3, 4, 5]], embeddings[:, [0, 1, 3, 4, 5]])


@pytest.mark.parametrize("n", [2, 3, 5, 6, 10, 13, 16])
def test_motions_of_actuators_add_up_to_those_of_subsets(n):
    bits = (np.arange(2**n)[:, None] >> np.arange(n)[::-1]) & 1
    np.testing.assert_allclose(bits @ unit_motions(n), motion_table(n), atol=1e-12)


@pytest.mark.parametrize("n", [4, 10])
def test_factored_hard_move_has_the_same_dynamics(n):
    joint, factored = (gym.make("HardMove-v0", n_actuators=n, factored=f) for f in (False, True))
    rng = np.random.default_rng(0)
    first, second = joint.reset(seed=0)[0], factored.reset(seed=0)[0]
    for _ in range(100):
        np.testing.assert_allclose(first, second, atol=1e-6)
        bits, strength = rng.integers(2, size=n), rng.uniform(-1, 1, 1)
        k = int("".join(map(str, bits)), 2)
        first, *one = joint.step((k, [strength] * 2**n))
        second, *other = factored.step((bits.astype(np.int8), strength.astype(np.float32)))
        assert one[0] == pytest.approx(other[0], abs=1e-6) and one[1:] == other[1:]
        if one[1] or one[2]:
            first, second = joint.reset()[0], factored.reset()[0]


@pytest.mark.parametrize("n", [10, 12, 16, 20])
@pytest.mark.filterwarnings("ignore:.*(infinity|symmetric and normalized|render_mode)")
def test_factored_hard_move_is_registered(n):
    env = gym_make(f"sb3_chdp/FactoredHardMove{n}-v0")
    assert env.action_space[0] == spaces.MultiBinary(n)
    check_hybrid_env(env)
    check_env(env.unwrapped, skip_render_check=True)
    with pytest.raises(ValueError, match="bits"):
        env.step((np.zeros(n - 1, dtype=np.int8), np.zeros(1)))
    with pytest.raises(ValueError, match="action space"):
        env.step((np.zeros(n, dtype=np.int8), np.full(1, np.nan)))
    with pytest.raises(ValueError, match="n_actuators"):
        gym.make("HardMove-v0", n_actuators=17)


def test_factored_masks_are_read_per_choice():
    spec = HybridActionSpec(HUGE)
    assert spec.n_mask_values == 3 + 4 + 152 + 5
    masks = np.ones((2, 164), dtype=bool)
    np.testing.assert_array_equal(read_masks(spec, masks, 2), masks)
    masks[1, 7:9] = False
    with pytest.raises(ValueError, match=r"environment\(s\) \[1\]"):
        read_masks(spec, masks, 2)


@pytest.mark.parametrize("algorithm", CLASSES)
def test_no_algorithm_takes_a_forbidden_value(algorithm):
    env = make_vec_env(lambda: FactoredMaskedEnv(bits_space(12)), 8)
    model = make_model(algorithm, env, **(dict(representation_freq=100) if algorithm is HyARTD3 else {}))
    model.learn(800)
    evaluate_masked_policy(model, env, 20)


def test_hppo_learns_2048_combinations():
    """Chance: half of the bits, and 0.63 away from the best parameter."""
    env = make_vec_env(BitsEnv, 8, seed=0)
    model = make_model(
        HPPO, env, n_steps=64, batch_size=128, n_epochs=5, learning_rate=3e-3, policy_kwargs=dict(net_arch=[64])
    )
    assert model.hybrid_space.spec.is_factored
    assert evaluate_policy(model.learn(8000), env, 100)[0] > 0.7
