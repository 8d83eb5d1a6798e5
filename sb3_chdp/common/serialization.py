"""
Models, policies, replay buffers and checkpoints as JSON and arrays, which are read without running any code of the file's.

JSON's own types stand for themselves. Everything else is an object with the key ``TAG``, which names one of the kinds
below: a file can name them, and nothing beyond them.
"""

import base64
import enum
import sys
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module
from typing import Any

import numpy as np
import stable_baselines3.common.sb2_compat.rmsprop_tf_like  # noqa: F401  # files may name its class
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from stable_baselines3.her.goal_selection_strategy import GoalSelectionStrategy

from sb3_chdp.common.hybrid_box import HybridBox

TAG = ":json:"
# Arrays with more elements than this are not written as lists of numbers
LONG = 64
BIT_GENERATORS = ("PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64")


class NotSerializable(TypeError):
    """The object cannot be written as JSON and arrays."""


class Nested(dict[str, Any]):
    """Attributes that are to be put back into an object, not a value of their own."""


def _state_of(generator: np.random.Generator) -> dict[str, Any]:
    state = generator.bit_generator.state
    if state["bit_generator"] not in BIT_GENERATORS:
        raise NotSerializable(f"{generator!r}")
    return {"state": state}


def _generator(state: dict[str, Any]) -> np.random.Generator:
    if state["bit_generator"] not in BIT_GENERATORS:
        raise ValueError(f"unknown bit generator {state['bit_generator']!r}, known are {BIT_GENERATORS}")
    bit_generator = getattr(np.random, state["bit_generator"])()
    bit_generator.state = state
    return np.random.Generator(bit_generator)


# Constructor arguments of the objects that can be written
ARGUMENTS: dict[type, Callable[[Any], dict[str, Any]]] = {
    spaces.Box: lambda box: {"low": box.low, "high": box.high, "dtype": str(box.dtype)},
    spaces.Discrete: lambda space: {"n": int(space.n), "start": int(space.start), "dtype": str(space.dtype)},
    spaces.MultiDiscrete: lambda space: {"nvec": space.nvec, "start": space.start, "dtype": str(space.dtype)},
    spaces.MultiBinary: lambda space: {"n": list(space.shape) if len(space.shape) != 1 else int(space.shape[0])},
    spaces.Tuple: lambda space: {"spaces": list(space.spaces)},
    spaces.OneOf: lambda space: {"spaces": list(space.spaces)},
    ConstantSchedule: lambda schedule: {"val": schedule.val},
    FloatSchedule: lambda schedule: {"value_schedule": schedule.value_schedule},
    LinearSchedule: lambda schedule: vars(schedule),
    NormalActionNoise: lambda noise: {"mean": noise._mu, "sigma": noise._sigma, "dtype": str(np.dtype(noise._dtype))},
    OrnsteinUhlenbeckActionNoise: lambda noise: {
        "mean": noise._mu,
        "sigma": noise._sigma,
        "theta": noise._theta,
        "dt": noise._dt,
        "initial_noise": noise.initial_noise,
        "dtype": str(np.dtype(noise._dtype)),
    },
    VectorizedActionNoise: lambda noise: {"base_noise": noise.base_noise, "n_envs": noise.n_envs},
    TrainFreq: lambda frequency: frequency._asdict(),
    np.random.Generator: _state_of,
    deque: lambda queue: {"iterable": list(queue), "maxlen": queue.maxlen},
}
# Attributes that objects have beside their arguments (setting ``noises`` would reset them)
STATE: dict[type, str] = {OrnsteinUhlenbeckActionNoise: "noise_prev", VectorizedActionNoise: "_noises"}
CONSTRUCTORS: dict[str, Callable[..., Any]] = {kind.__name__: kind for kind in ARGUMENTS} | {"Generator": _generator}
ENUMS: dict[str, type[enum.Enum]] = {kind.__name__: kind for kind in (TrainFrequencyUnit, GoalSelectionStrategy)}

# Where classes may come from that a file names, and of which kind they may be
PACKAGES = ("sb3_chdp.", "stable_baselines3.", "sb3_contrib.", "torch.nn.modules.", "torch.optim.")
CLASSES = (th.nn.Module, th.optim.Optimizer, BaseBuffer, HybridBox)


def qualified_name(kind: type) -> str:
    """:return: module and name of a class"""
    return f"{kind.__module__}.{kind.__qualname__}"


def import_own(name: str) -> None:
    """
    Import the module of a class that a file names, if it is of this package: the import of another one could run any code.

    :param name: module and name of the class
    """
    module, package = name.rpartition(".")[0], __name__.partition(".")[0]
    if module.startswith(f"{package}.") and not module.endswith("__main__"):
        with suppress(ModuleNotFoundError):
            import_module(module)


def _find_class(name: str, kinds: tuple[type, ...] = CLASSES) -> type:
    module, _, attribute = name.rpartition(".")
    import_own(name)
    found = getattr(sys.modules.get(module), attribute, None) if name.startswith(PACKAGES) else None
    if not (isinstance(found, type) and issubclass(found, kinds) and qualified_name(found) == name):
        accepted = [kind.__name__ for kind in kinds]
        raise ValueError(f"{name} is not a class that a file may name here: a kind of {accepted} in {PACKAGES}")
    return found


def _encode_array(array: np.ndarray, arrays: list[np.ndarray] | None) -> dict[str, Any]:
    if array.dtype == object and array.size and all(item == {} for item in array.flat):
        # Of HER's replay buffer, which keeps infos on request only
        return {TAG: "empty_dicts", "shape": list(array.shape)}
    if array.dtype.kind not in "biuf" or array.dtype.itemsize > 8:
        if arrays is None or array.dtype.hasobject:
            raise NotSerializable(f"an array of {array.dtype}")
        arrays.append(array)
        return {TAG: "array_file", "index": len(arrays) - 1}
    entry = {TAG: "array", "dtype": array.dtype.str, "shape": list(array.shape)}
    bits = np.ascontiguousarray(array).view(f"u{array.dtype.itemsize}")
    if array.size > 1 and (bits == bits.flat[0]).all():
        return {**entry, "all": array.flat[0].item()}
    if array.size <= LONG:
        return {**entry, "values": array.ravel().tolist()}
    if arrays is None:
        return {**entry, "base64": base64.b64encode(array.tobytes()).decode()}
    arrays.append(array)
    return {TAG: "array_file", "index": len(arrays) - 1}


def _decode_array(entry: dict[str, Any]) -> np.ndarray:
    dtype = np.dtype(str(entry["dtype"]))
    if dtype.kind not in "biuf":
        raise ValueError(f"arrays of {dtype} are not read")
    shape = tuple(entry["shape"])
    if "all" in entry:
        return np.full(shape, entry["all"], dtype)
    if "values" in entry:
        return np.array(entry["values"], dtype).reshape(shape)
    return np.frombuffer(base64.b64decode(entry["base64"]), dtype).reshape(shape).copy()


def encode(value: Any, arrays: list[np.ndarray] | None = None) -> Any:
    """
    :param value: what is to be written
    :param arrays: long arrays are appended to it, to be written to files of their own; None: they become text
    :return: the same as something that ``json.dumps`` takes
    :raises NotSerializable: if the value is or holds anything but the kinds of this module
    """
    kind = type(value)
    if value is None or kind in (bool, int, float, str):
        return value
    if kind is list:
        return [encode(item, arrays) for item in value]
    if kind is dict and TAG not in value and all(type(key) is str for key in value):
        return {key: encode(item, arrays) for key, item in value.items()}
    if kind is tuple:
        return {TAG: "tuple", "items": [encode(item, arrays) for item in value]}
    if kind in (dict, Nested, OrderedDict, spaces.Dict):
        return {TAG: kind.__name__, "items": [[encode(key, arrays), encode(item, arrays)] for key, item in value.items()]}
    if kind is np.ndarray:
        return _encode_array(value, arrays)
    if isinstance(value, np.generic):
        return {TAG: "number", "array": _encode_array(np.asarray(value), arrays)}
    if kind in ARGUMENTS:
        entry = {TAG: kind.__name__, "arguments": encode(ARGUMENTS[kind](value), arrays)}
        return {**entry, "state": encode(getattr(value, STATE[kind]), arrays)} if kind in STATE else entry
    if isinstance(value, HybridBox):
        constructor, arguments, _ = value.__reduce__()
        return {TAG: "hybrid_space", "class": encode(constructor), "arguments": encode(list(arguments), arrays)}
    if kind in ENUMS.values():
        return {TAG: "enum", "class": kind.__name__, "name": value.name}
    if isinstance(value, type):
        try:
            return {TAG: "class", "name": qualified_name(_find_class(qualified_name(value)))}
        except ValueError as error:
            raise NotSerializable(str(error)) from error
    if value is BasePolicy._dummy_schedule:
        return {TAG: "dummy_schedule"}
    if qualified_name(kind) == "rl_zoo3.utils.SimpleLinearSchedule":
        return {TAG: "SimpleLinearSchedule", "initial_value": value.initial_value}
    raise NotSerializable(f"{value!r} of {kind}")


def decode(value: Any, arrays: list[np.ndarray] | None = None) -> Any:
    """
    Inverse of :func:`encode`.

    :param value: what ``json.loads`` returned
    :param arrays: the arrays from files of their own
    :return: what was encoded
    :raises ValueError: if it names a kind or class that is not one of those of this module
    """
    if isinstance(value, list):
        return [decode(item, arrays) for item in value]
    if not isinstance(value, dict):
        return value
    if TAG not in value:
        return {key: decode(item, arrays) for key, item in value.items()}
    tag = value[TAG]
    if tag in CONSTRUCTORS:
        made = CONSTRUCTORS[tag](**decode(value["arguments"], arrays))
        if type(made) in STATE:
            setattr(made, STATE[type(made)], decode(value["state"], arrays))
        return made

    def pairs() -> Iterator[tuple[Any, Any]]:
        return ((decode(key, arrays), decode(item, arrays)) for key, item in value["items"])

    readers: dict[Any, Callable[[], Any]] = {
        "tuple": lambda: tuple(decode(value["items"], arrays)),
        "dict": lambda: dict(pairs()),
        "Nested": lambda: Nested(pairs()),
        "OrderedDict": lambda: OrderedDict(pairs()),
        "array": lambda: _decode_array(value),
        "array_file": lambda: (arrays or [])[value["index"]],
        "number": lambda: decode(value["array"], arrays)[()],
        "empty_dicts": lambda: _empty_dicts(value["shape"]),
        # In their order: a plain dict would be sorted
        "Dict": lambda: spaces.Dict(OrderedDict(pairs())),
        "hybrid_space": lambda: _find_class(value["class"]["name"], (HybridBox,))(*decode(value["arguments"], arrays)),
        "enum": lambda: ENUMS[value["class"]][value["name"]],
        "class": lambda: _find_class(value["name"]),
        "dummy_schedule": lambda: BasePolicy._dummy_schedule,
        # Without rl_zoo3, importing which patches Gymnasium
        "SimpleLinearSchedule": lambda: LinearSchedule(value["initial_value"], 0.0, 1.0),
    }
    if tag not in readers:
        raise ValueError(f"{tag!r} is not a kind of object that a file may name")
    return readers[tag]()


def _empty_dicts(shape: list[int]) -> np.ndarray:
    made = np.empty(shape, dtype=object)
    for index in np.ndindex(*shape):
        made[index] = {}
    return made
