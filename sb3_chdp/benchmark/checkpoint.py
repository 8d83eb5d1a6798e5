"""Checkpoints of a run: model, replay buffer, statistics of normalisation, and the evaluations so far, as one set."""

import shutil
from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_chdp.benchmark.manager import RunManager
from sb3_chdp.benchmark.results import Row, read_rows, write_rows
from sb3_chdp.benchmark.runs import Run


def checkpoint_of(run: Run) -> Path | None:
    """:return: folder of the newest checkpoint"""
    return max(run.folder.glob("checkpoint_*"), default=None)


def save_checkpoint(run: Run, manager: RunManager, model: BaseAlgorithm, rows: list[Row]) -> None:
    """Save a checkpoint beside the former one, which goes when the new one is complete."""
    former, new = checkpoint_of(run), run.folder / "new_checkpoint"
    shutil.rmtree(new, ignore_errors=True)
    manager.save_to(new, model)
    write_rows(new / "rows.csv", rows)
    new.rename(run.folder / f"checkpoint_{model.num_timesteps:012d}")
    if former is not None:
        shutil.rmtree(former)


def start(run: Run) -> tuple[BaseAlgorithm, RunManager, list[Row]]:
    """:return: a new model or that of the last checkpoint, what made it, and the evaluations before it"""
    checkpoint = checkpoint_of(run)
    if checkpoint is None:
        manager = RunManager(run)
    else:
        manager = RunManager(run, str(checkpoint / f"{RunManager(run).env_name}.zip"))
    made = manager.setup_experiment()
    if made is None:
        raise ValueError(f"rl_zoo3 made no model of {run.algo}")
    model = made[0]
    if checkpoint is None:
        return model, manager, []
    # Other random numbers than those before the checkpoint
    model.set_random_seed(run.seed + model.num_timesteps)
    return model, manager, read_rows(checkpoint / "rows.csv")
