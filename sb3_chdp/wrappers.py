"""Wrappers that bring hybrid environments to algorithms for flat actions."""

from typing import Any

import gymnasium as gym
import numpy as np

from sb3_chdp.common.hybrid_box import ScoreBox


class FlattenHybridAction(gym.ActionWrapper[np.ndarray, np.ndarray, Any]):
    """
    Let SB3's own algorithms (SAC, TD3, PPO, ...) run on an environment with hybrid actions.

    The action is a vector in [-1, 1]^(K + P): a score for every discrete action, of which the highest is taken, followed by
    the scaled parameters of all actions one after the other (PADDPG, Hausknecht and Stone, 2016).

    :param env: environment with a hybrid action space
    :param action_layout: see :class:`HybridActionSpec`
    """

    def __init__(self, env: gym.Env, action_layout: str = "auto"):
        super().__init__(env)
        self.score_space = ScoreBox(env.action_space, action_layout)
        self.action_space = self.score_space

    def action(self, action: np.ndarray) -> Any:
        """
        :param action: (K + P,) scores and parameters
        :return: the native action
        """
        return self.score_space.to_native(np.asarray(action)[None])[0]
