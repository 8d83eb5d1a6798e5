"""One cell of a table: one algorithm on one environment with one seed, trained, evaluated and written to files."""

import csv
import json
import math
import os
import platform
import subprocess
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import stable_baselines3 as sb3
import torch as th
import yaml
from rl_zoo3.utils import get_class_by_name, linear_schedule
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

import sb3_chdp

ROOT = Path(__file__).parent
RESULTS = ROOT / "results"
HYPERPARAMS = ROOT.parent / "hyperparams"
ALGORITHMS = {
    "chdp": sb3_chdp.CHDP,
    "hppo": sb3_chdp.HPPO,
    "pa_td3": sb3_chdp.PATD3,
    "pdqn_td3": sb3_chdp.PDQNTD3,
    "hhqn_td3": sb3_chdp.HHQNTD3,
    "hyar_td3": sb3_chdp.HyARTD3,
}
FIELDS = ("timesteps", "gradient_steps", "success", "return", "length", "seconds")
# Evaluations of a run; its score is the mean of the last five
N_EVALUATIONS = 30
# Wall-clock seconds between two checkpoints
CHECKPOINT_INTERVAL = 180.0


@dataclass(frozen=True)
class Cell:
    """
    :param name: row of the table: an algorithm, or a variant of one
    :param algo: key of ``ALGORITHMS``, also the name of the YAML file
    :param env_id: environment
    :param seed: seed of the model and of the training environments
    :param out: folder of the table
    :param overrides: hyperparameters that differ from the YAML file
    :param eval_freq: environment steps between two evaluations, a thirtieth of the training if None
    :param eval_episodes: episodes of an evaluation
    :param threads: threads of PyTorch
    """

    name: str
    algo: str
    env_id: str
    seed: int
    out: str
    overrides: dict[str, Any] = field(default_factory=dict)
    eval_freq: int | None = None
    eval_episodes: int = 100
    threads: int = 1

    @property
    def stem(self) -> Path:
        return Path(self.out) / self.name / self.env_id / f"seed_{self.seed}"

    def path(self, suffix: str) -> Path:
        return self.stem.with_name(self.stem.name + suffix)

    @property
    def is_complete(self) -> bool:
        return self.path(".json").exists()

    def settings(self) -> dict[str, Any]:
        """:return: what the YAML file says about the environment, with the overrides"""
        settings = yaml.safe_load((HYPERPARAMS / f"{self.algo}.yml").read_text())
        return {**settings.get(self.env_id, settings["default"]), **self.overrides}

    @property
    def total_steps(self) -> int:
        return int(self.settings()["n_timesteps"])

    @property
    def steps_between_evaluations(self) -> int:
        return self.eval_freq or max(self.total_steps // N_EVALUATIONS, 1)

    def rows(self) -> list[dict[str, float]]:
        """:return: the evaluations so far"""
        if not self.path(".csv").exists():
            return []
        with self.path(".csv").open() as file:
            return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]


def processor() -> str:
    """:return: name and number of the (virtual) cores of this machine, as far as it tells"""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.machine()} ({os.cpu_count()} virtual cores)"


def gradient_steps_of(model: BaseAlgorithm) -> int:
    """:return: gradient steps taken so far; SB3's PPO counts epochs instead"""
    if isinstance(model, sb3_chdp.HPPO):
        return model._n_updates * math.ceil(model.n_steps * model.n_envs / model.batch_size)
    return model._n_updates


def evaluate(model: BaseAlgorithm, env: VecEnv, n_episodes: int, deterministic: bool = True) -> tuple[float, float, float]:
    """:return: success rate, mean return and mean length of ``n_episodes`` episodes"""
    successes: list[bool] = []

    def note(local_vars: dict[str, Any], _: dict[str, Any]) -> None:
        if local_vars["done"]:
            successes.append(local_vars["info"]["is_success"])

    returns, lengths = evaluate_policy(
        model, env, n_episodes, deterministic=deterministic, return_episode_rewards=True, callback=note
    )
    return float(np.mean(successes)), float(np.mean(returns)), float(np.mean(lengths))


class CurveCallback(BaseCallback):
    """
    Evaluate on an environment of its own, append a line to the CSV, and leave a checkpoint now and then.

    :param cell: where to write
    :param rows: evaluations before a checkpoint from which the training goes on
    """

    def __init__(self, cell: Cell, rows: list[dict[str, float]]):
        super().__init__()
        self.cell = cell
        self.eval_env = make_vec_env(cell.env_id, 8, seed=10_000 + cell.seed)
        self.eval_freq = cell.steps_between_evaluations
        self.next_evaluation = (len(rows) + 1) * self.eval_freq
        self.seconds = rows[-1]["seconds"] if rows else 0.0
        self.started = self.last_checkpoint = time.perf_counter()
        with cell.path(".csv").open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(FIELDS)
            writer.writerows([[int(row[k]) if k in FIELDS[:2] else row[k] for k in FIELDS] for row in rows])

    def _on_step(self) -> bool:
        if self.num_timesteps >= self.next_evaluation:
            self.next_evaluation += self.eval_freq
            self.evaluate()
        return True

    def evaluate(self) -> None:
        # The clock stands still while evaluating
        self.seconds += time.perf_counter() - self.started
        scores = [round(score, 4) for score in evaluate(self.model, self.eval_env, self.cell.eval_episodes)]
        with self.cell.path(".csv").open("a", newline="") as file:
            csv.writer(file).writerow([self.num_timesteps, gradient_steps_of(self.model), *scores, round(self.seconds, 1)])
        if time.perf_counter() - self.last_checkpoint > CHECKPOINT_INTERVAL:
            save_checkpoint(self.model, self.cell)
            self.last_checkpoint = time.perf_counter()
        self.started = time.perf_counter()


def save_checkpoint(model: BaseAlgorithm, cell: Cell) -> None:
    """Save model and replay buffer; a run that is killed meanwhile finds the former checkpoint."""
    if hasattr(model, "replay_buffer"):
        model.save_replay_buffer(cell.path(".buffer.new.pkl"))
        cell.path(".buffer.new.pkl").replace(cell.path(".buffer.pkl"))
    model.save(cell.path(".checkpoint.new.zip"))
    cell.path(".checkpoint.new.zip").replace(cell.path(".checkpoint.zip"))


def start_model(cell: Cell) -> tuple[BaseAlgorithm, list[dict[str, float]]]:
    """:return: a new model or that of the last checkpoint, and the evaluations before it"""
    hyperparams = cell.settings()
    n_envs = hyperparams.pop("n_envs", 1)
    for key in ("n_timesteps", "monitor_kwargs"):  # rl_zoo3's
        hyperparams.pop(key, None)
    if isinstance(hyperparams.get("learning_rate"), str):
        # rl_zoo3's notation: lin_0.001 falls to 0
        hyperparams["learning_rate"] = linear_schedule(hyperparams["learning_rate"].split("_")[1])
    if isinstance(hyperparams.get("replay_buffer_class"), str):
        hyperparams["replay_buffer_class"] = get_class_by_name(hyperparams["replay_buffer_class"])
    env = make_vec_env(cell.env_id, n_envs, seed=cell.seed)
    if not cell.path(".checkpoint.zip").exists():
        return ALGORITHMS[cell.algo](env=env, seed=cell.seed, device="cpu", **hyperparams), []
    model = ALGORITHMS[cell.algo].load(cell.path(".checkpoint.zip"), env=env, device="cpu")
    if hasattr(model, "replay_buffer"):
        model.load_replay_buffer(cell.path(".buffer.pkl"))
    return model, [row for row in cell.rows() if row["timesteps"] <= model.num_timesteps]


def run_cell(cell: Cell) -> str:
    """
    Train a cell to its end, from its last checkpoint if there is one.

    :return: a line about the result
    """
    if cell.is_complete:
        return f"{cell.stem}: complete already"
    th.set_num_threads(cell.threads)
    cell.stem.parent.mkdir(parents=True, exist_ok=True)
    model, rows = start_model(cell)
    resumed_at = model.num_timesteps
    describe = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    commit = subprocess.run(describe, cwd=ROOT, capture_output=True, text=True).stdout.strip()
    meta = {
        **asdict(cell),
        "settings": {key: str(value) for key, value in cell.settings().items()},
        "resumed_at": resumed_at,
        "versions": {"sb3_chdp": sb3_chdp.__version__, "stable_baselines3": sb3.__version__, "torch": th.__version__},
        "commit": commit,
        "machine": f"{processor()}, Python {platform.python_version()}, {cell.threads} thread(s)",
    }
    del meta["out"]
    cell.path(".started").write_text(json.dumps(meta, indent=1))
    model.learn(cell.total_steps - resumed_at, callback=CurveCallback(cell, rows), reset_num_timesteps=resumed_at == 0)
    model.save(cell.path(".zip"))
    cell.path(".started").rename(cell.path(".json"))
    for suffix in (".checkpoint.zip", ".buffer.pkl"):
        cell.path(suffix).unlink(missing_ok=True)
    return f"{cell.stem}: {cell.path('.csv').read_text().splitlines()[-1]}"
