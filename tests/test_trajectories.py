"""What training does where an episode is not played to its end: nothing is learnt from two episodes as if they were one."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.her import HerReplayBuffer

from sb3_chdp import CHDP, HPPO
from tests.algorithms import make_model
from tests.hybrid_envs import UNIT, GoalEnv

KINDS: dict[str, dict[str, Any]] = {
    "single steps": {},
    "three steps": dict(n_steps=3, gamma=1.0),
    "without next observations": dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False)),
}


class CountEnv(gym.Env):
    """Observations are the numbers of the episode and of the step, rewards 1000 times the one plus the other."""

    observation_space = spaces.Box(-1e6, 1e6, (2,))
    action_space = spaces.Tuple((spaces.Discrete(2), UNIT))

    def __init__(self, interrupted_at=0):
        self.episode, self.n_steps, self.interrupted_at = -1, 0, interrupted_at

    def _obs(self):
        return np.array([self.episode, self.t], np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.t = self.episode + 1, 0
        return self._obs(), {}

    def step(self, action):
        self.t, self.n_steps = self.t + 1, self.n_steps + 1
        if self.n_steps == self.interrupted_at:
            raise KeyboardInterrupt
        return self._obs(), 1000.0 * self.episode + self.t, False, self.t == 10, {}


class StopAfter(BaseCallback):
    def __init__(self, n_calls):
        super().__init__()
        self.last = n_calls

    def _on_step(self):
        return self.n_calls < self.last


def stopped(model, tmp_path):
    return model.learn(50, StopAfter(8)).learn(8, reset_num_timesteps=False)


def interrupted(model, tmp_path):
    model.env.envs[0].unwrapped.interrupted_at = 8
    with pytest.raises(KeyboardInterrupt):
        model.learn(50)
    return model.learn(8, reset_num_timesteps=False)


def begun_anew(model, tmp_path):
    return model.learn(7).learn(8)


def loaded(model, tmp_path):
    model.learn(7).save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    other = CHDP.load(tmp_path / "model", model.env.envs[0].unwrapped)
    other.load_replay_buffer(tmp_path / "buffer")
    return other.learn(8, reset_num_timesteps=False)


@pytest.mark.parametrize("go_on", [stopped, interrupted, begun_anew, loaded])
@pytest.mark.parametrize("kind", KINDS)
def test_replay_ends_where_the_environment_was_reset(go_on, kind, tmp_path):
    """The first episode is left after seven of its ten steps."""
    model = go_on(make_model(CHDP, CountEnv(), learning_starts=1000, **KINDS[kind]), tmp_path)
    samples = model.replay_buffer._get_samples(np.arange(15))
    assert samples.observations[6].tolist() == [0, 6] and samples.observations[7].tolist() == [1, 0]
    assert samples.rewards[6] == 7
    if kind == "without next observations":
        assert samples.dones[6] == 1 and samples.dones[5] == 0
    else:
        assert samples.next_observations[6].tolist() == [0, 7] and samples.dones[6] == 0
        assert samples.rewards[4] == (5 + 6 + 7 if kind == "three steps" else 5)


def test_hindsight_stays_within_an_episode():
    model = make_model(
        CHDP, GoalEnv(), "MultiInputPolicy", replay_buffer_class=HerReplayBuffer, learning_starts=1000, buffer_size=100
    )
    model.learn(7).learn(15)
    assert model.replay_buffer.ep_length[:17, 0].tolist() == [7] * 7 + [10] * 10


def test_hppo_goes_on_with_a_new_episode():
    model = make_model(HPPO, CountEnv()).learn(100, StopTrainingOnMaxEpisodes(1)).learn(10, reset_num_timesteps=False)
    episodes, steps = model.rollout_buffer.observations.reshape(10, 2).T
    assert (episodes == episodes[0]).all() and steps.tolist() == list(range(10))
    assert model.rollout_buffer.episode_starts.flatten().tolist() == [1] + [0] * 9
