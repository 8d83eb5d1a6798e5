"""The files of a run: rows of evaluations as CSV, settings as JSON. Written whole, and read with care."""

import csv
import json
import math
import os
from pathlib import Path
from typing import Any

import pandas as pd

FIELDS = ("timesteps", "gradient_steps", "success", "return", "length", "seconds")
INTEGERS = ("timesteps", "gradient_steps")
Row = dict[str, float]


class ResultsError(ValueError):
    """A file of results that cannot be used; the message names it and the remedy."""


def _as_text(row: Row) -> str:
    return ",".join(str(int(row[key])) if key in INTEGERS else str(row[key]) for key in FIELDS) + "\n"


def write_text(path: Path, text: str) -> None:
    """Write a file so that another process sees the former one or all of the new one."""
    new = path.with_name(path.name + ".new")
    new.write_text(text)
    new.replace(path)


def write_rows(path: Path, rows: list[Row]) -> None:
    """Write all evaluations of a run."""
    write_text(path, ",".join(FIELDS) + "\n" + "".join(map(_as_text, rows)))


def append_row(path: Path, row: Row) -> None:
    """Append an evaluation by one call of the system: a process that is killed leaves the row or nothing of it."""
    descriptor = os.open(path, os.O_WRONLY | os.O_APPEND)
    try:
        os.write(descriptor, _as_text(row).encode())
    finally:
        os.close(descriptor)


def read_rows(path: Path) -> list[Row]:
    """
    :param path: CSV of a run
    :return: its evaluations; ``success`` is nan where the environment reports none
    :raises ResultsError: if a line is not one that :func:`append_row` wrote
    """
    lines = list(csv.reader(path.read_text().splitlines()))
    remedy = f"delete it and {path.with_suffix('.json').name} beside it, and the run is trained anew"
    if not lines or tuple(lines[0]) != FIELDS:
        raise ResultsError(f"{path} does not start with the line {','.join(FIELDS)}: {remedy}")
    rows: list[Row] = []
    for number, line in enumerate(lines[1:], start=2):
        try:
            row = dict(zip(FIELDS, map(float, line), strict=True))
        except ValueError:
            row = {}
        if not row or any(math.isnan(value) for key, value in row.items() if key != "success"):
            raise ResultsError(f"{path}, line {number} is damaged ({','.join(line)!r}): {remedy}")
        if rows and row["timesteps"] <= rows[-1]["timesteps"]:
            raise ResultsError(f"{path}, line {number} goes back from step {rows[-1]['timesteps']:.0f}: {remedy}")
        rows.append(row)
    return rows


def read_meta(path: Path) -> dict[str, Any]:
    """
    :param path: JSON of a run
    :return: its settings and where they were trained
    :raises ResultsError: if it is not JSON
    """
    try:
        meta: dict[str, Any] = json.loads(path.read_text())
    except ValueError as error:
        raise ResultsError(f"{path} is damaged ({error}): delete it, and the run is trained anew") from error
    return meta


def read_results(folder: Path) -> pd.DataFrame:
    """
    :param folder: the ``--out`` of a benchmark
    :return: a line per evaluation of the finished runs, with their ``row``, ``env`` and ``seed``; success in percent
    :raises ResultsError: if a file is damaged, or if there is no finished run
    """
    runs = []
    for meta_path in sorted(folder.glob("*/*/seed_*.json")):
        meta = read_meta(meta_path)
        csv_path = meta_path.with_suffix(".csv")
        if not csv_path.exists():
            raise ResultsError(f"{meta_path} has no {csv_path.name} beside it: delete it, and the run is trained anew")
        run = pd.DataFrame(read_rows(csv_path), columns=list(FIELDS))
        runs.append(run.assign(row=meta["name"], env=meta["env_id"], seed=meta["seed"], success=100 * run["success"]))
    if not runs:
        raise ResultsError(f"no finished run below {folder}")
    return pd.concat(runs, ignore_index=True)


def differences(ours: dict[str, Any], theirs: dict[str, Any]) -> list[str]:
    """
    :param ours: settings of a run
    :param theirs: those of another
    :return: names of the settings that differ, sorted; ``monitor_kwargs`` does not count, it changes a log file only
    """

    def same(one: Any, other: Any) -> bool:
        try:
            return float(one) == float(other)
        except (TypeError, ValueError):
            return str(one) == str(other)

    keys = ({*ours} | {*theirs}) - {"monitor_kwargs"}
    return sorted(key for key in keys if key not in ours or key not in theirs or not same(ours[key], theirs[key]))
