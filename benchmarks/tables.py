"""
Tables and figures from the CSVs that reproduce.py leaves; tables replace the sections of benchmarks/README.md and README.md.

    python benchmarks/tables.py             tables, figures/curves.png and figures/scores.png
    python benchmarks/tables.py --print     tables, printed only

The score of a run is the mean over its last five evaluations; a table entry is mean and sample standard deviation over
seeds. Runs that are not complete do not count.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from cells import RESULTS, ROOT
from matplotlib.ticker import NullFormatter
from rliable import library, metrics

from sb3_chdp.envs import ENV_IDS

README = ROOT / "README.md"
FIGURES = ROOT / "figures"
LAST_EVALUATIONS = 5
BOOTSTRAP_REPEATS = 2000
NAMES = {
    "hppo": "HPPO",
    "pa_td3": "PA-TD3",
    "pdqn_td3": "PDQN-TD3",
    "hhqn_td3": "HHQN-TD3",
    "hyar_td3": "HyAR-TD3",
    "chdp": "CHDP",
    "full": "CHDP, full",
    "without_diffusion": "without diffusion policies",
    "without_codebook": "without codebook",
    "without_sequential_update": "without sequential update",
    "without_both": "without both",
}
# The paper's success rates in percent over 5 seeds, for Platform probably 100 x the mean return; columns as in NAMES
PAPER_MAIN = {
    "Platform-v0": "66.3 ± 0.9|95.1 ± 3.6|96.7 ± 4.1|56.7 ± 29.4|96.6 ± 2.2|99.7 ± 0.2",
    "Goal-v0": "0.0 ± 0.0|0.0 ± 0.0|71.4 ± 4.3|0.0 ± 0.0|77.3 ± 4.2|80.9 ± 4.9",
    "HardGoal-v0": "0.0 ± 0.0|43.0 ± 10.0|0.0 ± 0.0|1.2 ± 0.7|60.2 ± 5.0|79.5 ± 5.0",
    "CatchPoint-v0": "55.7 ± 5.2|86.7 ± 8.3|89.8 ± 3.2|23.7 ± 5.5|86.6 ± 0.9|93.8 ± 0.6",
    "HardMove4-v0": "3.3 ± 1.3|63.9 ± 20.5|79.7 ± 4.8|81.8 ± 3.5|91.4 ± 2.4|94.2 ± 1.7",
    "HardMove6-v0": "2.5 ± 0.4|9.8 ± 5.6|31.1 ± 8.1|47.1 ± 27.6|92.3 ± 0.6|93.9 ± 1.0",
    "HardMove8-v0": "2.3 ± 0.9|4.6 ± 2.1|6.6 ± 2.5|18.8 ± 8.9|88.3 ± 1.9|90.6 ± 2.2",
    "HardMove10-v0": "3.4 ± 0.5|10.3 ± 2.0|3.3 ± 0.5|11.3 ± 6.3|69.0 ± 5.6|79.8 ± 5.4",
}
PAPER_ABLATION = {
    "HardGoal-v0": "81.8 ± 3.5|49.8 ± 26.9|73.3 ± 7.8|53.5 ± 14.5|52.4 ± 13.7",
    "HardMove6-v0": "94.4 ± 1.2|88.2 ± 5.6|56.1 ± 12.5|92.3 ± 4.5|54.6 ± 9.6",
}
ROWS = {"main": list(NAMES)[:6], "ablation": list(NAMES)[6:]}


def paper_values(table: str, lines: dict[str, str]) -> dict[tuple[str, str], str]:
    """:return: entry of every (row, environment)"""
    return {
        (row, env_id): value for env_id, line in lines.items() for row, value in zip(ROWS[table], line.split("|"), strict=True)
    }


PAPER = {"main": paper_values("main", PAPER_MAIN), "ablation": paper_values("ablation", PAPER_ABLATION)}


def read_runs(folder: Path) -> pd.DataFrame:
    """:return: all evaluations of the complete runs of a table, in percent where a success rate is meant"""
    runs = []
    for meta_path in sorted(folder.glob("*/*/seed_*.json")):
        meta = json.loads(meta_path.read_text())
        run = pd.read_csv(meta_path.with_suffix(".csv"))
        runs.append(run.assign(row=meta["name"], env=meta["env_id"], seed=meta["seed"], success=100 * run["success"]))
    return pd.concat(runs) if runs else pd.DataFrame(columns=["row", "env", "seed"])


def scores_of(runs: pd.DataFrame) -> pd.DataFrame:
    """:return: a line per run: means over its last evaluations, and its length"""
    groups = runs.groupby(["row", "env", "seed"])
    last = groups.tail(LAST_EVALUATIONS).groupby(["row", "env", "seed"])[["success", "return"]].mean()
    return last.join(groups[["timesteps", "gradient_steps", "seconds"]].max()).reset_index()


def interval(data: np.ndarray | tuple[np.ndarray, np.ndarray], metric: Callable) -> tuple[float, float, float]:
    """:return: a metric of (seeds, 1) scores and its 95 % bootstrap interval over seeds (rliable)"""
    np.random.seed(0)  # the same files give the same tables; rliable ignores its argument random_state
    point, bounds = library.get_interval_estimates({"x": data}, lambda *x: np.ravel(metric(*x)), reps=BOOTSTRAP_REPEATS)
    return float(point["x"][0]), float(bounds["x"][0, 0]), float(bounds["x"][1, 0])


def mean_and_std(values: np.ndarray) -> str:
    return f"{values.mean():.1f}" + (f" ± {values.std(ddof=1):.1f}" if len(values) > 1 else "")


def markdown(table: str, scores: pd.DataFrame) -> str:
    """:return: one line per run group: ours beside the paper's"""
    lines = [
        "| environment | algorithm | success, % | seeds | IQM [95 %] | paper | environment steps | gradient steps | minutes |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for env_id in ENV_IDS:
        for row in ROWS[table]:
            cell = scores[(scores["env"] == env_id) & (scores["row"] == row)].sort_values("seed")
            if cell.empty:
                continue
            successes = cell["success"].to_numpy()
            entry = mean_and_std(successes)
            if env_id == "Platform-v0":
                entry += f" (return x 100: {mean_and_std(100 * cell['return'].to_numpy())})"
            iqm, low, high = interval(successes[:, None], metrics.aggregate_iqm)
            singles = ", ".join(f"{value:.1f}" for value in successes)
            lines.append(
                f"| {env_id} | {NAMES[row]} | {entry} | {singles} | {iqm:.1f} [{low:.1f}, {high:.1f}] "
                f"| {PAPER[table].get((row, env_id), '')} | {cell['timesteps'].max():,} | {cell['gradient_steps'].max():,} "
                f"| {cell['seconds'].mean() / 60:.0f} |"
            )
    return "\n".join(lines)


def overview(scores: pd.DataFrame) -> str:
    """:return: the README's table: a line per algorithm, a column per environment that has been run, the paper in brackets"""
    envs = [env_id for env_id in ENV_IDS if env_id in set(scores["env"])]
    lines = ["| algorithm | " + " | ".join(envs) + " |", "|---|" + "---|" * len(envs)]
    for row in ROWS["main"]:
        entries = []
        for env_id in envs:
            cell = scores[(scores["env"] == env_id) & (scores["row"] == row)]
            if cell.empty:
                entries.append(f"[{PAPER['main'][row, env_id]}]")
                continue
            entry = mean_and_std(cell["success"].to_numpy())
            if env_id == "Platform-v0":
                entry += f", return x 100: {mean_and_std(100 * cell['return'].to_numpy())}"
            seeds = "" if len(cell) >= 3 else f", seeds: {len(cell)}"
            entries.append(f"{entry} ({cell['timesteps'].max() / 1000:.0f} k steps{seeds}) [{PAPER['main'][row, env_id]}]")
        lines.append(f"| {NAMES[row]} | " + " | ".join(entries) + " |")
    return "\n".join(lines)


def improvement(scores: pd.DataFrame) -> str:
    """:return: probability that a run of CHDP is better than one of HyAR-TD3, per environment"""
    lines = ["| environment | P(CHDP > HyAR-TD3) [95 %] |", "|---|---|"]
    for env_id in ENV_IDS:
        ours, theirs = (
            scores[(scores["env"] == env_id) & (scores["row"] == row)]["success"].to_numpy()[:, None]
            for row in ("chdp", "hyar_td3")
        )
        if min(len(ours), len(theirs)) < 3:
            continue
        point, low, high = interval((ours, theirs), metrics.probability_of_improvement)
        lines.append(f"| {env_id} | {point:.2f} [{low:.2f}, {high:.2f}] |")
    return "\n".join(lines) if len(lines) > 2 else ""


def plot_curves(runs: pd.DataFrame) -> None:
    """Learning curves, a panel per environment: mean and standard deviation over seeds."""
    figure, axes = plt.subplots(2, 4, figsize=(16, 7), sharey=True)
    for axis, env_id in zip(axes.flat, ENV_IDS, strict=True):
        for index, row in enumerate(ROWS["main"]):
            cell = runs[(runs["env"] == env_id) & (runs["row"] == row)]
            if cell.empty:
                continue
            curve = cell.groupby("timesteps")["success"].agg(["mean", "std"]).fillna(0)
            axis.plot(curve.index, curve["mean"], color=f"C{index}", label=NAMES[row])
            axis.fill_between(
                curve.index, curve["mean"] - curve["std"], curve["mean"] + curve["std"], color=f"C{index}", alpha=0.2
            )
        axis.set(title=env_id, xlabel="environment steps", ylim=(0, 102))
        if axis.lines:
            # Budgets differ by a factor of 17
            axis.set_xscale("log")
            axis.xaxis.set_minor_formatter(NullFormatter())
            axis.legend(fontsize=8)
    for axis in axes[:, 0]:
        axis.set_ylabel("success, %")
    figure.tight_layout()
    figure.savefig(FIGURES / "curves.png", dpi=100)


def plot_scores(scores: pd.DataFrame) -> None:
    """Final scores: interquartile mean with bootstrap interval, single seeds, and the paper's mean as a cross."""
    figure, axes = plt.subplots(2, 4, figsize=(16, 6), sharex=True, sharey=True)
    for axis, env_id in zip(axes.flat, ENV_IDS, strict=True):
        for index, row in enumerate(ROWS["main"]):
            axis.plot(float(PAPER["main"][row, env_id].split()[0]), index, "x", color="black")
            successes = scores[(scores["env"] == env_id) & (scores["row"] == row)]["success"].to_numpy()
            if len(successes) == 0:
                continue
            iqm, low, high = interval(successes[:, None], metrics.aggregate_iqm)
            axis.barh(index, high - low, left=low, color=f"C{index}", alpha=0.4)
            axis.plot(successes, [index] * len(successes), ".", color=f"C{index}")
            axis.plot([iqm, iqm], [index - 0.4, index + 0.4], color=f"C{index}")
        axis.set(title=env_id, xlim=(-2, 102), yticks=range(6), yticklabels=[NAMES[row] for row in ROWS["main"]])
    for axis in axes[1]:
        axis.set_xlabel("success, % (x: paper)")
    figure.tight_layout()
    figure.savefig(FIGURES / "scores.png", dpi=100)


def replace_section(path: Path, name: str, text: str) -> None:
    """Replace what stands between the two markers of a section of a Markdown file."""
    start, end = (f"<!-- {name}: {place} -->" for place in ("start", "end"))
    before, rest = path.read_text().split(start)
    path.write_text(f"{before}{start}\n{text}\n{end}{rest.split(end)[1]}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--print", action="store_true", dest="only_print")
    args = parser.parse_args()
    runs = read_runs(args.results / "main")
    scores = scores_of(runs)
    parts = [markdown("main", scores), improvement(scores)]
    for table, whose in (("ablation", "the paper's"), ("ablation_tuned", "our")):
        ablation = read_runs(args.results / table)
        if not ablation.empty:
            parts += [f"### Ablation with {whose} settings", markdown("ablation", scores_of(ablation))]
    text = "\n\n".join(part for part in parts if part)
    print(text)
    if args.only_print:
        return
    replace_section(README, "tables", text)
    replace_section(ROOT.parent / "README.md", "tables", overview(scores))
    FIGURES.mkdir(exist_ok=True)
    plot_curves(runs)
    plot_scores(scores)


if __name__ == "__main__":
    main()
