"""What was run for the published tables, read from the files of the runs; for that of the algorithms, ``protocol.yml``."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from sb3_chdp.benchmark.manager import settings_of
from sb3_chdp.benchmark.paper import Cell
from sb3_chdp.benchmark.results import differences, read_meta
from sb3_chdp.benchmark.runs import Run

COMMIT_DIGITS = 12
# The table of the algorithms; the others are CHDP with its one setting, and ablations
MAIN = "main"


def deviation_column(cells: list[Cell]) -> Callable[[str, str], str]:
    """:return: a column that marks the cells whose settings are not those of today"""
    deviate = {(cell.get("variant", cell["algorithm"]), cell["environment"]) for cell in cells if "deviations" in cell}

    def column(row: str, env: str) -> str:
        return "others" if (row, env) in deviate else "today's"

    return column


def deviations_of(meta: dict[str, Any], table: str) -> list[str]:
    """
    :param meta: JSON of a published run
    :param table: its table; in an ablation what the JSON calls overrides belongs to the variant
    :return: settings that are not those of the YAML files today
    """
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
    :return: a cell for each environment and algorithm or variant, as the files tell; see ``sb3_chdp/benchmark/paper.py``
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
