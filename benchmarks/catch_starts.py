"""
What a model of CHDP lacks on Catch Point: success by the distance of the target at the start.

    python benchmarks/catch_starts.py                     the published model
    python benchmarks/catch_starts.py --model benchmarks/results/main/chdp/CatchPoint-v0/seed_40.zip

"Within reach" are targets that straight pushes at once, then a catch, reach in 25 steps. "Extra steps" are those of successful
episodes beyond that; a miss is a catch out of reach, the twelfth of which ends an episode.
"""

import argparse
from itertools import pairwise

import gymnasium as gym
import numpy as np
from cells import ROOT

from sb3_chdp import CHDP
from sb3_chdp.envs.point_mass import CAPTURE_RADIUS, CATCH, DAMPING, DT, FORCE

DISTANCES = (0.0, 0.2, 0.3, 0.4, 1.0, 1.8, 1.9, 2.0, 2.9)
MAX_STEPS = 25


def fewest_steps(distance: float) -> int:
    """:return: straight pushes and a catch to a target at this distance from an agent at rest"""
    velocity = position = 0.0
    steps = 1
    while position + DT * (1 - DAMPING) * velocity + CAPTURE_RADIUS < distance:
        velocity = (1 - DAMPING) * velocity + DT * FORCE
        position += DT * velocity
        steps += 1
    return steps


def run(model: CHDP, episodes: int) -> np.ndarray:
    """:return: (episodes, 5) distance at the start, fewest steps, steps, misses, success"""
    env = gym.make("CatchPoint-v0")
    results = []
    for seed in range(episodes):
        obs, _ = env.reset(seed=seed)
        distance, steps, misses, over = float(np.linalg.norm(obs[2:])), 0, 0, False
        while not over:
            action, _ = model.predict(obs, deterministic=True)
            obs, _, terminated, truncated, info = env.step(action)
            over, steps = terminated or truncated, steps + 1
            misses += action[0] == CATCH and not info["is_success"]
        results.append((distance, fewest_steps(distance), steps, misses, info["is_success"]))
    return np.array(results)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", help="zip of a trained model (default: the published one)")
    parser.add_argument("--episodes", type=int, default=2000)
    args = parser.parse_args()
    model = CHDP.load(args.model or ROOT / "models" / "chdp" / "CatchPoint-v0_1" / "CatchPoint-v0.zip", device="cpu")
    results = run(model, args.episodes)
    print("| distance | starts | within reach, % | success, % | misses | extra steps |")
    print("|---|---|---|---|---|---|")
    for low, high in [*pairwise(DISTANCES), (0.0, np.inf)]:
        distance, fewest, steps, misses, success = results[(results[:, 0] >= low) & (results[:, 0] < high)].T
        in_reach, extra = 100 * np.mean(fewest <= MAX_STEPS), (steps - fewest)[success == 1]
        name = "all" if high == np.inf else f"{low:g} to {high:g}"
        extra_steps = f"{extra.mean():.1f}" if len(extra) else ""
        numbers = f"{len(distance)} | {in_reach:.1f} | {100 * success.mean():.1f} | {misses.mean():.1f} | {extra_steps}"
        print(f"| {name} | {numbers} |", flush=True)


if __name__ == "__main__":
    main()
