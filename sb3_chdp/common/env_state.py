"""State of vectorised environments: wrappers, generators, Monitor files, and of the environments if they can give it."""

import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.monitor import ResultsWriter
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from sb3_chdp.common.plain_data import is_plain, is_setting, restore_state, state_of

# Attributes of wrappers that say what an environment is, not where it stands
DESCRIPTIONS = ("class_attributes", "num_envs", "render_mode", "metadata", "reset_infos", "spec", "_metadata", "_cached_spec")
# What is known of environments in other processes: TimeLimit's, OrderEnforcing's and Monitor's
REMOTE_ATTRIBUTES = (
    "_elapsed_steps", "_has_reset", "rewards", "needs_reset", "total_steps", "episode_returns", "episode_lengths",
    "episode_times", "current_reset_info", "t_start", "np_random",
)  # fmt: skip


def _vec_wrappers(env: VecEnv) -> Iterator[VecEnvWrapper]:
    while isinstance(env, VecEnvWrapper):
        yield env
        env = env.venv


def _wrappers(env: gym.Env) -> Iterator[gym.Wrapper]:
    while isinstance(env, gym.Wrapper):
        yield env
        env = env.env


def _labels(objects: list[Any]) -> list[str]:
    """:return: name of each object's class, numbered if there are several of it"""
    counts: Counter[str] = Counter()
    labels = []
    for obj in objects:
        name = type(obj).__name__
        counts[name] += 1
        labels.append(f"{name} {counts[name]}" if counts[name] > 1 else name)
    return labels


def class_names(env: VecEnv) -> list[str]:
    """:return: classes of the wrappers of a vectorised environment, the outermost first"""
    return [type(wrapper).__name__ for wrapper in _vec_wrappers(env)]


def local_envs(env: VecEnv) -> list[gym.Env] | None:
    """:return: the environments if they live in this process"""
    return getattr(env.unwrapped, "envs", None)


def file_content(file: Any) -> np.ndarray | None:
    """:return: the bytes of an open text file as they are on the disk, None if it is not there"""
    file.flush()
    path = Path(file.name)
    return np.frombuffer(path.read_bytes(), dtype=np.uint8) if path.is_file() else None


def rewrite(file: Any, content: np.ndarray | None) -> None:
    """
    :param file: open text file
    :param content: the bytes it is to hold; writing goes on behind them
    """
    if content is not None:
        file.seek(0)
        file.truncate()
        file.write(content.tobytes().decode(file.encoding))
        file.flush()


def _monitor_files(env: VecEnv) -> dict[str, Any]:
    """:return: open files of Monitor and VecMonitor wrappers, by their place"""
    places: dict[str, Any] = {"": list(_vec_wrappers(env))}
    places.update({f"{i} ": list(_wrappers(each)) for i, each in enumerate(local_envs(env) or [])})
    return {
        place + label: wrapper.results_writer.file_handler
        for place, wrappers in places.items()
        for label, wrapper in zip(_labels(wrappers), wrappers, strict=True)
        if isinstance(getattr(wrapper, "results_writer", None), ResultsWriter)
    }


def has_state(env: VecEnv) -> bool:
    """:return: whether all environments have the methods ``get_state`` and ``set_state``"""
    return env.has_attr("get_state") and env.has_attr("set_state")


def save_env(env: VecEnv) -> dict[str, Any]:
    """
    :param env: vectorised environment
    :return: its state, plain data
    :raises ValueError: if ``get_state`` gives something else
    """
    state: dict[str, Any] = {
        "vec_wrappers": [state_of(wrapper, DESCRIPTIONS) for wrapper in _vec_wrappers(env)],
        "seeds": env.unwrapped._seeds,
        "options": env.unwrapped._options,
        "files": {place: file_content(file) for place, file in _monitor_files(env).items()},
        "states": env.env_method("get_state") if has_state(env) else None,
    }
    if not is_plain(state["states"]):
        raise ValueError(f"get_state() must give numbers, strings, arrays, lists and dicts of these, got {state['states']}")
    envs = local_envs(env)
    if envs is None:
        values = {name: env.get_attr(name) for name in REMOTE_ATTRIBUTES if env.has_attr(name)}
        state["remote"] = {name: value for name, value in values.items() if is_plain(value)}
        return state
    state["wrappers"] = []
    for each in envs:
        wrappers = list(_wrappers(each))
        state["wrappers"].append(dict(zip(_labels(wrappers), (state_of(w, DESCRIPTIONS) for w in wrappers), strict=True)))
    generators = [getattr(each.unwrapped, "np_random", None) for each in envs]
    state["np_random"] = [generator if is_plain(generator) else None for generator in generators]
    return state


def restore_env(env: VecEnv, state: dict[str, Any]) -> None:
    """
    Put wrappers, generators, Monitor files and, if they have it, the environments' own state back.

    :param env: vectorised environment that was reset, made like the saved one
    :param state: what :func:`save_env` gave
    """
    envs = local_envs(env)
    if envs is None:
        for name, values in state.get("remote", {}).items():
            for i, value in enumerate(values):
                env.env_method("set_wrapper_attr", name, value, indices=i)
    elif "wrappers" in state:
        for each, by_label in zip(envs, state["wrappers"], strict=True):
            layers = list(_wrappers(each))
            for label, layer in zip(_labels(layers), layers, strict=True):
                restore_state(layer, by_label.get(label, {}))
    if state["states"] is not None and has_state(env):
        for i, own in enumerate(state["states"]):
            env.env_method("set_state", own, indices=i)
    if envs is not None:
        for each, generator in zip(envs, state.get("np_random", [None] * len(envs)), strict=True):
            if generator is not None:
                restore_state(each.unwrapped, {"np_random": generator})
    env.unwrapped._seeds, env.unwrapped._options = state["seeds"], state["options"]
    for wrapper, values in zip(_vec_wrappers(env), state["vec_wrappers"], strict=True):
        restore_state(wrapper, values)
    for place, file in _monitor_files(env).items():
        rewrite(file, state["files"].get(place))


def warn_of_losses(env: VecEnv) -> None:
    """
    Say what a checkpoint of an environment will lack.

    :param env: vectorised environment
    """
    if not has_state(env):
        warnings.warn(
            "The environment has no get_state() and set_state(): a resumed run begins with a fresh episode", stacklevel=2
        )
    known = (spaces.Space, gym.Env, ResultsWriter, type, type(None))
    for wrapper in [wrapper for env in (local_envs(env) or [])[:1] for wrapper in _wrappers(env)]:
        lost = [
            name
            for name, value in vars(wrapper).items()
            if not is_setting(wrapper, name)
            and name not in (*DESCRIPTIONS, *state_of(wrapper))
            and not isinstance(value, known)
            and not callable(value)
        ]
        if lost:
            warnings.warn(
                f"{type(wrapper).__name__} keeps {', '.join(lost)}, which checkpoints do not hold: a resumed run differs "
                "unless its get_state() and set_state() deal with them",
                stacklevel=2,
            )
