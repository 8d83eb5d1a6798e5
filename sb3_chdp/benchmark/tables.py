"""Tables in Markdown, of any number of algorithms and environments."""

from collections.abc import Callable, Iterable, Mapping

import numpy as np
import pandas as pd

from sb3_chdp.benchmark.runs import display_name
from sb3_chdp.benchmark.statistics import Estimate, cell_of, iqm, matrix_of, probability_of_improvement

# What stands in a column of its own beside the scores: algorithm and environment to text
Column = Callable[[str, str], str]


def order(names: pd.Series, first: list[str]) -> list[str]:
    """:return: the distinct names, those of a list first and in its order"""
    found = set(names)
    return list(dict.fromkeys([*(name for name in first if name in found), *names]))


def numbers(values: Iterable[float]) -> list[str]:
    """:return: numbers with as many digits as the largest needs: one behind the point, three if all are below 2"""
    values = list(values)
    digits = 1 if max(map(abs, values)) >= 2 or not any(values) else 3
    return [f"{value:.{digits}f}" for value in values]


def mean_and_std(values: np.ndarray) -> str:
    """:return: mean and sample standard deviation"""
    return " ± ".join(numbers([values.mean(), values.std(ddof=1)] if len(values) > 1 else values))


def interval(values: Estimate) -> str:
    """:return: an estimate and its interval"""
    point, low, high = numbers(values)
    return f"{point} [{low}, {high}]"


def markdown(header: list[str], lines: list[list[str]]) -> str:
    """:return: a table"""
    return "\n".join("| " + " | ".join(line) + " |" for line in [header, ["---"] * len(header), *lines])


def score_table(scores: pd.DataFrame, rows: list[str], envs: list[str], columns: Mapping[str, Column] | None = None) -> str:
    """
    :param scores: from :func:`sb3_chdp.benchmark.statistics.scores_of`
    :param rows: algorithms, in the order of the table
    :param envs: environments, in the order of the table
    :param columns: further columns by their names
    :return: a line per algorithm and environment that has been run
    """
    columns = columns or {}
    header = ["environment", "algorithm", "score", "mean ± std", "seeds", "IQM [95 %]", *columns]
    lines = []
    for env in envs:
        for row in rows:
            cell = cell_of(scores, row, env)
            if cell.empty:
                continue
            values = cell["score"].to_numpy()
            lines.append(
                [env, display_name(row), cell["metric"].iloc[0], mean_and_std(values), ", ".join(numbers(values))]
                + [interval(iqm(values)) if len(values) > 1 else ""]
                + [column(row, env) for column in columns.values()]
                + [mean_and_std(cell["return"].to_numpy()), f"{cell['timesteps'].max():,.0f}"]
                + [f"{cell['gradient_steps'].max():,.0f}", f"{cell['seconds'].mean() / 60:.1f}"]
            )
    return markdown([*header, "return", "environment steps", "gradient steps", "minutes"], lines)


def aggregate_table(scores: pd.DataFrame, rows: list[str]) -> str:
    """:return: interquartile means over all environments, "" unless all report success and have been run as often"""
    matrices = {row: matrix_of(scores, row) for row in rows}
    lines = [[display_name(row), interval(iqm(matrix))] for row, matrix in matrices.items() if matrix is not None]
    return markdown(["algorithm", "success over all environments, IQM [95 %]"], lines) if lines else ""


def improvement_table(scores: pd.DataFrame, rows: list[str], envs: list[str]) -> str:
    """:return: probability that a run of the first algorithm beats one of each other, "" without two seeds of any"""
    first, *others = rows
    lines = []
    for env in envs:
        ours = cell_of(scores, first, env)["score"].to_numpy()
        entries = []
        for other in others:
            theirs = cell_of(scores, other, env)["score"].to_numpy()
            if min(len(ours), len(theirs)) < 2:
                entries.append("")
                continue
            point, low, high = probability_of_improvement(ours, theirs)
            entries.append(f"{point:.2f} [{low:.2f}, {high:.2f}]")
        if any(entries):
            lines.append([env, *entries])
    header = [f"P({display_name(first)} > ...) [95 %]", *map(display_name, others)]
    return markdown(header, lines) if lines else ""


def untrained(scores: pd.DataFrame) -> str:
    """:return: a sentence about runs that ended before their first gradient step, "" if there are none"""
    without = scores[scores["gradient_steps"] == 0][["row", "env"]].drop_duplicates().itertuples(index=False)
    names = ", ".join(f"{display_name(row)} on {env}" for row, env in without)
    return names and f"**Not trained**: {names}. Too few environment steps for a single gradient step."


def report(scores: pd.DataFrame, rows: list[str], envs: list[str], columns: Mapping[str, Column] | None = None) -> str:
    """:return: all tables"""
    parts = [score_table(scores, rows, envs, columns), aggregate_table(scores, rows), improvement_table(scores, rows, envs)]
    parts.append(untrained(scores))
    return "\n\n".join(part for part in parts if part)
