"""Episodes of the published models, for the scripts beside this one."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_chdp import CHDP

BENCHMARKS = Path(__file__).parent.parent
FIGURES = BENCHMARKS / "figures"


class Episode(NamedTuple):
    """
    :param observations: what the model saw, one per action
    :param actions: native actions
    :param success: ``is_success`` of the last step
    """

    observations: list[np.ndarray]
    actions: list[Any]
    success: bool


def published(env_id: str, algorithm: type[BaseAlgorithm] = CHDP) -> Path:
    """:return: zip of the published model of an environment, which need not exist"""
    folders = {"CHDP": "chdp", "HyARTD3": "hyar_td3"}
    return BENCHMARKS / "models" / folders[algorithm.__name__] / f"{env_id}_1" / f"{env_id}.zip"


def load_model(env_id: str, algorithm: type[BaseAlgorithm] = CHDP, path: str | None = None) -> Any:
    """
    :param env_id: environment, without the namespace
    :param algorithm: class of the model
    :param path: zip of a model; the published one if None
    :return: the model, on the CPU
    :raises SystemExit: if there is no published one
    """
    if path is None and not published(env_id, algorithm).exists():
        raise SystemExit(f"There is no published model of {env_id}: train one, then see benchmarks/release.py")
    return algorithm.load(path or published(env_id, algorithm), device="cpu")


def make_env(env_id: str, **kwargs: Any) -> gym.Env:
    """:return: this package's environment, even if another package has taken the bare id"""
    return gym.make(f"sb3_chdp/{env_id}", **kwargs)


def play(
    model: Any,
    env: gym.Env,
    seed: int | None = None,
    options: dict[str, Any] | None = None,
    deterministic: bool = True,
    look: Callable[[], None] = lambda: None,
) -> Episode:
    """
    Play one episode.

    :param model: the model
    :param env: environment with native actions
    :param seed: of the reset
    :param options: of the reset
    :param deterministic: whether the model acts so
    :param look: called after the reset and every step
    :return: the episode
    """
    obs, _ = env.reset(seed=seed, options=options)
    look()
    observations, actions, over = [], [], False
    while not over:
        action, _ = model.predict(obs, deterministic=deterministic)
        observations.append(obs)
        actions.append(action)
        obs, _, terminated, truncated, info = env.step(action)
        look()
        over = terminated or truncated
    return Episode(observations, actions, info["is_success"])


def parser_of(description: str | None) -> argparse.ArgumentParser:
    """:return: a parser that shows the docstring of a script as it is"""
    return argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
