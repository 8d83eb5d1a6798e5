"""
The published table: what was run for it (``protocol.yml``), and what the paper prints (``paper.yml``).

A line of the protocol is a cell: ``environment``, ``algorithm``, ``steps``, ``seeds`` with the commit of each, ``eval_freq``
where it was not a thirtieth of the steps, and ``deviations``, the settings of its runs that are not those of the YAML files
today.
"""

from functools import cache
from pathlib import Path
from typing import Any

import yaml

from sb3_chdp.benchmark.runs import Run

PROTOCOL = Path(__file__).with_name("protocol.yml")
PAPER = Path(__file__).with_name("paper.yml")
EVAL_EPISODES = 100
Cell = dict[str, Any]


def load_protocol() -> list[Cell]:
    """:return: cells of the table"""
    protocol: list[Cell] = yaml.safe_load(PROTOCOL.read_text())
    return protocol


@cache
def _paper_figures() -> dict[str, dict[str, list[float]]]:
    figures: dict[str, dict[str, list[float]]] = yaml.safe_load(PAPER.read_text())
    return figures


def paper_figure(row: str, env: str) -> tuple[float, float] | None:
    """:return: mean and standard deviation that the paper prints, None if it has none"""
    figure = _paper_figures().get(env, {}).get(row)
    return None if figure is None else (figure[0], figure[1])


def paper_column(row: str, env: str) -> str:
    """:return: entry of the column ``paper`` of a table"""
    figure = paper_figure(row, env)
    return "" if figure is None else f"{figure[0]} ± {figure[1]}"


def paper_mean(row: str, env: str) -> float | None:
    """:return: the paper's mean, None if it has none"""
    figure = paper_figure(row, env)
    return None if figure is None else figure[0]


def published_runs(out: str, **settings: Any) -> list[Run]:
    """
    :param out: folder of the results
    :param settings: further arguments of :class:`Run`
    :return: the runs of the published table, with the settings of the YAML files today
    """
    return [
        Run(
            name=cell["algorithm"],
            algo=cell["algorithm"],
            env_id=cell["environment"],
            seed=seed,
            out=out,
            overrides={"n_timesteps": cell["steps"]},
            eval_freq=cell.get("eval_freq"),
            eval_episodes=EVAL_EPISODES,
            **settings,
        )
        for cell in load_protocol()
        for seed in cell["seeds"]
    ]
