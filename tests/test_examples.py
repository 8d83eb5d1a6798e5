"""The scripts in examples run as the documentation says, wherever their packages are installed."""

import importlib.util
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "examples"
# Script to the package that it needs
PACKAGES = {
    "sliding": None,
    "cartpole": None,
    "shoot": "hybrid_shoot",
    "uav": "pyRDDLGym",
    "rover": "pyRDDLGym",
    "cogen": "sustaingym",
    "grid": "grid2op",
}
HELPERS = {"compare", "sliding_env"}
RETURNS = ("random actions", "simple rule", "before training", "after training")


def test_every_script_is_tested_and_documented():
    assert {path.stem for path in FOLDER.glob("*.py")} == set(PACKAGES) | HELPERS
    rows = re.findall(r"^\| (\w+) \|", (ROOT / "docs" / "examples.md").read_text(), flags=re.MULTILINE)
    assert set(PACKAGES) <= set(rows)


@pytest.mark.parametrize("name", PACKAGES)
def test_a_few_steps(name, tmp_path):
    package = PACKAGES[name]
    if package is not None and importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    command = [sys.executable, str(FOLDER / f"{name}.py"), "--steps", "150", "--episodes", "1"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, text=True, capture_output=True)
    assert done.returncode == 0, done.stderr
    printed = dict(re.findall(r"^(\D+?) +(\S+)$", done.stdout, flags=re.MULTILINE))
    assert all(np.isfinite(float(printed[what].replace(",", ""))) for what in RETURNS)


def test_the_table_is_filled_row_by_row(tmp_path):
    write_row = runpy.run_path(str(FOLDER / "compare.py"))["write_row"]
    page = tmp_path / "page.md"
    page.write_text("| a | X | 1 |\n| a | Y | 2 |\n| b | X | 3 |\n")
    write_row(page, "a | Y", "4")
    assert page.read_text() == "| a | X | 1 |\n| a | Y | 4 |\n| b | X | 3 |\n"
    with pytest.raises(ValueError, match="begins with 'c'"):
        write_row(page, "c", "7 | 8")
