"""Checks of arguments and data, whose errors name what was given and what is accepted."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_chdp.common.arguments import constructor_defaults
from sb3_chdp.common.space_tree import leaves_of

# What gymnasium.wrappers.FlattenObservation makes a vector of
FLATTENABLE = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary, spaces.Text, spaces.OneOf)
# Numbers that are learnt from: a thousand of them add up to 1e18, whose square float32 still holds. Losses and optimizers
# compute such squares; beyond them they put out infinity, or learn nothing
LARGEST = 1e15


def check_numbers(name: str, value: Any, first_env: int = 0) -> None:
    """
    :param name: what the value is, for the message
    :param value: array, or dict of arrays: observations or rewards of a vectorised environment
    :param first_env: index of the environment that the first entry is from
    :raises ValueError: if an array holds NaN, infinity or a number beyond ``LARGEST``; the message names the environments
        concerned
    """
    if isinstance(value, dict):
        for key, part in value.items():
            check_numbers(f"{name}[{key!r}]", part, first_env)
        return
    if value.dtype.kind == "f":
        # The cheapest test: NaN, infinity and numbers that are too large show in the sum of squares
        if float(np.vdot(value, value)) <= LARGEST**2:
            return
    elif value.dtype.kind not in "iu" or value.dtype.itemsize < 8:
        return  # cannot be that large
    usable = np.abs(value.astype(np.float64)) <= LARGEST
    if not usable.all():
        bad = np.flatnonzero(~usable.reshape(len(value), -1).all(axis=1))
        raise ValueError(
            f"{name} must be finite and between {-LARGEST:.0e} and {LARGEST:.0e}, got NaN, inf or more from environment(s) "
            f"{(first_env + bad).tolist()}: {value[bad]}"
        )


def check_is_env(env: Any) -> None:
    """
    :param env: argument of an algorithm
    :raises ValueError: if it is no environment
    """
    if isinstance(env, type):
        raise ValueError(f"env must be an environment, got the class {env.__name__}: give an object of it, {env.__name__}()")
    if isinstance(env, gym.vector.VectorEnv):
        raise ValueError(f"env must be a VecEnv of SB3's, as make_vec_env() returns it, got Gymnasium's {type(env).__name__}")
    if not hasattr(env, "observation_space"):
        raise ValueError(f"env must be an environment of Gymnasium's, a VecEnv of SB3's, or an id, got {env!r}")


def _shapes(space: spaces.Space[Any]) -> Any:
    return {key: part.shape for key, part in space.items()} if isinstance(space, spaces.Dict) else space.shape


def check_replayed_observations(env: VecEnv | None) -> None:
    """
    :param env: the environment of an algorithm with a replay buffer
    :raises ValueError: if observations get another shape around ``VecNormalize``, which hands what it got to the buffer
    """
    normalize = None if env is None else unwrap_vec_normalize(env)
    if env is None or normalize is None:
        return
    inside, outside = _shapes(normalize.observation_space), _shapes(env.observation_space)
    if inside != outside:
        raise ValueError(
            "env must have VecNormalize around all that reshapes observations, as VecNormalize(VecTransposeImage(env)) has, "
            f"so that the replay buffer gets what the policy does, got shapes {inside} in VecNormalize and {outside} around it"
        )


def check_observation_space(space: spaces.Space[Any]) -> None:
    """
    :param space: the observation space of an environment
    :raises ValueError: if SB3's policies cannot read its observations; the message says how they can
    """
    parts = {f"observation_space[{key!r}]": part for key, part in space.items()} if isinstance(space, spaces.Dict) else None
    for name, part in (parts or {"observation_space": space}).items():
        is_flat = isinstance(part, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary))
        if isinstance(part, spaces.Box) and 0 in part.shape:
            raise ValueError(f"{name} is {part}, which has no elements: leave it out")
        if isinstance(part, spaces.Box) and part.shape == ():
            raise ValueError(f"{name} is {part}, a number: make it an array, of the shape (1,)")
        starts_elsewhere = np.any(getattr(part, "start", 0))
        if is_flat and not starts_elsewhere and not (isinstance(part, spaces.MultiDiscrete) and len(part.shape) > 1):
            continue
        remedy = (
            "flatten the observations to one vector with gymnasium.wrappers.FlattenObservation(env)"
            if all(isinstance(leaf, FLATTENABLE) for _, leaf in leaves_of(space))
            else "give the observations a fixed size, for example by padding them to a Box"
        )
        what = f"{part}" if starts_elsewhere else f"a {type(part).__name__}"
        raise ValueError(
            f"{name} is {what}, but SB3's policies read Box, Discrete, MultiDiscrete (of one dimension) and MultiBinary, the "
            f"discrete ones from 0 on, and a Dict of these; {remedy}"
        )


def check_policy_kwargs(policy_class: type, policy_kwargs: dict[str, Any]) -> None:
    """
    :raises ValueError: if the policy has no such argument, where the message lists those it has, and for the name of a class
    """
    if not isinstance(policy_kwargs, dict):
        raise ValueError(f"policy_kwargs must be a dict, or None, got {policy_kwargs!r}")
    accepted = {*constructor_defaults(policy_class)} - {"observation_space", "action_space", "lr_schedule", "self"}
    unknown = set(policy_kwargs) - accepted
    if unknown:
        raise ValueError(
            f"policy_kwargs has unknown key(s) {sorted(unknown)}; {policy_class.__name__} accepts {sorted(accepted)}"
        )
    for name, value in policy_kwargs.items():
        if name.endswith(("_fn", "_class")) and not callable(value):
            raise ValueError(f"policy_kwargs[{name!r}] must be a class, got {value!r}")
