"""Learning curves and scores as PNG, of any number of algorithms and environments. Needs no display."""

from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

from sb3_chdp.benchmark.runs import display_name
from sb3_chdp.benchmark.statistics import cell_of, iqm

MAX_COLUMNS = 4
# Budgets that differ by more are shown on a logarithmic axis
LINEAR_RANGE = 4
DPI = 110


def colors_of(rows: list[str]) -> dict[str, tuple[float, ...]]:
    """:return: colour of every algorithm, ten distinct ones, then twenty"""
    palette = matplotlib.colormaps["tab10" if len(rows) <= 10 else "tab20"]
    return {row: palette(index % palette.N) for index, row in enumerate(rows)}


def panels(envs: list[str], height: float) -> tuple[Figure, list[Axes]]:
    """:return: a figure with a panel per environment, in rows of at most four"""
    n_columns = min(len(envs), MAX_COLUMNS)
    n_rows = -(-len(envs) // n_columns)
    figure = Figure(figsize=(4.2 * n_columns + 1, height * n_rows + 0.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = list(figure.subplots(n_rows, n_columns, squeeze=False).flat)
    for axis in axes[len(envs) :]:
        axis.remove()
    return figure, axes[: len(envs)]


def curve_of(cell: pd.DataFrame, x: str, y: str) -> pd.DataFrame:
    """:return: per evaluation the mean of x, and mean and standard deviation of y, over seeds"""
    evaluation = cell.groupby("seed").cumcount()
    groups = cell.groupby(evaluation)
    # Evaluations that not all seeds have reached would jump
    complete = groups["seed"].count() == cell["seed"].nunique()
    curve = pd.DataFrame({"x": groups[x].mean(), "mean": groups[y].mean(), "std": groups[y].std().fillna(0)})
    return curve[complete]


def plot_curves(results: pd.DataFrame, scores: pd.DataFrame, rows: list[str], envs: list[str], x: str, path: Path) -> None:
    """
    Learning curves: mean and standard deviation over seeds.

    :param results: evaluations
    :param scores: scores, which tell what is shown
    :param rows: algorithms; the first is drawn on top
    :param envs: environments, a panel each
    :param x: ``timesteps`` or ``minutes``
    :param path: file to write
    """
    results = results.assign(minutes=results["seconds"] / 60)
    label = {"timesteps": "environment steps", "minutes": "minutes of training, without evaluations"}[x]
    figure, axes = panels(envs, 3.2)
    colors = colors_of(rows)
    for axis, env in zip(axes, envs, strict=True):
        metric = scores[scores["env"] == env]["metric"].iloc[0]
        column = "return" if metric == "return" else "success"
        ends = []
        for index, row in enumerate(rows):
            cell = cell_of(results, row, env)
            if cell.empty:
                continue
            curve = curve_of(cell.sort_values(["seed", "timesteps"]), x, column)
            low, high = curve["mean"] - curve["std"], curve["mean"] + curve["std"]
            if column == "success":
                low, high = low.clip(0, 100), high.clip(0, 100)
            front = len(rows) - index
            axis.plot(curve["x"], curve["mean"], color=colors[row], label=display_name(row), zorder=2 + front)
            axis.fill_between(curve["x"], low, high, color=colors[row], alpha=0.15, linewidth=0)
            ends.append(curve["x"].iloc[-1])
        axis.set(title=env, xlabel=label, ylabel=metric)
        if column == "success":
            axis.set_ylim(-2, 102)
        if max(ends) > LINEAR_RANGE * min(ends):
            axis.set_xscale("log")
            axis.xaxis.set_minor_formatter(NullFormatter())
        axis.grid(alpha=0.3)
    one_legend(figure, axes)
    save(figure, path)


def one_legend(figure: Figure, axes: list[Axes]) -> None:
    """Show every algorithm once, beside the panels."""
    handles: dict[str, Artist] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(list(handles.values()), list(handles), loc="outside right upper", frameon=False)


def plot_scores(
    scores: pd.DataFrame, rows: list[str], envs: list[str], path: Path, marks: Callable[[str, str], float | None] | None = None
) -> None:
    """
    Scores: interquartile mean with its interval, and single seeds.

    :param scores: scores
    :param rows: algorithms, the first on top
    :param envs: environments, a panel each
    :param path: file to write
    :param marks: published figure of an algorithm on an environment, shown as a cross
    """
    figure, axes = panels(envs, 0.6 + 0.33 * len(rows))
    colors = colors_of(rows)
    for axis, env in zip(axes, envs, strict=True):
        metric = scores[scores["env"] == env]["metric"].iloc[0]
        for place, row in enumerate(rows):
            mark = marks(row, env) if marks is not None and metric != "return" else None
            if mark is not None:
                axis.plot(mark, place, "x", color="black", zorder=4)
            values = cell_of(scores, row, env)["score"].to_numpy()
            if not len(values):
                continue
            axis.plot(values, np.full(len(values), place), ".", color=colors[row])
            middle, low, high = iqm(values) if len(values) > 1 else (values[0],) * 3
            axis.barh(place, high - low, left=low, height=0.7, color=colors[row], alpha=0.35)
            axis.plot([middle, middle], [place - 0.35, place + 0.35], color=colors[row])
        axis.set(title=env, yticks=range(len(rows)), ylim=(len(rows) - 0.4, -0.6))
        axis.set_yticklabels([display_name(row) for row in rows])
        axis.set_xlabel(metric + (" (x: paper)" if marks is not None else ""))
        if metric != "return":
            axis.set_xlim(-2, 102)
        axis.grid(alpha=0.3, axis="x")
    save(figure, path)


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DPI)
