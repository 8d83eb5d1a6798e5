"""States of environments beneath Gymnasium's step limit, whose count is part of them."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import TimeLimit

from sb3_chdp.envs.base import HybridEnv


class StatefulTimeLimit(gym.Wrapper[np.ndarray, Any, np.ndarray, Any], RecordConstructorArgs):
    """
    ``get_state`` and ``set_state`` of the environment, with the steps that Gymnasium's ``TimeLimit`` has counted.

    :param env: one of this package's environments, as ``gymnasium.make`` has wrapped it
    """

    def __init__(self, env: gym.Env):
        RecordConstructorArgs.__init__(self)
        super().__init__(env)
        self._limit: TimeLimit | None = None
        while isinstance(env, gym.Wrapper):
            if isinstance(env, TimeLimit):
                self._limit = env
            env = env.env

    @property
    def _simulator(self) -> HybridEnv:
        env = self.env.unwrapped
        assert isinstance(env, HybridEnv)
        return env

    def get_state(self) -> dict[str, Any]:
        """:return: the environment's state, with ``elapsed_steps`` if there is a step limit"""
        state = self._simulator.get_state()
        # Gymnasium has no public name for the count
        return state if self._limit is None else {**state, "elapsed_steps": self._limit._elapsed_steps}

    def set_state(self, state: dict[str, Any]) -> np.ndarray:
        """
        :param state: a result of ``get_state()``, or some of its entries
        :return: the observation there
        :raises ValueError: see the environment's
        """
        state = dict(state)
        elapsed_steps = state.pop("elapsed_steps", None)
        observation = self._simulator.set_state(state)
        if self._limit is not None and elapsed_steps is not None:
            self._limit._elapsed_steps = elapsed_steps
        return observation
