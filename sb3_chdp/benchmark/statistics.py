"""
Scores of runs and what they tell, after Agarwal et al., Deep RL at the Edge of the Statistical Precipice (NeurIPS 2021).

The score of a run is the mean over its last five evaluations: of success, where the environment reports it and any run has
some in these five, else of the return.
"""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
import pandas as pd
from rliable import library, metrics

LAST_EVALUATIONS = 5
BOOTSTRAP_REPEATS = 2000
Estimate = tuple[float, float, float]


def scores_of(results: pd.DataFrame) -> pd.DataFrame:
    """
    :param results: evaluations, from :func:`sb3_chdp.benchmark.results.read_results`
    :return: a line per run: ``metric`` ("success, %" or "return"), its ``score``, and its length in steps and seconds
    """
    keys = ["row", "env", "seed"]
    groups = results.groupby(keys, sort=False)
    last = results[groups.cumcount(ascending=False) < LAST_EVALUATIONS]
    means = last.groupby(keys, sort=False).agg({"success": lambda values: values.mean(skipna=False), "return": "mean"})
    scores = means.join(groups[["timesteps", "gradient_steps", "seconds"]].max()).reset_index()
    reported = scores.groupby("env")["success"].transform(lambda values: values.notna().all() and values.max() > 0)
    scores["metric"] = np.where(reported, "success, %", "return")
    scores["score"] = np.where(reported, scores["success"], scores["return"])
    return scores


def estimate(data: Any, metric: Callable[..., Any]) -> Estimate:
    """
    :param data: (seeds, environments) scores, or two such arrays
    :param metric: one of rliable's
    :return: the metric and its 95 % bootstrap interval over seeds
    """
    state = np.random.get_state()
    np.random.seed(0)  # the same scores give the same interval; rliable ignores its argument random_state
    try:
        point, bounds = library.get_interval_estimates({"x": data}, lambda *x: np.ravel(metric(*x)), reps=BOOTSTRAP_REPEATS)
    finally:
        np.random.set_state(state)
    return float(point["x"][0]), float(bounds["x"][0, 0]), float(bounds["x"][1, 0])


def iqm(scores: Sequence[float] | np.ndarray) -> Estimate:
    """
    :param scores: (seeds,) or (seeds, environments) scores
    :return: interquartile mean and its interval
    """
    array = np.asarray(scores, dtype=float)
    return _iqm(tuple(map(tuple, array.reshape(len(array), -1))))


@cache  # tables and figures show the same
def _iqm(scores: tuple[tuple[float, ...], ...]) -> Estimate:
    return estimate(np.array(scores), metrics.aggregate_iqm)


def probability_of_improvement(ours: Sequence[float] | np.ndarray, theirs: Sequence[float] | np.ndarray) -> Estimate:
    """
    :param ours: scores of an algorithm's seeds
    :param theirs: scores of another's
    :return: probability that a run of the one has a higher score than one of the other, and its interval
    """
    pair = tuple(np.asarray(scores, dtype=float).reshape(len(scores), -1) for scores in (ours, theirs))
    return estimate(pair, metrics.probability_of_improvement)


def cell_of(scores: pd.DataFrame, row: str, env: str) -> pd.DataFrame:
    """:return: the runs of an algorithm on an environment, by seed"""
    return scores[(scores["row"] == row) & (scores["env"] == env)].sort_values("seed")


def matrix_of(scores: pd.DataFrame, row: str) -> np.ndarray | None:
    """:return: (seeds, environments) success rates of an algorithm, None unless all environments have the same two or more"""
    envs = list(dict.fromkeys(scores["env"]))
    columns = [cell_of(scores, row, env)["score"].to_numpy() for env in envs]
    if (
        len(envs) < 2
        or "return" in set(scores["metric"])
        or len({len(column) for column in columns}) > 1
        or len(columns[0]) < 2
    ):
        return None
    return np.stack(columns, axis=1)
