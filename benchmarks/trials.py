"""
The log of all tuning runs, results/trials.csv: a line per run, written by reproduce.py into folders of their own.

    python benchmarks/reproduce.py main --algos chdp --envs Goal-v0 --seeds 0 --set gamma=0.9 --out ~/tune/goal-gamma
    python benchmarks/trials.py ~/tune                add what is below ~/tune

A line holds the folder's name as the name of the trial, what the run changed of its YAML file as it was at that commit, and
the scores as in the tables: means over the last five evaluations. Runs that were stopped early count, with a mark.
"""

import argparse
import json
from pathlib import Path

import pandas as pd
from cells import RESULTS
from tables import LAST_EVALUATIONS

LOG = RESULTS / "trials.csv"


def read_trials(folder: Path) -> pd.DataFrame:
    """:return: a line per run below the folder"""
    lines = []
    for meta_path in sorted([*folder.glob("*/*/*/*/seed_*.json"), *folder.glob("*/*/*/*/seed_*.started")]):
        meta = json.loads(meta_path.read_text())
        curve = pd.read_csv(meta_path.with_suffix(".csv"))
        if curve.empty:
            continue
        last = curve.tail(LAST_EVALUATIONS)
        lines.append(
            {
                "trial": meta_path.relative_to(folder).parts[0],
                "commit": meta["commit"][:7] + ("-dirty" if meta["commit"].endswith("-dirty") else ""),
                "algorithm": meta["algo"],
                "environment": meta["env_id"],
                "seed": meta["seed"],
                "changes": " ".join(f"{key}={value}" for key, value in meta["overrides"].items()),
                "timesteps": curve["timesteps"].max(),
                "gradient_steps": curve["gradient_steps"].max(),
                "minutes": round(curve["seconds"].max() / 60, 1),
                "success": round(100 * last["success"].mean(), 1),
                "best_success": round(100 * curve["success"].max(), 1),
                "return": round(last["return"].mean(), 3),
                "stopped": meta_path.suffix == ".started",
            }
        )
    return pd.DataFrame(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    trials = read_trials(parser.parse_args().folder)
    if LOG.exists():
        trials = pd.concat([pd.read_csv(LOG), trials])
    key = ["trial", "commit", "algorithm", "environment", "seed"]
    trials = trials.fillna({"changes": ""}).drop_duplicates(key, keep="last")
    trials.to_csv(LOG, index=False)
    print(trials.to_string(index=False))


if __name__ == "__main__":
    main()
