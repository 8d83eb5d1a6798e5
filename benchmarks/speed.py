"""
Speed of the environments, of acting and of a gradient step; medians over repeats, one process, one thread.

    make speed

The environments are compared with the figures of the original packages, which were measured on another machine (AMD EPYC,
2 vCPUs, Python 3.11.7): read those ratios as orders of magnitude.
"""

import argparse
import platform
import statistics
import time
from collections.abc import Callable

import gymnasium as gym
import numpy as np
import stable_baselines3 as sb3
import torch as th
from gymnasium import spaces
from stable_baselines3 import TD3
from stable_baselines3.common.env_util import make_vec_env

import sb3_chdp
from sb3_chdp import CHDP, FlattenHybridAction, HybridActionSpec

# Of the originals with a uniformly random policy: frames per second for Platform (with numba) and Goal, else steps
REFERENCE_RATES = {
    "Platform-v0": 21_000,
    "Goal-v0": 17_100,
    "HardGoal-v0": 16_500,
    "CatchPoint-v0": 17_400,
    "HardMove4-v0": 6_500,
    "HardMove6-v0": 3_800,
    "HardMove8-v0": 1_350,
    "HardMove10-v0": 350,
}


def median_seconds(function: Callable[[], object], repeats: int) -> float:
    """:return: median duration of a call, after one call to warm up"""
    function()
    durations = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        durations.append(time.perf_counter() - start)
    return statistics.median(durations)


def env_rates(env_id: str, seconds: float) -> tuple[float, float]:
    """:return: steps and frames per second under a uniformly random policy, sampling and resets included"""
    env = gym.make(env_id)
    spec = HybridActionSpec(env.action_space)
    rng = np.random.default_rng(0)
    env.reset(seed=0)
    rates = []
    for _ in range(3):
        steps = frames = 0
        start = time.perf_counter()
        while time.perf_counter() - start < seconds / 3:
            for action in spec.to_native_batch(spec.sample_rows(rng, 32)):
                _, _, terminated, truncated, info = env.step(action)
                steps += 1
                frames += info["frames"]
                if terminated or truncated:
                    env.reset()
        duration = time.perf_counter() - start
        rates.append((steps / duration, frames / duration))
    return statistics.median(r[0] for r in rates), statistics.median(r[1] for r in rates)


def print_env_table(seconds: float) -> None:
    print("\n| environment | steps/s | frames/s | original (other machine) | ratio |\n|---|---|---|---|---|")
    for env_id, reference in REFERENCE_RATES.items():
        steps, frames = env_rates(env_id, seconds)
        ratio = (frames if reference and env_id in ("Platform-v0", "Goal-v0", "HardGoal-v0") else steps) / reference
        print(f"| {env_id} | {steps:,.0f} | {frames:,.0f} | {reference:,} | {ratio:.0f} |")


def print_conversion_table(repeats: int) -> None:
    print("\n| action space | microseconds per native action (batch of 8) |\n|---|---|")
    box = spaces.Box(-1.0, 1.0, (1,))
    cases = {
        "nested, K = 4": spaces.Tuple((spaces.Discrete(4), spaces.Tuple([box] * 4))),
        "nested, K = 1024": spaces.Tuple((spaces.Discrete(1024), spaces.Tuple([box] * 1024))),
        "shared, K = 1024": spaces.Tuple((spaces.Discrete(1024), box)),
        "product, K = 65,536": spaces.Tuple((spaces.MultiBinary(16), box)),
    }
    for name, space in cases.items():
        spec = HybridActionSpec(space)
        rows = spec.sample_rows(np.random.default_rng(0), 8)
        print(f"| {name} | {median_seconds(lambda s=spec, r=rows: s.to_native_batch(r), 20 * repeats) / 8 * 1e6:.0f} |")


def print_chdp_table(repeats: int) -> None:
    print("\n| HardMove6-v0 | milliseconds | ratio to SB3's TD3 |\n|---|---|---|")
    rows: list[tuple[str, float, float]] = []
    env = make_vec_env("HardMove6-v0", 8, seed=0)
    model = CHDP("MlpPolicy", env, seed=0, device="cpu", learning_starts=300, buffer_size=10_000, gradient_steps=0)
    flat_env = make_vec_env("HardMove6-v0", 8, seed=0, wrapper_class=FlattenHybridAction)
    td3 = TD3("MlpPolicy", flat_env, seed=0, device="cpu", learning_starts=300, buffer_size=10_000, gradient_steps=0,
              policy_kwargs=dict(net_arch=dict(pi=[128, 128], qf=[256, 256])))  # fmt: skip
    for algorithm in (model, td3):
        algorithm.learn(400)
    td3_step = median_seconds(lambda: td3.train(2, 128), repeats) / 2
    step = median_seconds(lambda: model.train(1, 128), repeats)
    rows.append(("gradient step, batch 128", step, td3_step))
    for n in (1, 64):
        obs = np.random.default_rng(0).uniform(-1, 1, (n, 4)).astype(np.float32)
        ours, theirs = (median_seconds(lambda a=a, o=obs: a.predict(o, deterministic=True), repeats) for a in (model, td3))
        rows.append((f"predict, {n} observation(s), best of 16", ours, theirs))
    for name, ours, theirs in rows:
        print(f"| {name} | {1e3 * ours:.1f} | {ours / theirs:.1f} |")
    print(f"\n{1 / step:.0f} gradient steps per second")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=6.0, help="seconds per environment")
    parser.add_argument("--repeats", type=int, default=30)
    args = parser.parse_args()
    th.set_num_threads(1)
    print(
        f"sb3_chdp {sb3_chdp.__version__}, stable_baselines3 {sb3.__version__}, torch {th.__version__}, "
        f"Python {platform.python_version()}, {platform.processor() or platform.machine()}, 1 thread"
    )
    print_env_table(args.seconds)
    print_conversion_table(args.repeats)
    print_chdp_table(args.repeats)
