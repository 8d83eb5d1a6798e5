"""Why a value is not in its space, in words."""

from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_chdp.common.checks import LARGEST


def mismatch(space: spaces.Space[Any], value: Any, name: str) -> str | None:
    """
    :param space: a space of Gymnasium
    :param value: what should be in it
    :param name: what to call the value
    :return: a sentence that says what is wrong and what to do, None if the value is in the space
    """
    if isinstance(space, spaces.Dict):
        return _dict_mismatch(space, value, name)
    if isinstance(space, spaces.Box):
        return _box_mismatch(space, value, name)
    if space.contains(value):
        return None
    return f"{name} is {value!r}, which is not in {space}: mend the space or the value"


def _dict_mismatch(space: spaces.Dict, value: Any, name: str) -> str | None:
    if not isinstance(value, dict):
        return f"{name} is a {type(value).__name__}, not a dict: return one with the keys {list(space.keys())}"
    if value.keys() != space.keys():
        return f"{name} has the keys {list(value)}, and its space {list(space.keys())}: give both the same"
    found = (mismatch(part, value[key], f"{name}[{key!r}]") for key, part in space.items())
    return next((sentence for sentence in found if sentence is not None), None)


def _box_mismatch(space: spaces.Box, value: Any, name: str) -> str | None:
    as_dtype = f"np.asarray(..., dtype=np.{space.dtype})"
    if not isinstance(value, np.ndarray):
        return (
            f"{name} is a {type(value).__name__}, not an array: return {as_dtype}, or let "
            "gymnasium.wrappers.FlattenObservation(env) make one array of all observations"
        )
    if value.shape != space.shape:
        return f"{name} has the shape {value.shape}, and its space {space.shape}: give both the same"
    if not np.can_cast(value.dtype, space.dtype):
        return f"{name} has dtype {value.dtype}, and its space {space.dtype}: return {as_dtype}, or declare the Box so"
    if not (np.abs(value.astype(np.float64)) <= LARGEST).all():
        remedy = "look for a division by zero or an overflow"
        return f"{name} must be finite, and at most {LARGEST:.0e} in size, got {value}: {remedy}"
    outside = (value < space.low) | (value > space.high)
    if outside.any():
        where = tuple(np.argwhere(outside)[0].tolist())
        return (
            f"{name} is outside of its space: element {list(where)} is {value[where]}, and the bounds there are "
            f"{space.low[where]} and {space.high[where]}: widen the bounds or clip the value"
        )
    return None
