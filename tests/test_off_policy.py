"""What all off-policy algorithms must get right, whatever their actors look like."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize

from sb3_chdp import CHDP
from tests.algorithms import OFF_POLICY_ALGORITHMS, make_model
from tests.hybrid_envs import LayoutEnv, layouts, make_layout_env


def test_deterministic_predictions_repeat(algorithm):
    model = make_model(algorithm, make_layout_env()).learn(20)
    obs = np.random.default_rng(0).uniform(-1, 1, (10, 2)).astype(np.float32)
    np.testing.assert_equal(model.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])


def test_twin_critics_are_independent(off_policy_algorithm):
    model = make_model(off_policy_algorithm, make_layout_env())
    q1, q2 = model.critic.q_networks
    assert not {id(p) for p in q1.parameters()} & {id(p) for p in q2.parameters()}
    for p, q in zip(q1.parameters(), q2.parameters(), strict=True):
        assert p.ndim == 1 or (p != q).any()
    before = [p.clone() for p in model.critic.parameters()]
    model.learn(20)
    assert all((p != q).any() for p, q in zip(model.critic.parameters(), before, strict=True))


def test_every_target_moves(off_policy_algorithm):
    model = make_model(off_policy_algorithm, make_layout_env()).learn(20)
    before = {name: p.clone() for name, p in model.policy.named_parameters() if "target" in name}
    assert {name.split(".")[0] for name in before} == {"actor_target", "critic_target"}
    model.train(2, 16)
    moved = {name for name, p in model.policy.named_parameters() if name in before and (p != before[name]).any()}
    # Only the codewords that a batch uses learn
    assert moved | {"actor_target.codebook.codewords"} == set(before) | {"actor_target.codebook.codewords"}


def test_the_actor_step_leaves_the_critic_alone(off_policy_algorithm):
    critics = []
    for policy_delay in (1, 10**9):
        model = make_model(off_policy_algorithm, make_layout_env(), policy_delay=policy_delay, gradient_steps=0).learn(20)
        th.manual_seed(1)
        np.random.seed(1)
        model.train(1, 16)
        critics.append([p.detach() for p in model.critic.parameters()])
    assert all(th.equal(p, q) for p, q in zip(*critics, strict=True))


def test_time_limits_bootstrap(off_policy_algorithm):
    """Every episode of the environment ends by truncation."""
    model = make_model(off_policy_algorithm, make_layout_env()).learn(45)
    assert model.replay_buffer.dones.sum() == 4
    assert not model.replay_buffer.sample(200).dones.any()


@pytest.mark.parametrize("noise, expected", [(0.2, (0.2, 0.2, 0.2)), (LinearSchedule(0.9, 0.1, 0.5), (0.9, 0.5, 0.1))])
@pytest.mark.parametrize("name", [algorithm.__name__ for algorithm in OFF_POLICY_ALGORITHMS if algorithm is not CHDP])
def test_exploration_noise_schedule(name, noise, expected, tmp_path):
    algorithm = next(algorithm for algorithm in OFF_POLICY_ALGORITHMS if algorithm.__name__ == name)
    make_model(algorithm, make_layout_env(), exploration_noise=noise).save(tmp_path / "model")
    model: Any = algorithm.load(tmp_path / "model")
    for progress, std in zip((1.0, 0.75, 0.2), expected, strict=True):
        assert model.exploration_noise_schedule(progress) == pytest.approx(std)


@pytest.mark.parametrize("name", [algorithm.__name__ for algorithm in OFF_POLICY_ALGORITHMS if algorithm is not CHDP])
def test_exploration_noise_reaches_the_actions(name):
    algorithm = next(algorithm for algorithm in OFF_POLICY_ALGORITHMS if algorithm.__name__ == name)
    model = make_model(
        algorithm, make_layout_env(), exploration_noise=0.2, exploration_initial_eps=0, exploration_final_eps=0,
        learning_starts=0, gradient_steps=0,
    ).learn(300)  # fmt: skip
    buffer, columns = model.replay_buffer, model.hybrid_space.columns
    done, meant = buffer.actions[:300, 0], model.policy.predict_rows(buffer.observations[:300, 0])
    # What the actor puts out
    part = next(part for part in ("latents", "scores", "parameters") if part in columns)
    noise = columns.view(done, part) - columns.view(meant, part)
    np.testing.assert_allclose(noise.std(axis=0), 0.2, rtol=0.2)


@pytest.mark.parametrize("n_envs", [1, 3])
def test_action_noise_of_the_user(off_policy_algorithm, n_envs):
    env = make_vec_env(make_layout_env, n_envs)
    size = make_model(off_policy_algorithm, env).policy.noise_dim
    noise = NormalActionNoise(np.zeros(size), np.full(size, 0.3))
    make_model(off_policy_algorithm, env, action_noise=noise).learn(30)
    wrong = NormalActionNoise(np.zeros(size + 1), np.full(size + 1, 0.3))
    model = make_model(off_policy_algorithm, env, action_noise=wrong)
    with pytest.raises(ValueError, match=f"action_noise must have size {size} per environment"):
        model.learn(30)


@pytest.mark.parametrize(
    "space", [spaces.Box(0, 199, (2,), np.int32), spaces.Box(0, 255, (2,), np.uint8), spaces.Discrete(50)], ids=str
)
@pytest.mark.parametrize("in_dict", [False, True])
def test_last_states_behind_normalization_are_the_originals(off_policy_algorithm, space, in_dict):
    class Counter(LayoutEnv):
        """The observation is the number of all steps so far."""

        n = 0

        def __init__(self):
            super().__init__(layouts()["shared"], spaces.Dict({"n": space}) if in_dict else space)

        def _obs(self):
            obs = np.full(space.shape, self.n, space.dtype) if space.shape else np.int64(self.n)
            return {"n": obs} if in_dict else obs

        def reset(self, **kwargs):
            return self._obs(), super().reset(**kwargs)[1]

        def step(self, action):
            rest = super().step(action)[1:]
            self.n += 1
            return self._obs(), *rest

    env = VecNormalize(make_vec_env(Counter, 1), norm_obs=bool(space.shape))
    policy = "MultiInputPolicy" if in_dict else "MlpPolicy"
    buffer = make_model(off_policy_algorithm, env, policy).learn(45).replay_buffer
    stored, following = (part["n"] if in_dict else part for part in (buffer.observations, buffer.next_observations))
    for part, first in ((stored, 0), (following, 1)):
        np.testing.assert_array_equal(part[:45].reshape(45, -1)[:, 0], np.arange(first, 45 + first))
