"""Train a run, under a lock that dies with its holder."""

import json
import os
import platform
import shutil
import socket
import subprocess
from pathlib import Path

import stable_baselines3 as sb3
import torch as th
from filelock import FileLock, Timeout

import sb3_chdp
from sb3_chdp.benchmark.curve import CurveCallback
from sb3_chdp.benchmark.manager import RunManager, settings_of
from sb3_chdp.benchmark.results import ResultsError, write_text
from sb3_chdp.benchmark.runs import Run
from sb3_chdp.common.checkpoint_store import DamagedError


def machine(threads: int) -> str:
    """:return: processor and number of the (virtual) cores, as far as the machine tells"""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    cores = f"{names[0] if names else platform.machine()} ({os.cpu_count()} virtual cores)"
    return f"{cores}, Python {platform.python_version()}, {threads} thread(s)"


def commit() -> str:
    """:return: commit of a clone of this package, "" where it is installed"""
    describe = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        return subprocess.run(describe, cwd=Path(__file__).parent, capture_output=True, text=True).stdout.strip()
    except FileNotFoundError:
        return ""


def train(run: Run) -> str:
    """
    Train a run to its end, from its last checkpoint if there is one. Nothing is done for one that is finished.

    :param run: the run
    :return: a line about the result
    :raises ResultsError: if it was started with other settings, or if another process trains it
    """
    th.set_num_threads(run.threads)
    settings = settings_of(run)
    run.folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(run.folder / "lock", timeout=0)
    try:
        with lock:
            holder = run.folder / "holder.txt"
            run.check_settings(settings)
            if run.is_complete:
                return f"{run.folder}: complete already"
            holder.write_text(f"process {os.getpid()} on {socket.gethostname()}")
            return _train(run, settings)
    except Timeout:
        raise ResultsError(f"{run.folder} is being trained by {(run.folder / 'holder.txt').read_text()}") from None


def _train(run: Run, settings: dict[str, str]) -> str:
    if not run.started.exists():
        # Without it nobody knows with which settings
        shutil.rmtree(run.checkpoints, ignore_errors=True)
    manager = RunManager(run)
    try:
        made = manager.setup_experiment()
    except DamagedError as error:
        raise ResultsError(f"{error}. Delete {run.checkpoints}, and the run is trained anew") from error
    if made is None:
        raise ValueError(f"rl_zoo3 made no model of {run.algo}")
    model = made[0]
    resumed_at = model.num_timesteps
    meta = {
        **run.description(),
        "settings": settings,
        "resumed_at": resumed_at,
        "versions": {"sb3_chdp": sb3_chdp.__version__, "stable_baselines3": sb3.__version__, "torch": th.__version__},
        "commit": commit(),
        "machine": machine(run.threads),
    }
    write_text(run.started, json.dumps(meta, indent=1))
    callback = CurveCallback(run, manager)
    # Not rl_zoo3's learn, which counts from 0 again
    model.learn(manager.n_timesteps - resumed_at, callback=[*manager.callbacks, callback], reset_num_timesteps=False)
    manager.save_trained_model(model)
    callback.eval_env.close()
    if model.env is not None:
        model.env.close()
    run.started.replace(run.json)
    shutil.rmtree(run.checkpoints, ignore_errors=True)
    return f"{run.folder}: {run.csv.read_text().splitlines()[-1]}"


def forget(run: Run) -> None:
    """
    Delete what there is of a run.

    :raises ResultsError: if another process trains it
    """
    run.folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(run.folder / "lock", timeout=0):
            run.csv.unlink(missing_ok=True)
            run.json.unlink(missing_ok=True)
            shutil.rmtree(run.folder)
    except Timeout:
        raise ResultsError(f"{run.folder} is being trained by {(run.folder / 'holder.txt').read_text()}") from None
