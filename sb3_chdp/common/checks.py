"""Checks of arguments and data, whose errors name what was given and what is accepted."""

from collections.abc import Collection
from typing import Any

import numpy as np

from sb3_chdp.common.arguments import FRACTION, check, constructor_defaults, one_of, whole

# Numbers that are learnt from: a thousand of them add up to 1e18, whose square float32 still holds. Losses and optimizers
# compute such squares; beyond them they put out infinity, or learn nothing
LARGEST = 1e15


def check_at_least(least: int, **arguments: int) -> None:
    """
    :param least: smallest value that is accepted
    :param arguments: whole numbers by name
    :raises ValueError: for the first one that is below
    """
    check(whole(least), **arguments)


def check_fraction(**arguments: float) -> None:
    """
    :param arguments: values by name
    :raises ValueError: for the first one that is not between 0 and 1
    """
    check(FRACTION, **arguments)


def check_one_of(accepted: Collection[str], **arguments: str) -> None:
    """
    :param accepted: the values that are accepted
    :param arguments: values by name
    :raises ValueError: for the first one that is none of them
    """
    check(one_of(accepted), **arguments)


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


def check_policy_kwargs(policy_class: type, policy_kwargs: dict[str, Any]) -> None:
    """
    :raises ValueError: if the policy has no such argument; the message lists those it has
    """
    accepted = {*constructor_defaults(policy_class)} - {"observation_space", "action_space", "lr_schedule", "self"}
    unknown = set(policy_kwargs) - accepted
    if unknown:
        raise ValueError(
            f"policy_kwargs has unknown key(s) {sorted(unknown)}; {policy_class.__name__} accepts {sorted(accepted)}"
        )
