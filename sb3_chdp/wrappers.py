"""Wrappers that bring hybrid environments to algorithms for flat actions."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_chdp.common.spaces import HybridActionSpec


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
        self.spec_of_action = HybridActionSpec(env.action_space, action_layout)
        size = self.spec_of_action.n_discrete_actions + self.spec_of_action.n_parameters
        self.action_space = spaces.Box(-1.0, 1.0, (size,), dtype=np.float32)

    def action(self, action: np.ndarray) -> Any:
        """
        :param action: (K + P,) scores and parameters
        :return: the native action
        """
        spec = self.spec_of_action
        scores, parameters = np.split(np.asarray(action), [spec.n_discrete_actions])
        k = int(scores.argmax())
        return spec.to_native(np.concatenate([[k], parameters[spec.parameter_index[k]]]))
