"""Wrappers that bring hybrid environments and algorithms together."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces

from sb3_chdp.common.hybrid_box import ScoreBox
from sb3_chdp.common.masks import allowed_now


class FlattenHybridAction(gym.ActionWrapper[np.ndarray, np.ndarray, Any], gym.utils.RecordConstructorArgs):
    """
    Let SB3's own algorithms (SAC, TD3, PPO, ...) run on an environment with hybrid actions.

    The action is a vector in [-1, 1]^(K + P): a score for every discrete action, of which the highest is taken, in a factored
    space for every value of each choice, followed by the scaled parameters of all actions one after the other (PADDPG,
    Hausknecht and Stone, 2016). If the environment has ``action_masks()``, the highest score of an allowed action counts.

    :param env: environment with a hybrid action space
    :param action_layout: see :class:`HybridActionSpec`
    """

    def __init__(self, env: gym.Env, action_layout: str = "auto"):
        gym.utils.RecordConstructorArgs.__init__(self, action_layout=action_layout)
        gym.ActionWrapper.__init__(self, env)
        self.score_space = ScoreBox(env.action_space, action_layout)
        self.action_space = self.score_space

    def action(self, action: np.ndarray) -> Any:
        """
        :param action: (K + P,) scores and parameters
        :return: the native action
        :raises ValueError: for another shape, NaN or infinity
        """
        row = np.asarray(action)[None]
        if row.shape[1:] != self.action_space.shape or not np.isfinite(row).all():
            raise ValueError(f"action must be finite and of shape {self.action_space.shape}, got {action}")
        masks = allowed_now(self.env, self.score_space.spec)
        if masks is not None:
            row = self.score_space.mask_scores(th.as_tensor(row), th.as_tensor(masks)).numpy()
        return self.score_space.to_native(row)[0]

    def compute_reward(self, *args: Any) -> Any:
        """:return: that of the environment, see :class:`stable_baselines3.her.HerReplayBuffer`"""
        return self.env.get_wrapper_attr("compute_reward")(*args)


class ScalarBoxes(gym.ActionWrapper[Any, Any, Any], gym.utils.RecordConstructorArgs):
    """
    For environments whose ``step`` wants a number where their action space says ``Box`` of one element.

    The action space stays as it is. On the way to the environment, every array of a box with one element becomes a
    Python number, also inside ``Tuple``, ``Dict`` and ``OneOf``.

    :param env: environment with a hybrid action space
    """

    def __init__(self, env: gym.Env):
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.ActionWrapper.__init__(self, env)

    def action(self, action: Any) -> Any:
        """
        :param action: an action of the action space
        :return: the same with numbers in place of arrays with one element
        """
        return with_scalars(self.action_space, action)


def with_scalars(space: spaces.Space[Any], action: Any) -> Any:
    """
    :param space: an action space, or a part of one
    :param action: an action of it
    :return: the same with numbers in place of the arrays of boxes with one element
    """
    if isinstance(space, spaces.Tuple):
        return tuple(with_scalars(part, value) for part, value in zip(space.spaces, action, strict=True))
    if isinstance(space, spaces.Dict):
        return {key: with_scalars(part, action[key]) for key, part in space.spaces.items()}
    if isinstance(space, spaces.OneOf):
        return action[0], with_scalars(space.spaces[int(action[0])], action[1])
    return np.asarray(action).item() if isinstance(space, spaces.Box) and np.prod(space.shape) == 1 else action
