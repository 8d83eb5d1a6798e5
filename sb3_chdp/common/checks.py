"""Checks of arguments and data, whose errors name what was given and what is accepted."""

import inspect
from collections.abc import Collection
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_chdp.common.space_tree import leaves_of

# What gymnasium.wrappers.FlattenObservation makes a vector of
FLATTENABLE = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary, spaces.Text, spaces.OneOf)


def check_at_least(least: int, **arguments: int) -> None:
    """
    :param least: smallest value that is accepted
    :param arguments: values by name
    :raises ValueError: for the first one that is below
    """
    for name, value in arguments.items():
        if value < least:
            raise ValueError(f"{name} must be at least {least}, got {value}")


def check_fraction(**arguments: float) -> None:
    """
    :param arguments: values by name
    :raises ValueError: for the first one that is not between 0 and 1
    """
    for name, value in arguments.items():
        if not 0 <= value <= 1:
            raise ValueError(f"{name} must be between 0 and 1, got {value}")


def check_one_of(accepted: Collection[str], **arguments: str) -> None:
    """
    :param accepted: the values that are accepted
    :param arguments: values by name
    :raises ValueError: for the first one that is none of them
    """
    for name, value in arguments.items():
        if value not in accepted:
            raise ValueError(f"{name} must be one of {tuple(accepted)}, got {value!r}")


def check_finite(name: str, value: Any) -> None:
    """
    :param name: what the value is, for the message
    :param value: array, or dict of arrays: observations or rewards of a vectorised environment
    :raises ValueError: if a float array holds NaN or infinity; the message names the environments concerned
    """
    if isinstance(value, dict):
        for key, part in value.items():
            check_finite(f"{name}[{key!r}]", part)
        return
    if value.dtype.kind == "f" and not np.isfinite(value).all():
        rows = value.reshape(len(value), -1) if value.ndim > 1 else value[:, None]
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=1)).tolist()
        raise ValueError(f"{name} must be finite, got NaN or inf from environment(s) {bad}: {value[bad]}")


def check_observation_space(space: spaces.Space[Any]) -> None:
    """
    :param space: the observation space of an environment
    :raises ValueError: if SB3's policies cannot read its observations; the message says how they can
    """
    parts = {f"observation_space[{key!r}]": part for key, part in space.items()} if isinstance(space, spaces.Dict) else None
    for name, part in (parts or {"observation_space": space}).items():
        is_flat = isinstance(part, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary))
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
    :raises ValueError: if the policy has no such argument; the message lists those it has
    """
    accepted: set[str] = set()
    # A class that passes **kwargs on accepts what its parent does
    for parent in policy_class.__mro__:
        parameters = inspect.signature(parent).parameters.values()
        accepted |= {p.name for p in parameters if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)}
        if not any(p.kind is p.VAR_KEYWORD for p in parameters):
            break
    accepted -= {"observation_space", "action_space", "lr_schedule", "self"}
    unknown = set(policy_kwargs) - accepted
    if unknown:
        raise ValueError(
            f"policy_kwargs has unknown key(s) {sorted(unknown)}; {policy_class.__name__} accepts {sorted(accepted)}"
        )
