"""
The published table: what was run for it (``protocol.yml``), and what the paper prints (``paper.yml``).

A line of the protocol is a cell: ``environment``, ``algorithm`` (of an ablation also its ``variant``), ``steps``, ``seeds``
with the commit of each, ``eval_freq`` where it was not a thirtieth of the steps, and ``deviations``, the settings of its runs
that are not those of the YAML files today.
"""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from sb3_chdp.benchmark.results import differences, read_meta
from sb3_chdp.benchmark.runs import Run

PROTOCOL = Path(__file__).with_name("protocol.yml")
PAPER = Path(__file__).with_name("paper.yml")
# The table of the algorithms; the others are CHDP with its one setting, and ablations
MAIN = "main"
EVAL_EPISODES = 100
COMMIT_DIGITS = 12
Cell = dict[str, Any]


def load_protocol() -> dict[str, list[Cell]]:
    """:return: cells of every table"""
    protocol: dict[str, list[Cell]] = yaml.safe_load(PROTOCOL.read_text())
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


def deviation_column(cells: list[Cell]) -> Callable[[str, str], str]:
    """:return: a column that marks the cells whose settings are not those of today"""
    deviate = {(cell.get("variant", cell["algorithm"]), cell["environment"]) for cell in cells if "deviations" in cell}

    def column(row: str, env: str) -> str:
        return "others" if (row, env) in deviate else "today's"

    return column


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
        for cell in load_protocol()[MAIN]
        for seed in cell["seeds"]
    ]


def deviations_of(meta: dict[str, Any], table: str) -> list[str]:
    """
    :param meta: JSON of a published run
    :param table: its table; in an ablation what the JSON calls overrides belongs to the variant
    :return: settings that are not those of the YAML files today
    """
    from sb3_chdp.benchmark.manager import settings_of

    overrides = {} if table == MAIN else meta["overrides"]
    today = Run(meta["name"], meta["algo"], meta["env_id"], meta["seed"], "", overrides=overrides)
    return differences(meta["settings"], settings_of(today))


def _steps_of(meta: dict[str, Any]) -> int:
    return int(float(meta["settings"]["n_timesteps"]))


def _short(commit: str) -> str:
    digits, *dirty = commit.split("-")  # "-dirty" behind it: with uncommitted changes
    return "-".join([digits[:COMMIT_DIGITS], *dirty])


def describe_cells(results: Path, table: str) -> list[Cell]:
    """
    :param results: folder of the published results
    :param table: a folder in it
    :return: cells of the protocol, as the files tell
    """
    cells: list[Cell] = []
    for folder in sorted({path.parent for path in (results / table).glob("*/*/seed_*.json")}):
        of_folder = sorted((read_meta(path) for path in folder.glob("seed_*.json")), key=lambda meta: meta["seed"])
        for steps in sorted({_steps_of(meta) for meta in of_folder}):
            metas = [meta for meta in of_folder if _steps_of(meta) == steps]
            cell: Cell = {"environment": metas[0]["env_id"], "algorithm": metas[0]["algo"]}
            if metas[0]["name"] != metas[0]["algo"]:
                cell["variant"] = metas[0]["name"]
            cell["steps"] = steps
            if metas[0]["eval_freq"] is not None:
                cell["eval_freq"] = metas[0]["eval_freq"]
            cell["seeds"] = {meta["seed"]: _short(meta["commit"]) for meta in metas}
            deviations = sorted({name for meta in metas for name in deviations_of(meta, table)})
            if deviations:
                cell["deviations"] = deviations
            cells.append(cell)
    return cells
