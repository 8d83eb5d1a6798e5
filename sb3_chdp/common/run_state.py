"""State of a run beside its networks and environments: the model's counters, random generators, callbacks, the logger."""

import random
import warnings
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.logger import CSVOutputFormat, HumanOutputFormat, JSONOutputFormat
from stable_baselines3.common.noise import VectorizedActionNoise
from stable_baselines3.common.vec_env import VecEnv

from sb3_chdp.common.env_state import file_content, restore_env, rewrite, save_env
from sb3_chdp.common.plain_data import is_plain, restore_state, state_of

# Set anew by whoever constructs the model, or by learn()
NOT_OF_THE_MODEL = ("_custom_logger", "start_time", "_num_timesteps_at_start", "n_envs")


def _own_modules(model: BaseAlgorithm) -> Iterator[tuple[str, th.nn.Module]]:
    for name, module in model.policy.named_modules():
        if not type(module).__module__.startswith("torch."):
            yield name, module


def model_state(model: BaseAlgorithm) -> dict[str, Any]:
    """:return: counters, last observations and statistics of the model, and counters that modules keep outside of tensors"""
    modules = {}
    for name, module in _own_modules(model):
        state = {key: value for key, value in state_of(module, ["training"]).items() if type(value) in (bool, int, float)}
        if state:
            modules[name] = state
    return {"model": state_of(model, NOT_OF_THE_MODEL), "modules": modules}


def restore_model(model: BaseAlgorithm, state: dict[str, Any]) -> None:
    """
    :param model: the loaded model
    :param state: what :func:`model_state` gave
    """
    restore_state(model, state["model"])
    for name, module in _own_modules(model):
        restore_state(module, state["modules"].get(name, {}))


def _spaces(space: spaces.Space[Any]) -> Iterator[spaces.Space[Any]]:
    yield space
    parts = getattr(space, "spaces", ())
    for part in parts.values() if isinstance(parts, dict) else parts:
        yield from _spaces(part)


def _noises(model: BaseAlgorithm) -> list[Any]:
    noise = getattr(model, "action_noise", None)
    return noise.noises if isinstance(noise, VectorizedActionNoise) else [] if noise is None else [noise]


def save_generators(model: BaseAlgorithm) -> dict[str, Any]:
    """:return: states of Python's, NumPy's, PyTorch's and the action space's generators and of the action noise"""
    cuda = th.cuda.get_rng_state_all() if model.device.type == "cuda" else []
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),
        "torch": th.get_rng_state().numpy(),
        "cuda": [state.numpy() for state in cuda],
        "action_space": [space.np_random for space in _spaces(model.action_space)],
        "action_noise": [state_of(noise) for noise in _noises(model)],
    }


def restore_generators(model: BaseAlgorithm, state: dict[str, Any]) -> None:
    """
    :param model: the loaded model
    :param state: what :func:`save_generators` gave
    """
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])
    th.set_rng_state(th.from_numpy(state["torch"].copy()))
    if model.device.type == "cuda" and len(state["cuda"]) == th.cuda.device_count():
        th.cuda.set_rng_state_all([th.from_numpy(each.copy()) for each in state["cuda"]])
    for space, generator in zip(_spaces(model.action_space), state["action_space"], strict=True):
        space.np_random.bit_generator.state = generator.bit_generator.state
    for noise, values in zip(_noises(model), state["action_noise"], strict=False):
        restore_state(noise, values)


def _callbacks(root: BaseCallback) -> Iterator[tuple[str, BaseCallback]]:
    """:return: a callback and all within, each with a label that tells it from others of its class"""
    found = [root]
    counts: Counter[str] = Counter()
    for callback in found:
        for name, value in vars(callback).items():
            parts = value if isinstance(value, list) else [value]
            if name != "parent":
                found.extend(part for part in parts if isinstance(part, BaseCallback) and part not in found)
        counts[type(callback).__name__] += 1
        yield f"{type(callback).__name__} {counts[type(callback).__name__]}", callback


def save_callbacks(root: BaseCallback) -> dict[str, Any]:
    """:return: state of all callbacks by label, and of their environments"""
    saved = {}
    for label, callback in _callbacks(root):
        envs = {name: save_env(value) for name, value in vars(callback).items() if isinstance(value, VecEnv)}
        saved[label] = {"state": state_of(callback, ["locals", "globals", "model", "parent"]), "envs": envs}
    return saved


def restore_callbacks(root: BaseCallback, saved: dict[str, Any]) -> None:
    """
    :param root: the callback of ``learn``
    :param saved: what :func:`save_callbacks` gave
    """
    present = dict(_callbacks(root))
    for label, parts in saved.items():
        if label not in present:
            if not parts["state"].keys() <= vars(ConvertCallback(None)).keys():
                warnings.warn(f"The checkpoint holds the state of a callback that is not there: {label.rsplit(' ', 1)[0]}")
            continue
        restore_state(present[label], parts["state"])
        for name, env_state in parts["envs"].items():
            env = getattr(present[label], name)
            if len(env_state["seeds"]) == env.num_envs:
                env.reset()
                restore_env(env, env_state)


def _log_files(model: BaseAlgorithm) -> dict[str, Any]:
    """:return: formats of the logger that write a file of their own, by class"""
    formats = {}
    for each in model.logger.output_formats:
        if isinstance(each, (CSVOutputFormat, JSONOutputFormat)) or (isinstance(each, HumanOutputFormat) and each.own_file):
            formats[type(each).__name__] = each
    return formats


def save_logger(model: BaseAlgorithm) -> dict[str, Any]:
    """:return: values that are recorded but not yet written, and the files written so far"""
    logger = model.logger
    values = {key: value for key, value in logger.name_to_value.items() if is_plain(value)}
    return {
        "values": values,
        "counts": dict(logger.name_to_count),
        "excluded": {key: logger.name_to_excluded.get(key) for key in values},
        "files": {name: file_content(each.file) for name, each in _log_files(model).items()},
        "keys": next((each.keys for each in logger.output_formats if isinstance(each, CSVOutputFormat)), []),
    }


def restore_logger(model: BaseAlgorithm, state: dict[str, Any]) -> None:
    """
    :param model: the model, with a logger
    :param state: what :func:`save_logger` gave
    """
    logger = model.logger
    logger.name_to_value.update(state["values"])
    logger.name_to_count.update(state["counts"])
    logger.name_to_excluded.update(state["excluded"])
    for name, each in _log_files(model).items():
        rewrite(each.file, state["files"].get(name))
        if isinstance(each, CSVOutputFormat) and name in state["files"]:
            each.keys = list(state["keys"])
