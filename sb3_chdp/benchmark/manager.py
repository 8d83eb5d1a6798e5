"""rl_zoo3's experiment manager for a run, so that what is measured is what users train."""

import argparse
import contextlib
import os
from dataclasses import asdict
from pathlib import Path

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_chdp.benchmark.runs import Run
from sb3_chdp.registry import ALGORITHMS
from sb3_chdp.zoo import HybridExperimentManager, register
from sb3_chdp.zoo_arguments import STOCK

# Evaluation environments: they fill a batch of the policy
N_EVAL_ENVS = 8


class RunManager(HybridExperimentManager):
    """
    :param run: the run
    :param trained_agent: model of a checkpoint that :meth:`save_to` left, "" for a new one
    """

    def __init__(self, run: Run, trained_agent: str = ""):
        register()
        super().__init__(
            # What enjoy reads from args.yml
            argparse.Namespace(**asdict(run), env_kwargs=None),
            run.algo.removeprefix(STOCK),
            run.env_id,
            str(run.folder),
            eval_freq=-1,
            n_eval_episodes=run.eval_episodes,
            hyperparams=dict(run.overrides),
            trained_agent=trained_agent,
            truncate_last_trajectory=True,
            seed=run.seed,
            save_replay_buffer=True,
            verbose=0,
            n_eval_envs=min(N_EVAL_ENVS, run.eval_episodes),
            config=self._config(run),
        )
        # The folder of the first start also after the others: sb3-chdp enjoy finds the run by its number, 1
        self._set_folder(Path(run.folder) / self.algo / f"{self.env_name}_1")

    @staticmethod
    def _config(run: Run) -> str | None:
        """:return: YAML file of the user, else of this package, None for the one of rl_zoo3"""
        own = Path(run.conf_folder or "") / f"{run.algo.removeprefix(STOCK)}.yml"
        if run.conf_folder and own.is_file():
            return str(own)
        return None if run.algo.startswith(STOCK) else str(ALGORITHMS[run.algo].hyperparams)

    def _set_folder(self, folder: Path) -> None:
        self.save_path, self.params_path = str(folder), str(folder / self.env_name)

    def save_to(self, folder: Path, model: BaseAlgorithm) -> None:
        """
        Save model, replay buffer and statistics of normalisation.

        :param folder: where to, it is made
        :param model: the model
        """
        usual = Path(self.save_path)
        self._set_folder(folder)
        try:
            self.create_log_folder()
            self.save_trained_model(model)
        finally:
            self._set_folder(usual)


def settings_of(run: Run) -> dict[str, str]:
    """:return: the hyperparameters that a run is trained with, as text"""
    run.import_packages()
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere):
        _, settings = RunManager(run).read_hyperparameters()
    return {key: str(value) for key, value in settings.items()}
