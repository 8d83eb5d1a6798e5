"""
Success of a model by where an episode starts.

    python -m benchmarks.probes.starts                       the published model of Hard Goal
    python -m benchmarks.probes.starts --env Goal-v0
    python -m benchmarks.probes.starts --env CatchPoint-v0 --model my_model.zip

On Goal and Hard Goal: 2,000 evenly spaced heights of the player. On Catch Point: 2,000 random starts by the distance of the
target. "Within reach" are targets that straight pushes at once, then a catch, reach in 25 steps; a miss is a catch that fails.
"""

from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np

from benchmarks.probes.rollout import load_model, make_env, parser_of, play
from sb3_chdp.envs.catch_point import CATCH
from sb3_chdp.envs.point_mass import CAPTURE_RADIUS, DAMPING, DT, FORCE

HEIGHTS = np.linspace(-15, 15, 21)
DISTANCES = (0.0, 0.2, 0.3, 0.4, 1.0, 1.8, 1.9, 2.0, 2.9)
CATCH_POINT_STEPS = 25


def fewest_steps(distance: float) -> int:
    """:return: straight pushes and a catch to a target at this distance from an agent at rest"""
    velocity = position = 0.0
    steps = 1
    while position + DT * (1 - DAMPING) * velocity + CAPTURE_RADIUS < distance:
        velocity = (1 - DAMPING) * velocity + DT * FORCE
        position += DT * velocity
        steps += 1
    return steps


def goal_table(model: Any, env: gym.Env, episodes: int) -> list[str]:
    """:return: lines of a table: success and steps by the height of the start"""
    lines = ["| start | success, % | steps |", "|---|---|---|"]
    env.reset(seed=0)
    per_range, results = episodes // (len(HEIGHTS) - 1), []
    for low, high in [*pairwise(HEIGHTS), (HEIGHTS[0], HEIGHTS[-1])]:
        if high - low < 15:
            heights = np.linspace(low, high, per_range, endpoint=False)
            of_range = [play(model, env, options={"start": float(height)}) for height in heights]
            results += of_range
        else:
            of_range = results
        success = 100 * np.mean([episode.success for episode in of_range])
        lines.append(f"| {low:g} to {high:g} | {success:.1f} | {np.mean([len(e.actions) for e in of_range]):.1f} |")
    return lines


def catch_point_table(model: Any, env: gym.Env, episodes: int) -> list[str]:
    """:return: lines of a table: success and misses by the distance of the target"""
    lines = ["| distance | starts | within reach, % | success, % | misses |", "|---|---|---|---|---|"]
    results = []
    for seed in range(episodes):
        episode = play(model, env, seed=seed)
        distance = float(np.linalg.norm(episode.observations[0][2:]))
        catches = sum(action[0] == CATCH for action in episode.actions)
        results.append((distance, fewest_steps(distance) <= CATCH_POINT_STEPS, episode.success, catches - episode.success))
    table = np.array(results)
    for low, high in [*pairwise(DISTANCES), (DISTANCES[0], DISTANCES[-1])]:
        rows = table[(table[:, 0] >= low) & (table[:, 0] < high)]
        if len(rows):
            _, in_reach, success, misses = rows.mean(axis=0)
            lines.append(f"| {low:g} to {high:g} | {len(rows)} | {100 * in_reach:.1f} | {100 * success:.1f} | {misses:.1f} |")
    return lines


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--env", default="HardGoal-v0", choices=["Goal-v0", "HardGoal-v0", "CatchPoint-v0"])
    parser.add_argument("--model", help="zip of a trained model of CHDP (default: the published one)")
    parser.add_argument("--episodes", type=int, default=2000)
    args = parser.parse_args()
    table = catch_point_table if args.env == "CatchPoint-v0" else goal_table
    print("\n".join(table(load_model(args.env, path=args.model), make_env(args.env), args.episodes)))


if __name__ == "__main__":
    main()
