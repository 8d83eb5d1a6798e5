"""An algorithm is a folder and one line, an environment a file: docs/guide, word for word."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.commands import run

pytest.importorskip("rl_zoo3")
pytest.importorskip("submitit")

ROOT = Path(__file__).parent.parent
GUIDE = ROOT / "docs" / "guide"
PNG = b"\x89PNG"
# After the commands of the guides, which are meant for patient readers
QUICK = {"train": ["-n", "400", "--eval-freq", "-1"], "benchmark": ["--steps", "400", "--eval-episodes", "2", "--jobs", "2"]}


def blocks(page, language):
    return re.findall(rf"```{language}\n(.*?)```", (GUIDE / page).read_text(), re.DOTALL)


def commands(page):
    """The commands of a guide, as arguments."""
    return [shlex.split(line) for block in blocks(page, "bash") for line in block.splitlines()]


def run_in_copy(command, folder):
    """Run a command in a folder that holds a copy of the package."""
    if command[0] == "sb3-chdp":
        command = ["python", "-m", "sb3_chdp", *command[1:], *QUICK[command[1]]]
    environment = {**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, *command[1:]]
    result = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=1800)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def check_report(folder, *names):
    report = (folder / "report.md").read_text()
    assert all(name in report for name in names) and "P(" in report
    for picture in ("curves_steps", "curves_minutes", "scores"):
        assert (folder / f"{picture}.png").read_bytes().startswith(PNG)


@pytest.mark.slow
def test_new_algorithm(tmp_path):
    """In a copy of the package, with the folder and the line of the guide."""
    for part in ("sb3_chdp", "tests"):
        shutil.copytree(ROOT / part, tmp_path / part, ignore=shutil.ignore_patterns("__pycache__"))
    code, line = blocks("new_algorithm.md", "python")
    (tmp_path / "sb3_chdp" / "slow_td3").mkdir()
    (tmp_path / "sb3_chdp" / "slow_td3" / "__init__.py").write_text(code)
    registry = tmp_path / "sb3_chdp" / "registry.py"
    last_line = registry.read_text().rindex("    Algorithm(")
    registry.write_text(registry.read_text()[:last_line] + line + registry.read_text()[last_line:])

    train, benchmark, tests = commands("new_algorithm.md")
    run_in_copy(train, tmp_path)
    assert (tmp_path / "logs" / "slow_td3" / "HardMove4-v0_1" / "HardMove4-v0.zip").is_file()
    assert "| HardMove4-v0 | Slow TD3 |" in run_in_copy(benchmark, tmp_path)
    check_report(tmp_path / "logs" / "benchmark", "P(Slow TD3 > ...)", "PA-TD3")
    assert re.search(r"[1-9]\d* passed", run_in_copy(tests, tmp_path))


@pytest.mark.slow
def test_own_environment(tmp_path):
    """In a folder of its own, with the file of the guide."""
    (tmp_path / "mine.py").write_text(blocks("own_environment.md", "python")[0])
    train, *_, benchmark = commands("own_environment.md")[:6]
    run(*train[1:], *QUICK["train"], cwd=tmp_path)
    assert (tmp_path / "logs" / "chdp" / "Own-v0_1" / "Own-v0.zip").is_file()
    assert "| Own-v0 | CHDP |" in run(*benchmark[1:], *QUICK["benchmark"], cwd=tmp_path)
    check_report(tmp_path / "logs" / "benchmark", "PDQN-TD3", "SB3's SAC")
