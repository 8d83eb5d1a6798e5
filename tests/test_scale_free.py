"""The same task in other units is the same task for CHDP."""

from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_chdp import CHDP
from tests.algorithms import filled_model
from tests.hybrid_envs import HybridChainEnv, HybridIdentityEnv

UNITS = dict(obs_unit=1000.0, obs_offset=3.0, reward_unit=100.0)


def in_units(env_class: Any, obs_unit=1.0, obs_offset=0.0, reward_unit=1.0):
    """:return: a class of environments with observations (and an offset) and rewards in other units"""

    class InUnits(env_class):
        def __init__(self):
            super().__init__()
            space = self.observation_space
            space.low[:], space.high[:] = -np.inf, np.inf

        def convert(self, obs):
            return (obs_unit * (obs + obs_offset)).astype(np.float32)

        def reset(self, **kwargs):
            obs, info = super().reset(**kwargs)
            return self.convert(obs), info

        def step(self, action):
            # The environment's own reset, where a step ends with one, has converted already
            obs, reward, *end = super().step(action)
            return obs if env_class is HybridIdentityEnv else self.convert(obs), reward_unit * reward, *end

    return InUnits


@pytest.mark.parametrize("env_class", [HybridIdentityEnv, HybridChainEnv])
def test_the_same_actions(env_class):
    """What is done in training, and what the policies draw after it, with the same random numbers."""
    taken, drawn, q_means = [], [], []
    for units in ({}, UNITS):
        env = make_vec_env(in_units(env_class, **units), 4, seed=0)
        model = filled_model(env, n_transitions=80, gamma=0.9)
        model.train(1, 16)
        model.learning_starts = 0
        model.learn(32, reset_num_timesteps=False)
        # Without the returns, which are in the units of the rewards
        taken.append(model.replay_buffer.actions[:28].reshape(112, -1)[:, : model.hybrid_space.columns.action_width])
        obs = model.replay_buffer.observations[:28].reshape(112, -1)
        th.manual_seed(0)
        drawn.append(model.policy.predict_rows(obs))
        model.train(1, 200)
        q_means.append(model.logger.name_to_value["train/q_mean"])
    for first, second in (taken, drawn):
        assert (first[:, 0] == second[:, 0]).mean() > 0.97
        assert (np.abs(first - second).max(axis=1) < 0.05).mean() > 0.95
    assert q_means[1] / UNITS["reward_unit"] == pytest.approx(q_means[0], abs=0.05)


def test_the_task_is_learnt_in_other_units():
    settings = dict(gradient_steps=2, learning_starts=200, gamma=0.0, policy_kwargs=dict(net_arch=[64, 64]), seed=0)
    env_class = in_units(HybridIdentityEnv, **UNITS)
    model = CHDP("MlpPolicy", make_vec_env(env_class, 8, seed=0), **settings).learn(1500)
    env = make_vec_env(env_class, 8, seed=100)
    returns, _ = evaluate_policy(model, env, 200, deterministic=True, return_episode_rewards=True)
    # tests/test_identity.py says what is in reach without learning
    assert np.mean(returns) / UNITS["reward_unit"] > 0.8
