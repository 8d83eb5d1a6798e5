"""State of objects as plain data: JSON and NumPy arrays, which are read without running any code."""

import functools
import inspect
import io
import json
from collections import OrderedDict, deque
from collections.abc import Collection
from typing import Any

import numpy as np
from gymnasium.wrappers.utils import RunningMeanStd as GymRunningMeanStd
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env.stacked_observations import StackedObservations

from sb3_chdp.common.serialization import BIT_GENERATORS, Nested, decode, encode

SCALARS = (type(None), bool, int, float, str)
DICTS = (dict, OrderedDict)
# Objects whose own attributes are saved, as ``Nested``, and put back into the object that is there
NESTED = (RunningMeanStd, GymRunningMeanStd, StackedObservations)


def is_plain(value: Any) -> bool:
    """:return: whether a value can be written: numbers, strings, arrays, generators, and containers of these"""
    if type(value) in SCALARS or isinstance(value, (np.generic, Nested)):
        return not isinstance(value, (np.void, np.object_))
    if type(value) in (list, tuple, deque):
        return set(map(type, value)) <= set(SCALARS) or all(map(is_plain, value))
    if type(value) in DICTS:
        return all(map(is_plain, value.keys())) and all(map(is_plain, value.values()))
    if type(value) is np.ndarray:
        return not value.dtype.hasobject
    return type(value) is np.random.Generator and type(value.bit_generator).__name__ in BIT_GENERATORS


@functools.cache
def constructor_arguments(cls: Any) -> frozenset[str]:
    """:return: names of the arguments that a class and its parents are constructed with"""
    names: set[str] = set()
    for parent in cls.__mro__:
        if "__init__" in vars(parent):
            names.update(inspect.signature(vars(parent)["__init__"]).parameters)
    return frozenset(names)


def is_setting(obj: Any, name: str) -> bool:
    """:return: whether an attribute is named like an argument of the constructor, perhaps with an underscore in front"""
    return not isinstance(obj, NESTED) and name.lstrip("_") in constructor_arguments(obj.__class__)


def _nested(value: Any) -> Any:
    if isinstance(value, NESTED):
        return Nested(state_of(value))
    if type(value) in DICTS and any(isinstance(part, NESTED) for part in value.values()):
        return {key: _nested(part) for key, part in value.items()}
    return value


def state_of(obj: Any, ignored: Collection[str] = ()) -> dict[str, Any]:
    """
    What has changed in an object since it was constructed, as far as it is plain data.

    Attributes named like an argument of the constructor are settings, which whoever constructs the object again gives.

    :param obj: any object with a ``__dict__``
    :param ignored: names of attributes to leave out
    :return: values by name of the attribute
    """
    state = {}
    for name, value in vars(obj).items():
        value = _nested(value)
        if name not in ignored and not is_setting(obj, name) and is_plain(value):
            state[name] = value
    return state


def _restored(current: Any, saved: Any) -> Any:
    if isinstance(saved, Nested):
        restore_state(current, saved)
        return current
    if type(saved) is dict and any(isinstance(part, Nested) for part in saved.values()):
        return {key: _restored(current[key], part) for key, part in saved.items()}
    if isinstance(saved, np.random.Generator) and isinstance(current, np.random.Generator):
        # Others may hold the same generator
        if type(saved.bit_generator) is type(current.bit_generator):
            current.bit_generator.state = saved.bit_generator.state
            return current
    return saved


def restore_state(obj: Any, state: dict[str, Any]) -> None:
    """
    :param obj: the object that was constructed anew
    :param state: what :func:`state_of` gave
    """
    for name, value in state.items():
        if not is_setting(obj, name):
            setattr(obj, name, _restored(getattr(obj, name, None), value))


def to_bytes(value: Any) -> tuple[bytes, bytes]:
    """
    :param value: plain data
    :return: contents of a JSON file and of the npz file with its arrays
    :raises NotSerializable: for other data
    """
    arrays: list[np.ndarray] = []
    text = json.dumps(encode(value, arrays))
    file = io.BytesIO()
    np.savez(file, *arrays)
    return text.encode(), file.getvalue()


def from_bytes(text: bytes, arrays: bytes) -> Any:
    """
    :param text: contents of the JSON file
    :param arrays: contents of the npz file
    :return: what :func:`to_bytes` was given
    """
    with np.load(io.BytesIO(arrays), allow_pickle=False) as loaded:
        return decode(json.loads(text), [loaded[f"arr_{i}"] for i in range(len(loaded.files))])
