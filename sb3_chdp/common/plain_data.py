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

SCALARS = (type(None), bool, int, float, str)
DICTS = (dict, OrderedDict)
# Objects whose own attributes are saved, and put back into the object that is there
NESTED = (RunningMeanStd, GymRunningMeanStd, StackedObservations)
BIT_GENERATORS = ("PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64")
# Lists of so many numbers are written as arrays
LONG = 32
# Key of a dict in the JSON that stands for something else
KIND = "__kind__"


class Nested(dict[str, Any]):
    """The state of an object of the classes ``NESTED``."""


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
    return isinstance(value, np.random.Generator) and type(value.bit_generator).__name__ in BIT_GENERATORS


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


def _encode(value: Any, arrays: list[np.ndarray]) -> Any:
    def as_array(array: np.ndarray, kind: str, **more: Any) -> dict[str, Any]:
        arrays.append(array)
        return {KIND: kind, "array": len(arrays) - 1, **more}

    if type(value) in SCALARS:
        return value
    if type(value) is list and len(value) >= LONG and set(map(type, value)) in ({float}, {int}):
        array = np.array(value)
        if array.dtype in (np.float64, np.int64):
            return as_array(array, "list")
    if type(value) is list:
        return [_encode(part, arrays) for part in value]
    if type(value) is tuple:
        return {KIND: "tuple", "parts": [_encode(part, arrays) for part in value]}
    if type(value) is deque:
        return {KIND: "deque", "parts": [_encode(part, arrays) for part in value], "maxlen": value.maxlen}
    if type(value) in (*DICTS, Nested):
        pairs = [[_encode(key, arrays), _encode(part, arrays)] for key, part in value.items()]
        if type(value) is not Nested and all(type(key) is str and key != KIND for key in value):
            return {key: part for key, (_, part) in zip(value, pairs, strict=True)}
        return {KIND: "nested" if type(value) is Nested else "dict", "pairs": pairs}
    if isinstance(value, np.generic):
        return as_array(np.asarray(value), "scalar")
    if isinstance(value, np.random.Generator):
        return {KIND: "generator", "state": _encode(value.bit_generator.state, arrays)}
    if type(value) is np.ndarray:
        return as_array(value, "array")
    raise TypeError(f"not plain data: {value!r}")


def _decode(value: Any, arrays: Any) -> Any:
    if type(value) is list:
        return [_decode(part, arrays) for part in value]
    if type(value) is not dict:
        return value
    kind = value.get(KIND)
    if kind is None:
        return {key: _decode(part, arrays) for key, part in value.items()}
    if kind in ("array", "scalar", "list"):
        array = arrays[f"arr_{value['array']}"]
        return array if kind == "array" else array.tolist() if kind == "list" else array[()]
    if kind in ("dict", "nested"):
        pairs = {_decode(key, arrays): _decode(part, arrays) for key, part in value["pairs"]}
        return Nested(pairs) if kind == "nested" else pairs
    if kind == "generator":
        state = _decode(value["state"], arrays)
        if state["bit_generator"] not in BIT_GENERATORS:
            raise ValueError(f"unknown bit generator {state['bit_generator']!r}, known are {BIT_GENERATORS}")
        bit_generator = getattr(np.random, state["bit_generator"])()
        bit_generator.state = state
        return np.random.Generator(bit_generator)
    parts = [_decode(part, arrays) for part in value["parts"]]
    return tuple(parts) if kind == "tuple" else deque(parts, maxlen=value["maxlen"])


def to_bytes(value: Any) -> tuple[bytes, bytes]:
    """
    :param value: plain data
    :return: contents of a JSON file and of the npz file with its arrays
    :raises TypeError: for other data
    """
    arrays: list[np.ndarray] = []
    text = json.dumps(_encode(value, arrays))
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
        return _decode(json.loads(text), loaded)
