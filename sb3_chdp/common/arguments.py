"""What arguments of algorithms may be: tables of a name and what it accepts, and their check."""

import difflib
import inspect
import math
import warnings
from collections.abc import Callable, Collection, Mapping
from numbers import Integral, Real
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium.utils.env_checker import data_equivalence

# Arithmetic of a training step, relative to that of the default settings, from which on users are told
COSTLY = 20


class Accepted(NamedTuple):
    """
    :ivar text: completes the sentence "it must be ..."
    :ivar test: whether a value is accepted
    :ivar shapes_networks: whether another value means other networks, so that ``load`` cannot change it
    """

    text: str
    test: Callable[[Any], bool]
    shapes_networks: bool = False


def is_number(value: Any) -> bool:
    """:return: whether this is a finite number, of Python or NumPy; booleans are none"""
    is_real = isinstance(value, Real) and not isinstance(value, (bool, np.bool_))
    return is_real and (isinstance(value, Integral) or math.isfinite(value))


def is_class_of(value: Any, kind: type | tuple[type, ...]) -> bool:
    """:return: whether this is a class, and one derived from another, or from one of several"""
    return isinstance(value, type) and issubclass(value, kind)


def whole(least: int, most: float = math.inf) -> Accepted:
    """:return: whole numbers between two bounds"""
    text = f"a whole number of at least {least}" if most == math.inf else f"a whole number between {least} and {most}"
    return Accepted(text, lambda value: isinstance(value, Integral) and is_number(value) and least <= int(value) <= most)


def one_of(names: Collection[str]) -> Accepted:
    """:return: some strings"""
    return Accepted(f"one of {tuple(names)}", lambda value: isinstance(value, str) and value in names)


def optional(accepted: Accepted) -> Accepted:
    """:return: None as well"""
    return accepted._replace(text=f"{accepted.text}, or None", test=lambda value: value is None or accepted.test(value))


def scheduled(accepted: Accepted) -> Accepted:
    """:return: functions of the remaining progress as well"""
    text = f"{accepted.text}, or a function of the remaining progress"
    return accepted._replace(text=text, test=lambda value: callable(value) or accepted.test(value))


def of_networks(accepted: Accepted) -> Accepted:
    """:return: the same, for an argument that shapes the networks"""
    return accepted._replace(shapes_networks=True)


def _is_train_freq(value: Any) -> bool:
    if not isinstance(value, tuple):
        value = (value, "step")
    # After the model's set-up the unit is an enumeration
    return len(value) == 2 and whole(1).test(value[0]) and getattr(value[1], "value", value[1]) in ("step", "episode")


NOT_NEGATIVE = Accepted("a finite number of at least 0", lambda value: is_number(value) and value >= 0)
POSITIVE = Accepted("a finite number above 0", lambda value: is_number(value) and value > 0)
FRACTION = Accepted("a number between 0 and 1", lambda value: is_number(value) and 0 <= value <= 1)
SWITCH = Accepted("True or False", lambda value: isinstance(value, (bool, np.bool_)))
A_DICT = Accepted("a dict", lambda value: isinstance(value, dict))
RATE = scheduled(NOT_NEGATIVE)
SEED = optional(whole(0, 2**32 - 1))
TRAIN_FREQ = Accepted('a whole number of at least 1, alone or in a tuple with "step" or "episode"', _is_train_freq)


def check(accepted: Accepted, **arguments: Any) -> None:
    """
    :param accepted: what is accepted
    :param arguments: values by name
    :raises ValueError: for the first one that is not; the message says what was given and what is accepted
    """
    for name, value in arguments.items():
        if not accepted.test(value):
            raise ValueError(f"{name} must be {accepted.text}, got {value!r}")


def accepted_arguments(cls: type) -> dict[str, Accepted]:
    """
    :param cls: an algorithm
    :return: the tables ``accepted_arguments`` of the class and its base classes, in one; an entry of the class takes the place
        of those of its base classes
    """
    tables = [vars(kind).get("accepted_arguments", {}) for kind in reversed(cls.__mro__)]
    return {name: accepted for table in tables for name, accepted in table.items()}


def check_arguments(model: Any) -> None:
    """
    Check the arguments of an algorithm, and turn NumPy's numbers among them into Python's, which SB3 asks for.

    :param model: algorithm with its arguments as attributes
    :raises ValueError: for the first one that its class does not accept
    """
    for name, accepted in accepted_arguments(type(model)).items():
        for attribute in (name, f"_{name}"):
            if attribute in vars(model):
                value = vars(model)[attribute]
                check(accepted, **{name: value})
                if isinstance(value, np.generic):
                    setattr(model, attribute, value.item())


def constructor_defaults(cls: type) -> dict[str, Any]:
    """:return: default by name of the arguments of a class, those that it hands on to its base classes included"""
    defaults: dict[str, Any] = {}
    for kind in cls.__mro__:
        parameters = inspect.signature(kind).parameters.values()
        named = [p for p in parameters if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)]
        defaults = {**{p.name: p.default for p in named}, **defaults}
        if not any(p.kind is p.VAR_KEYWORD for p in parameters):
            break
    return defaults


def check_device(device: th.device | str) -> None:
    """
    :param device: argument of an algorithm
    :raises ValueError: if there is no such device
    """
    if device == "auto":
        return
    try:
        wanted = th.device(device)
    except (RuntimeError, TypeError) as error:
        raise ValueError(f'device must be "auto", "cpu", "cuda" or another one of PyTorch\'s, got {device!r}') from error
    n_gpus = th.cuda.device_count() if th.cuda.is_available() else 0
    if wanted.type == "cuda" and (wanted.index or 0) >= n_gpus:
        raise ValueError(f'device must be one that PyTorch finds, got {device!r}, and there are {n_gpus} GPUs; see "auto"')


def warn_of_cost(cls: type, **arguments: float) -> None:
    """
    Warn if settings make a training step far more work than the defaults do.

    :param cls: the algorithm
    :param arguments: values by name of arguments that multiply the work of a training step
    """
    defaults = constructor_defaults(cls)
    factors = {name: value / defaults[name] for name, value in arguments.items()}
    total = math.prod(factors.values())
    if total >= COSTLY:
        settings = [f"{name}={arguments[name]} (default {defaults[name]})" for name, factor in factors.items() if factor > 1]
        warnings.warn(
            f"A training step is about {total:.0f} times the work that it is with the default settings, because of "
            f"{', '.join(settings)}",
            stacklevel=4,
        )


def _is_same(saved: Any, value: Any) -> bool:
    # == of arrays, which a dict may hold, is none or many
    return data_equivalence(saved, value) if isinstance(value, dict) else saved == value


def check_load(cls: type, path: Any, saved: Mapping[str, Any], changes: Mapping[str, Any]) -> None:
    """
    :param cls: algorithm that is loaded
    :param path: the file
    :param saved: attributes in the file
    :param changes: keywords given to ``load``
    :raises ValueError: for a keyword that is no argument, or one that the networks in the file do not allow
    """
    arguments = sorted({*constructor_defaults(cls)} - {"policy", "env", "_init_setup_model"})
    accepted = accepted_arguments(cls)
    for name, value in changes.items():
        if name not in arguments and (name not in saved or name in ("policy", "env")):
            close = difflib.get_close_matches(name, arguments, n=1)
            hint = f"did you mean {close[0]}? It" if close else "it"
            raise ValueError(f"load() got the unknown argument {name}={value!r}, {hint} must be one of {arguments}")
        if name in accepted:
            check(accepted[name], **{name: value})
            if accepted[name].shapes_networks and name in saved and not _is_same(saved[name], value):
                raise ValueError(f"{name} must stay {saved[name]!r}, for which {path} has networks, got {value!r}")
