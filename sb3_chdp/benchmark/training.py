"""Train a run: evaluations, checkpoints, and a lock that dies with its holder."""

import json
import math
import os
import platform
import shutil
import socket
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np
import stable_baselines3 as sb3
import torch as th
from filelock import FileLock, Timeout
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

import sb3_chdp
from sb3_chdp.benchmark.checkpoint import save_checkpoint, start
from sb3_chdp.benchmark.manager import RunManager, settings_of
from sb3_chdp.benchmark.results import ResultsError, Row, append_row, write_rows, write_text
from sb3_chdp.benchmark.runs import Run
from sb3_chdp.common.evaluation import evaluate_policy

EVAL_SEED = 10_000


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


def gradient_steps_of(model: BaseAlgorithm) -> int:
    """:return: gradient steps taken so far; SB3's PPO counts epochs instead"""
    n_updates: int = getattr(model, "_n_updates", 0)
    if isinstance(model, PPO):
        return n_updates * math.ceil(model.n_steps * model.n_envs / model.batch_size)
    return n_updates


def evaluate(model: BaseAlgorithm, env: VecEnv, n_episodes: int, deterministic: bool = True) -> tuple[float, float, float]:
    """:return: success rate (nan if an episode's last info has no ``is_success``), mean return and mean length"""
    successes: list[float] = []

    def note(local_vars: dict[str, Any], _: dict[str, Any]) -> None:
        if local_vars["done"]:
            successes.append(float(local_vars["info"].get("is_success", math.nan)))

    returns, lengths = evaluate_policy(
        model, env, n_episodes, deterministic=deterministic, return_episode_rewards=True, callback=note, warn=False
    )
    return float(np.mean(successes)), float(np.mean(returns)), float(np.mean(lengths))


class CurveCallback(BaseCallback):
    """
    Evaluate on an environment of its own, append a row to the CSV, and leave a checkpoint now and then.

    :param run: where to write
    :param manager: what the model was made by
    :param rows: evaluations before a checkpoint from which the training goes on
    """

    def __init__(self, run: Run, manager: RunManager, rows: list[Row]):
        super().__init__()
        self.run, self.manager, self.rows = run, manager, rows
        self.eval_env = manager.create_envs(manager.n_eval_envs, eval_env=True)
        self.eval_env.seed(EVAL_SEED + run.seed)
        self.seconds = rows[-1]["seconds"] if rows else 0.0
        self.started = self.last_checkpoint = time.perf_counter()
        write_rows(run.csv, rows)

    def _on_rollout_start(self) -> None:
        # Here all transitions are stored; in _on_step the newest are not
        if time.perf_counter() - self.last_checkpoint > self.run.checkpoint_interval and self.num_timesteps > 0:
            self.seconds += time.perf_counter() - self.started
            save_checkpoint(self.run, self.manager, self.model, self.rows)
            self.started = self.last_checkpoint = time.perf_counter()

    def _on_step(self) -> bool:
        due = self.run.evaluation_step(len(self.rows) + 1, self.manager.n_timesteps)
        if due <= min(self.num_timesteps, self.manager.n_timesteps):
            self.evaluate()
        return True

    def evaluate(self) -> None:
        """The clock stands still meanwhile."""
        self.seconds += time.perf_counter() - self.started
        sync_envs_normalization(self.training_env, self.eval_env)
        scores = evaluate(self.model, self.eval_env, self.run.eval_episodes, self.manager.deterministic_eval)
        success, mean_return, length = (round(score, 4) for score in scores)
        self.rows.append(
            {
                "timesteps": self.num_timesteps,
                "gradient_steps": gradient_steps_of(self.model),
                "success": success,
                "return": mean_return,
                "length": length,
                "seconds": round(self.seconds, 1),
            }
        )
        append_row(self.run.csv, self.rows[-1])
        self.started = time.perf_counter()


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
    model, manager, rows = start(run)
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
    callback = CurveCallback(run, manager, rows)
    # Not rl_zoo3's learn, which counts from 0 again
    model.learn(manager.n_timesteps - resumed_at, callback=[*manager.callbacks, callback], reset_num_timesteps=False)
    manager.save_replay_buffer = False
    manager.save_trained_model(model)
    callback.eval_env.close()
    if model.env is not None:
        model.env.close()
    run.started.replace(run.json)
    for checkpoint in run.folder.glob("*checkpoint*"):
        shutil.rmtree(checkpoint)
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
