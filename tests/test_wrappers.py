"""Wrappers that give an environment numbers in place of arrays, or flat actions in place of hybrid ones."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sb3_chdp import FlattenHybridAction, ScalarBoxes
from tests.hybrid_envs import LayoutEnv, layouts, make_layout_env


@pytest.mark.parametrize("layout", layouts())
def test_scalar_boxes(layout):
    """Arrays of one element become numbers, all else stays, and the action space is that of the environment."""

    class Recording(LayoutEnv):
        def step(self, action):
            self.action = action
            return super().step(self.action_space.sample())

    def plain(value):
        if isinstance(value, (tuple, list)):
            return [plain(part) for part in value]
        if isinstance(value, dict):
            return {key: plain(part) for key, part in value.items()}
        return np.asarray(value).tolist()

    def unpacked(value):
        """What is expected: lists of one number become the number."""
        if isinstance(value, list) and len(value) == 1 and isinstance(value[0], float):
            return value[0]
        if isinstance(value, list):
            return [unpacked(part) for part in value]
        return {key: unpacked(part) for key, part in value.items()} if isinstance(value, dict) else value

    recording = Recording(layouts()[layout])
    env = ScalarBoxes(recording)
    assert env.action_space == recording.action_space
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(20):
        action = env.action_space.sample()
        env.step(action)
        assert plain(recording.action) == unpacked(plain(action))


@pytest.mark.parametrize("wrapper", [FlattenHybridAction, ScalarBoxes])
def test_wrappers_are_made_again_from_their_spec(wrapper):
    env = wrapper(gym.make("HardMove4-v0"))
    assert isinstance(gym.make(env.spec), wrapper)


def test_flat_actions_are_checked():
    env: Any = FlattenHybridAction(make_layout_env())
    env.reset()
    n = len(env.action_space.sample())
    for action in (np.zeros(n + 1), np.full(n, np.nan)):
        with pytest.raises(ValueError, match="action must be finite and of shape"):
            env.step(action)
