"""Masks of discrete actions that are not allowed now, in sb3-contrib's form."""

from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_chdp.common.rows import in_order, value_groups
from sb3_chdp.common.spaces import HybridActionSpec

# Where an environment may leave the mask of a state that no one can ask it for any more: the last one of an episode
INFO_KEY = "action_masks"


def read_masks(spec: HybridActionSpec, masks: Any, n: int, first: int = 0) -> np.ndarray:
    """
    :param spec: the action space
    :param masks: (n, M) or (M,) booleans, False for what may not be taken: M is the sum of the numbers of values of all
        discrete parts, whose masks follow each other as for sb3-contrib's ``MaskablePPO``, or the number K of discrete
        actions, if these form one index; where both are the same number, it is the first
    :param n: number of environments
    :param first: index of the first of them, for messages
    :return: (n, sum of the radices) booleans for the choices of rows, (n, K) unless the space is factored
    :raises ValueError: for another shape, for what is not booleans, or if nothing is allowed in an environment; the message
        names it
    """
    try:
        given = np.asarray(masks)
    except ValueError as error:
        raise ValueError("action_masks must be one array for each environment: np.concatenate() those of its parts") from error
    if given.dtype != bool:
        if not np.isin(given, (0, 1)).all():
            raise ValueError(f"action_masks must be booleans, True for what may be taken, got {given}")
        given = given.astype(bool)
    array = given.reshape(-1, given.shape[-1]) if given.size and given.ndim else given
    accepted = sorted({spec.n_mask_values, sum(spec.radices)})
    if array.ndim != 2 or len(array) != n or array.shape[1] not in accepted:
        lengths = " or ".join(map(str, accepted))
        hint = "; action_layout='joint' takes that" if array.ndim == 2 and array.shape[1] == spec.n_discrete_actions else ""
        hint = "; flatten it, masks.ravel()" if n == 1 and given.size in accepted else hint
        raise ValueError(
            f"action_masks must be {lengths} booleans for each of {n} environment(s), got shape {given.shape}{hint}"
        )
    if array.shape[1] == spec.n_mask_values:
        array = spec.join_masks(array)
    # A value of every choice
    possible = in_order([array[:, places].max(axis=2) for _, places in value_groups(spec.radices)], spec.radices)
    stuck = (first + np.flatnonzero(~possible.all(axis=1))).tolist()
    if stuck:
        raise ValueError(
            f"action_masks must allow at least one discrete action, and those of environment(s) {stuck} allow none"
        )
    return array


def allowed_now(env: gym.Env, spec: HybridActionSpec) -> np.ndarray | None:
    """
    :param env: a single environment
    :param spec: its action space
    :return: (1, K) booleans, which discrete actions are allowed now; None if it has no ``action_masks()``
    :raises ValueError: see :func:`read_masks`
    """
    if not env.has_wrapper_attr("action_masks"):
        return None
    method = env.get_wrapper_attr("action_masks")
    if not callable(method):
        raise ValueError(f"action_masks must be a method, got {method!r}")
    return read_masks(spec, method(), 1)


def env_masks(spec: HybridActionSpec, env: VecEnv) -> np.ndarray:
    """
    :param spec: the action space
    :param env: environments with ``action_masks()``
    :return: (n_envs, K) booleans, which discrete actions are allowed now
    :raises ValueError: see :func:`read_masks`
    """
    return read_masks(spec, env.env_method("action_masks"), env.num_envs)


def last_masks(
    spec: HybridActionSpec, before: np.ndarray, masks: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]
) -> np.ndarray:
    """
    Masks of the states that a step led to. Where it ended an episode, the environment has been reset, and its mask is lost.

    :param spec: the action space
    :param before: (n_envs, K) masks of the states before the step
    :param masks: (n_envs, K) masks of today's states
    :param dones: (n_envs,) which episodes ended
    :param infos: those of the step
    :return: (n_envs, K) masks, at a time limit ``info["action_masks"]`` if it is there, else the one before; of a terminal
        state none is needed
    :raises ValueError: see :func:`read_masks`
    """
    masks = masks.copy()
    for i in np.flatnonzero(dones).tolist():
        given = infos[i].get(INFO_KEY) if infos[i].get("TimeLimit.truncated", False) else None
        try:
            masks[i] = before[i] if given is None else read_masks(spec, given, 1, first=i)[0]
        except ValueError as error:
            raise ValueError(f"info['action_masks'] of an episode's end: {error}") from error
    return masks
