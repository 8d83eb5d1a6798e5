"""The benchmark on a real Slurm; skipped where there is none."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("submitit")

ROOT = Path(__file__).parent.parent
ENV_ID = "HardMove4-v0"

pytestmark = [
    pytest.mark.slurm,
    pytest.mark.skipif(
        shutil.which("sbatch") is None or subprocess.run(["sinfo"], capture_output=True).returncode != 0, reason="no Slurm"
    ),
]


def slurm(*command):
    return subprocess.run(command, capture_output=True, text=True).stdout.split()


def running_jobs():
    return slurm("squeue", "--noheader", "--array", "--format=%i", "--states=RUNNING", "--name=benchmark")


def wait_for(condition, seconds):
    for _ in range(seconds):
        if condition():
            return
        time.sleep(1)
    raise TimeoutError


def test_a_preempted_job_goes_on_and_a_cancelled_one_is_reported(tmp_path):
    command = [
        sys.executable, "-m", "sb3_chdp", "benchmark", "--envs", ENV_ID, "--algos", "hppo", "--seeds", "0", "1",
        "--steps", "200000", "--out", "out", "--eval-episodes", "2", "--checkpoint-interval", "1",
        "-params", "n_envs:4", "n_steps:50", "n_epochs:1", "--jobs", "1", "--cluster", "slurm", "--slurm-time", "30",
    ]  # fmt: skip
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    folder = tmp_path / "out" / "hppo" / ENV_ID
    wait_for(lambda: list(folder.glob("seed_0/checkpoints/*_steps*")), 600)
    (first,) = running_jobs()
    slurm("scancel", "--signal=USR2", first)
    # The job that preempts it has ended; what is queued again waits for two minutes
    wait_for(lambda: [job for job in running_jobs() if job != first], 600)
    (second,) = running_jobs()
    wait_for(lambda: (folder / "seed_1" / "started.json").exists(), 600)
    # Killed half a minute later, when it is far from its end
    slurm("scancel", second)
    output, _ = process.communicate(timeout=600)
    assert process.returncode == 1, output
    assert "seed_1: its process was killed" in output and "seed_0: its" not in output
    assert '"resumed_at": 0' not in (folder / "seed_0.json").read_text()
