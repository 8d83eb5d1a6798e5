"""Environments that forbid discrete actions, by ``action_masks()``: every algorithm obeys."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib.common.maskable.callbacks import MaskableEvalCallback
from sb3_contrib.common.maskable.evaluation import evaluate_policy as evaluate_masked_policy
from stable_baselines3 import SAC
from stable_baselines3.common import callbacks
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy as evaluate_free_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_chdp import ALGORITHMS as REGISTRY
from sb3_chdp import HHQNTD3, HPPO, PATD3, PDQNTD3, FlattenHybridAction, HyARTD3, HybridActionSpec
from sb3_chdp.common.evaluation import evaluate_policy
from sb3_chdp.common.masks import read_masks
from sb3_chdp.common.utils import nearest_row
from tests.algorithms import fast_model, has_learnt, make_model, sample, snapshot
from tests.hybrid_envs import FewValidEnv, LayoutEnv, MaskedEnv, box, layouts, make_layout_env

CLASSES = [pytest.param(line.load_class(), id=name) for name, line in REGISTRY.items()]
TD3_BASED = [PATD3, HHQNTD3, PDQNTD3, HyARTD3]


@pytest.mark.parametrize("algorithm", CLASSES)
@pytest.mark.parametrize("layout", ["nested", "product"])
def test_no_algorithm_takes_a_forbidden_action(algorithm, layout):
    """The environment raises: in the warm-up, while exploring, acting and being evaluated, alone or by a callback."""
    env = make_vec_env(lambda: MaskedEnv(layout), 8)
    # HyAR's representation costs the most
    model = make_model(algorithm, env, **(dict(representation_freq=100) if algorithm is HyARTD3 else {}))
    assert model.use_masking
    before = snapshot(model)
    callback = MaskableEvalCallback(make_vec_env(lambda: MaskedEnv(layout), 1), n_eval_episodes=2, eval_freq=100, verbose=0)
    model.learn(1600, callback=callback)
    assert has_learnt(model, before)
    for deterministic in (False, True):
        evaluate_masked_policy(model, env, 20, deterministic=deterministic)


@pytest.mark.parametrize("algorithm", CLASSES)
def test_as_many_joint_actions_as_values_of_parts(algorithm):
    """Of 2 x 2: which of the forms a mask of four has cannot be told from its length."""

    class SwitchesEnv(LayoutEnv):
        def action_masks(self):
            return self.masks

        def _draw(self):
            # What one of the switches is to be
            self.masks = np.ones(4, dtype=bool)
            self.masks[self.np_random.integers(4)] = False

        def reset(self, **kwargs):
            outcome = super().reset(**kwargs)
            self._draw()
            return outcome

        def step(self, action):
            assert self.masks[[action[0][0], 2 + action[0][1]]].all(), f"{action} is masked"
            outcome = super().step(action)
            self._draw()
            return outcome

    env = make_vec_env(lambda: SwitchesEnv(spaces.Tuple((spaces.MultiDiscrete([2, 2]), box(-1, 1, 1)))), 2)
    model = make_model(algorithm, env).learn(80)
    evaluate_masked_policy(model, env, 4, deterministic=False)


@pytest.mark.parametrize("algorithm", CLASSES)
def test_predictions(algorithm, tmp_path):
    env = make_vec_env(MaskedEnv, 2)
    model = make_model(algorithm, env)
    obs, masks = np.random.default_rng(0).random((30, 3), dtype=np.float32), np.eye(3, dtype=bool)[np.arange(30) % 3]
    for deterministic in (False, True):
        actions, _ = model.predict(obs, deterministic=deterministic, action_masks=masks)
        assert [int(action[0]) for action in actions] == [i % 3 for i in range(30)]
    action, _ = model.predict(obs[0], action_masks=masks[1])
    assert action[0] == 1
    # A mask of everything changes nothing
    th.manual_seed(0)
    free = model.predict(obs, deterministic=True)[0]
    np.testing.assert_equal(model.predict(obs, deterministic=True, action_masks=np.ones((30, 3), dtype=bool))[0], free)
    with pytest.raises(ValueError, match=r"at least one discrete action, and those of environment\(s\) \[4\] allow none"):
        model.predict(obs, action_masks=masks & (np.arange(30) != 4)[:, None])
    with pytest.raises(ValueError, match=r"3 booleans for each of 30 environment\(s\), got shape \(30, 2\)"):
        model.predict(obs, action_masks=masks[:, :2])
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=env)
    assert loaded.use_masking and algorithm.load(tmp_path / "model", env=env, use_masking=None).use_masking
    loaded.learn(60)


@pytest.mark.parametrize("algorithm", CLASSES)
def test_masks_can_be_ignored_and_must_be_there(algorithm):
    assert not make_model(algorithm, MaskedEnv(), use_masking=False).use_masking
    assert not make_model(algorithm, make_layout_env()).use_masking
    with pytest.raises(ValueError, match="use_masking is True but the environment has no method action_masks"):
        make_model(algorithm, make_layout_env(), use_masking=True).learn(10)


def test_own_n_step_buffers_have_to_tell_of_the_last_state():
    class OwnBuffer(NStepReplayBuffer):
        pass

    settings = dict(replay_buffer_class=OwnBuffer, replay_buffer_kwargs=dict(n_steps=2, gamma=0.9))
    with pytest.raises(ValueError, match=r"replay_buffer_class must be derived from HybridNStepReplayBuffer .* got <class"):
        make_model(PDQNTD3, MaskedEnv("nested"), **settings)
    make_model(PDQNTD3, make_layout_env(), **settings)


@pytest.mark.parametrize("algorithm", CLASSES)
def test_an_environment_that_allows_nothing(algorithm):
    class StuckEnv(MaskedEnv):
        def _draw(self):
            obs = super()._draw()
            self.masks = self.masks & (self.t < 5)
            return obs

    env = DummyVecEnv([MaskedEnv, StuckEnv])
    with pytest.raises(ValueError, match=r"those of environment\(s\) \[1\] allow none"):
        make_model(algorithm, env).learn(60)


@pytest.mark.parametrize("algorithm", CLASSES)
def test_a_game_that_is_over_allows_nothing(algorithm):
    class GameEnv(MaskedEnv):
        def step(self, action):
            obs, reward, *_, info = super().step(action)
            over = self.t % 5 == 0
            return obs, reward, over, False, {**info, "action_masks": self.masks & (not over)}

    make_model(algorithm, make_vec_env(GameEnv, 2)).learn(60)


def test_trained_with_masks_and_then_without(tmp_path):
    make_model(PATD3, MaskedEnv(), n_steps=3).learn(40).save(tmp_path / "model")
    env = LayoutEnv(layouts()["nested"], MaskedEnv().observation_space)
    loaded = PATD3.load(tmp_path / "model", env=env, use_masking=False).learn(40)
    assert isinstance(loaded.replay_buffer, NStepReplayBuffer) and loaded.replay_buffer.n_steps == 3


@pytest.mark.parametrize("algorithm", CLASSES)
def test_made_without_masks_and_then_with(algorithm, tmp_path):
    free = LayoutEnv(layouts()["nested"], MaskedEnv().observation_space)
    model = make_model(algorithm, free)
    model.save(tmp_path / "model")
    assert algorithm.load(tmp_path / "model", env=MaskedEnv()).use_masking
    model.set_env(free)
    model.learn(10)
    model.set_env(MaskedEnv())
    with pytest.warns(UserWarning, match=r"has action_masks\(\), .* forbidden actions are taken"), pytest.raises(ValueError):
        model.learn(60)


def test_n_step_returns_of_dict_observations_are_refused():
    class DictEnv(MaskedEnv):
        def __init__(self):
            super().__init__()
            self.observation_space = spaces.Dict({"mask": self.observation_space})

    with pytest.raises(AssertionError, match="N-step returns are not supported for Dict"):
        make_model(PATD3, DictEnv(), "MultiInputPolicy", n_steps=3)


@pytest.mark.parametrize("n_steps, explicit", [(1, False), (3, False), (3, True)])
@pytest.mark.parametrize("tells_last", [False, True])
def test_buffers_hold_the_masks_of_both_states(n_steps, explicit, tells_last):
    """Observations show the masks that belong to them."""
    env = make_vec_env(lambda: MaskedEnv("nested", tells_last), 3, seed=0)
    kwargs = dict(n_steps=n_steps)
    if explicit:
        kwargs = dict(replay_buffer_class=NStepReplayBuffer, replay_buffer_kwargs=dict(n_steps=n_steps, gamma=0.99))
    model = make_model(PATD3, env, buffer_size=300, **kwargs).learn(600)
    data = sample(model, 2000)
    assert (data.masks == data.observations.bool()).all()
    ends_right = (data.next_masks == data.next_observations.bool()).all(dim=1)
    # Of ten states of an episode the last is followed by another one's first
    assert ends_right.all() if tells_last else 0.05 * n_steps < (~ends_right).float().mean() < 0.15 * n_steps
    assert data.next_masks.any(dim=1).all()


@pytest.mark.parametrize("algorithm", TD3_BASED)
def test_targets_and_improvement_are_of_allowed_actions(algorithm):
    """What the critics of other actions say makes no difference."""
    model = make_model(algorithm, make_vec_env(MaskedEnv, 2), target_policy_noise=0.0).learn(100)
    obs, masks = th.rand(60, 3), th.eye(3, dtype=th.bool)[th.arange(60) % 3]
    outputs = model.policy.actor_outputs(model.actor, obs, masks)
    columns = model.hybrid_space.columns
    if algorithm is PDQNTD3:
        with th.no_grad():
            q1, q2 = model.critic_target(model.critic_target.features(obs), model.actor_target(obs))
        expected = th.min(q1, q2)[masks]
        th.testing.assert_close(model._next_q_values(obs, masks)[:, 0], expected)
    else:
        decoded = (
            model.policy.representation.nearest_action(outputs[:, :3])
            if algorithm is HyARTD3
            else columns.discrete_actions(outputs)
        )
        assert decoded.tolist() == [i % 3 for i in range(60)]
        outputs.sum().backward()
        assert any(p.grad is not None and p.grad.abs().sum() > 0 for p in model.actor.parameters())


def test_masks_of_parts_and_of_joint_actions():
    spec = HybridActionSpec(layouts()["product"])  # 2 x 2 x 2 values
    parts = np.array([[1, 0, 1, 1, 0, 1], [1, 1, 1, 1, 1, 1]], dtype=bool)
    joint = read_masks(spec, parts, 2)
    values = [spec.to_native([k, 0, 0]) for k in range(8)]
    expected = [(v["a"][0] == 0) and (v["b"][0] == 1) for v in values]
    assert joint[0].tolist() == expected and joint[1].all()
    np.testing.assert_array_equal(read_masks(spec, joint, 2), joint)
    np.testing.assert_array_equal(read_masks(spec, joint[0], 1), joint[:1])
    with pytest.raises(ValueError, match=r"6 or 8 booleans for each of 2 environment\(s\), got shape \(2, 7\)"):
        read_masks(spec, np.ones((2, 7), dtype=bool), 2)
    with pytest.raises(ValueError, match=r"environment\(s\) \[1\]"):
        read_masks(spec, np.array([[1, 1, 1, 1, 1, 1], [1, 1, 0, 0, 1, 1]]), 2)
    assert (read_masks(spec, [[1.0] * 6, [1.0, 0.0] * 3], 2) == read_masks(spec, [[1] * 6, [1, 0] * 3], 2)).all()
    # Logits, say: -inf would count as True
    with pytest.raises(ValueError, match="must be booleans, True for what may be taken"):
        read_masks(spec, [0, -np.inf, 0, 0, 0, 0], 1)
    with pytest.raises(ValueError, match=r"np.concatenate\(\) those of its parts"):
        read_masks(spec, [([True, True], [True, True, True])], 1)
    # Where both forms have the same length, it is that of parts
    spec = HybridActionSpec(spaces.Tuple((spaces.MultiDiscrete([2, 2]), box(0, 1, 1))))
    assert read_masks(spec, np.array([1, 0, 0, 1]), 1).tolist() == [[False, True, False, False]]
    # A factored space has no place for a mask of joint actions
    bits = spaces.Tuple((spaces.MultiBinary(7), box(0, 1, 1)))
    with pytest.raises(ValueError, match=r"14 booleans .* got shape \(128,\); action_layout='joint' takes that"):
        read_masks(HybridActionSpec(bits), np.ones(128, dtype=bool), 1)
    assert read_masks(HybridActionSpec(bits, "joint"), np.ones(128, dtype=bool), 1).all()


def test_masks_that_are_no_vector():
    spec = HybridActionSpec(layouts()["product"])
    with pytest.raises(ValueError, match=r"got shape \(3, 2\); flatten it, masks.ravel\(\)"):
        read_masks(spec, np.ones((3, 2), dtype=bool), 1)


def test_nearest_allowed_row():
    points, table = th.randn(200, 3), th.randn(40, 3)
    masks = th.rand(200, 40) < 0.2
    masks[:, 7] = True
    distances = th.cdist(points, table).masked_fill(~masks, th.inf)
    assert (nearest_row(points, table, masks) == distances.argmin(dim=1)).all()


def test_evaluation_knows_masks_where_there_are_any():
    masked, free = make_vec_env(MaskedEnv, 1), make_vec_env(make_layout_env, 1)
    evaluate_policy(make_model(PATD3, masked), masked, 20)
    with pytest.raises(ValueError, match="masked"), pytest.warns(UserWarning, match="Without action_masks predict"):
        evaluate_free_policy(make_model(PATD3, masked), masked, 20)
    assert len(evaluate_policy(make_model(PATD3, free), free, 2)) == 2


def test_hppo_learns_faster_from_masks_than_from_a_penalty():
    returns = {}
    for with_masks in (True, False):
        env = make_vec_env(lambda w=with_masks: FewValidEnv(w), 4, seed=0)
        model = make_model(
            HPPO, env, n_steps=64, batch_size=64, n_epochs=5, learning_rate=3e-3, policy_kwargs=dict(net_arch=[32])
        )
        model.learn(1000)
        returns[with_masks] = evaluate_policy(model, env, 200)[0]
    assert returns[True] > 0.9
    assert returns[False] < returns[True] - 0.2


@pytest.mark.slow
def test_chdp_learns_faster_from_masks_than_from_a_penalty():
    returns = {}
    for with_masks in (True, False):
        env = make_vec_env(lambda w=with_masks: FewValidEnv(w), 4, seed=0)
        model = fast_model(env=env, gradient_steps=2).learn(1200)
        returns[with_masks] = evaluate_policy(model, env, 200)[0]
    # Chance among the four that are allowed: 0.25
    assert returns[True] > 0.9
    assert returns[False] < returns[True] - 0.5


@pytest.mark.parametrize("layout", ["nested", "product"])
def test_stock_algorithms_take_allowed_actions(layout):
    """Of the flat scores those of allowed actions count: the environment raises for others."""
    SAC("MlpPolicy", FlattenHybridAction(MaskedEnv(layout)), learning_starts=10, batch_size=8).learn(60)


def test_parameters_of_allowed_actions_are_improved():
    model = fast_model(env=make_vec_env(MaskedEnv, 2)).learn(60)
    batch = sample(model, 64)
    _, k = model._actions_to_improve(batch, model.critic.features(batch.observations).detach())
    assert batch.masks[th.arange(64), k].all()


def test_rl_zoo3_looks_at_an_allowed_action():
    zoo = pytest.importorskip("sb3_chdp.zoo", exc_type=ImportError)
    for seed in range(20):
        env = MaskedEnv()
        env.reset(seed=seed)
        env.step(zoo.random_action(env, HybridActionSpec(env.action_space), np.random.default_rng(0)))


def test_rl_zoo3_evaluates_with_masks(monkeypatch):
    """Its evaluations are those of SB3's callback, which hands no masks to ``predict``."""
    zoo = pytest.importorskip("sb3_chdp.zoo", exc_type=ImportError)
    monkeypatch.setattr(callbacks, "evaluate_policy", evaluate_free_policy)  # another test may have registered
    model = make_model(PATD3, make_vec_env(MaskedEnv, 1))
    callback = callbacks.EvalCallback(make_vec_env(MaskedEnv, 1), n_eval_episodes=5, eval_freq=10, verbose=0)
    with pytest.raises(ValueError, match="masked"):
        model.learn(40, callback=callback)
    zoo.register()
    model.learn(40, callback=callback)
