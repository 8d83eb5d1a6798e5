"""
Success of a model of CHDP on Goal or Hard Goal by the height of the start.

    python benchmarks/goal_starts.py                      the published model of Hard Goal
    python benchmarks/goal_starts.py --model benchmarks/results/main/chdp/HardGoal-v0/seed_113.zip

Deterministic predictions from 2,000 starts evenly spaced, of which an evaluation draws 100 at random.
"""

from itertools import pairwise

import numpy as np
from goal_kicks import model_and_env, play

EDGES = np.linspace(-15, 15, 21)
# Starts per range
N_STARTS = 100


def main() -> None:
    model, env = model_and_env(__doc__)
    print("| start | success, % | steps |")
    print("|---|---|---|")
    episodes = []
    for low, high in pairwise(EDGES):
        of_range = [play(model, env, y) for y in np.linspace(low, high, N_STARTS, endpoint=False)]
        successes, lengths = zip(*of_range, strict=True)
        print(f"| {low:g} to {high:g} | {100 * np.mean(successes):.0f} | {np.mean(lengths):.1f} |", flush=True)
        episodes += of_range
    successes, lengths = zip(*episodes, strict=True)
    print(f"| all | {100 * np.mean(successes):.1f} | {np.mean(lengths):.1f} |")


if __name__ == "__main__":
    main()
