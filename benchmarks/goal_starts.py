"""
Success of a model of CHDP on Goal or Hard Goal by the height of the start.

    python benchmarks/goal_starts.py                      the published model of Hard Goal
    python benchmarks/goal_starts.py --model benchmarks/results/main/chdp/HardGoal-v0/seed_113.zip

Deterministic predictions from 2,000 starts evenly spaced, of which an evaluation draws 100 at random; and how often a kick to
(0, 0) stays in play there, whatever the model: a bound for starts from which shots do not score.
"""

from itertools import pairwise
from typing import Any

import numpy as np
from goal_kicks import model_and_env, play

EDGES = np.linspace(-15, 15, 21)
# Starts per range
N_STARTS = 100


def share_in_play(env: Any, heights: np.ndarray) -> float:
    """:return: share of first kicks to (0, 0) after which the episode goes on, one from every height"""
    kick = (np.zeros(2, dtype=np.float32), *(space.low for space in env.action_space[1].spaces[1:]))
    in_play = []
    for y in heights:
        env._place_at_start(y)
        in_play.append(not env.step((0, kick))[2])
    return float(np.mean(in_play))


def main() -> None:
    model, env = model_and_env(__doc__)
    print("| start | success, % | steps | kick to 0 in play, % |")
    print("|---|---|---|---|")
    episodes = []
    for low, high in pairwise(EDGES):
        heights = np.linspace(low, high, N_STARTS, endpoint=False)
        of_range = [play(model, env, y) for y in heights]
        successes, lengths = zip(*of_range, strict=True)
        entries = [f"{100 * np.mean(successes):.0f}", f"{np.mean(lengths):.1f}", f"{100 * share_in_play(env, heights):.0f}"]
        print(f"| {low:g} to {high:g} | {' | '.join(entries)} |", flush=True)
        episodes += of_range
    successes, lengths = zip(*episodes, strict=True)
    print(f"| all | {100 * np.mean(successes):.1f} | {np.mean(lengths):.1f} | |")


if __name__ == "__main__":
    main()
