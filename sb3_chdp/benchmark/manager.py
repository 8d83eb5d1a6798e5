"""rl_zoo3's experiment manager for a run, so that what is measured is what users train."""

import argparse
import contextlib
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_chdp.benchmark.runs import Run
from sb3_chdp.common.checkpoint_store import CheckpointStore
from sb3_chdp.common.resume import resume
from sb3_chdp.registry import ALGORITHMS
from sb3_chdp.zoo import HybridExperimentManager, register
from sb3_chdp.zoo_arguments import STOCK, import_packages

# Evaluation environments: they fill a batch of the policy
N_EVAL_ENVS = 8


class RunManager(HybridExperimentManager):
    """
    :param run: the run; its model is that of its last checkpoint if there is one
    """

    def __init__(self, run: Run):
        register()
        self.run = run
        super().__init__(
            # What enjoy reads from args.yml
            argparse.Namespace(**asdict(run), env_kwargs=None),
            run.algo.removeprefix(STOCK),
            run.env_id,
            str(run.folder),
            eval_freq=-1,
            n_eval_episodes=run.eval_episodes,
            hyperparams=dict(run.overrides),
            seed=run.seed,
            verbose=0,
            n_eval_envs=min(N_EVAL_ENVS, run.eval_episodes),
            config=self._config(run),
        )
        # Has setup_experiment() call _load_pretrained_agent()
        self.continue_training = bool(CheckpointStore(run.checkpoints).generations())
        # The folder of the first start also after the others: sb3-chdp enjoy finds the run by its number, 1
        folder = Path(run.folder) / self.algo / f"{self.env_name}_1"
        self.save_path, self.params_path = str(folder), str(folder / self.env_name)

    @staticmethod
    def _config(run: Run) -> str | None:
        """:return: YAML file of the user, else of this package, None for the one of rl_zoo3"""
        own = Path(run.conf_folder or "") / f"{run.algo.removeprefix(STOCK)}.yml"
        if run.conf_folder and own.is_file():
            return str(own)
        return None if run.algo.startswith(STOCK) else str(ALGORITHMS[run.algo].hyperparams)

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        # The user's own run, which may have classes of the user's
        return resume(self.run.checkpoints, env, device=self.device, trusted=True)


def settings_of(run: Run) -> dict[str, str]:
    """:return: the hyperparameters that a run is trained with, as text"""
    import_packages(run.gym_packages)
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        _, settings = RunManager(run).read_hyperparameters()
    return {key: str(value) for key, value in settings.items()}
