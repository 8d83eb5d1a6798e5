"""What the tables of speed share: a model to time, and fair turns."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env

ENV_ID = "HardMove6-v0"


def medians(
    functions: list[Callable[[], object]], repeats: int, clock: Callable[[], float] = time.perf_counter
) -> list[float]:
    """:return: median seconds of each function, called in turns, after one call to warm up"""
    durations: list[list[float]] = [[] for _ in functions]
    for function in functions:
        function()
    for _ in range(repeats):
        for function, values in zip(functions, durations, strict=True):
            start = clock()
            function()
            if th.cuda.is_initialized():
                th.cuda.synchronize()
            values.append(clock() - start)
    return [statistics.median(values) for values in durations]


def build(algorithm: type[BaseAlgorithm], env: Any = ENV_ID, n_envs: int = 8, wrapper: Any = None, **kwargs: Any) -> Any:
    """:return: a model with some data in its replay buffer and no training yet"""
    vec_env = make_vec_env(env, n_envs, seed=0, wrapper_class=wrapper)
    settings = dict(seed=0, device="cpu", learning_starts=300, buffer_size=10_000, gradient_steps=0, batch_size=128)
    return algorithm("MlpPolicy", vec_env, **{**settings, **kwargs}).learn(600)
