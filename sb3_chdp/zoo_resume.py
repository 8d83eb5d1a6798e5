"""``sb3-chdp train``: checkpoints from which a killed training goes on. Importing this module imports rl_zoo3."""

import json
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar

import rl_zoo3.exp_manager
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_chdp.common.checkpoint_store import CheckpointStore
from sb3_chdp.common.resume import ResumableCheckpoint, resume
from sb3_chdp.zoo import HybridExperimentManager
from sb3_chdp.zoo_arguments import ArgumentsError

CHECKPOINTS = "resumable"
ARGUMENTS = "arguments.json"


class ResumableExperimentManager(HybridExperimentManager):
    """rl_zoo3's ``ExperimentManager``, whose trainings with ``--save-freq`` can be resumed."""

    #: what ``sb3-chdp train`` was called with; kept in the run's folder
    arguments: ClassVar[list[str]] = []
    #: folder of the run to resume, None for a new one
    run: ClassVar[Path | None] = None

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        if self.run is not None:
            self.save_path = str(self.run)
            self.params_path = f"{self.save_path}/{self.env_name}"
            # Has setup_experiment() call _load_pretrained_agent()
            self.continue_training = True

    def create_callbacks(self) -> None:
        super().create_callbacks()
        if self.save_freq > 0 and not self.optimize_hyperparameters:
            if self.run is None:
                # The seed may have been drawn; of two the last one counts
                arguments = [*self.arguments, "--seed", str(self.seed)]
                (Path(self.save_path) / ARGUMENTS).write_text(json.dumps(arguments))
            self.callbacks.append(ResumableCheckpoint(self.save_freq, Path(self.save_path) / CHECKPOINTS, self.verbose))

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        if self.run is None:
            return super()._load_pretrained_agent(hyperparams, env)
        # The user's own run, which may have classes of the user's
        model = resume(self.run / CHECKPOINTS, env, device=self.device, trusted=True)
        print(f"Going on at {model.num_timesteps} of {self.n_timesteps} steps")
        return model

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        # The run's own stay
        if self.run is None:
            super()._save_config(saved_hyperparams)

    def learn(self, model: BaseAlgorithm) -> None:
        if self.save_freq <= 0:
            super().learn(model)
            return
        # Not super(): after an interrupt in the middle of an update it tells callbacks that the training is through
        kwargs: dict[str, Any] = {}
        if self.log_interval != -1:
            # -1 is the algorithm's own, less is none
            kwargs["log_interval"] = self.log_interval if self.log_interval >= 0 else None
        done = 0 if self.run is None else model.num_timesteps
        try:
            model.learn(self.n_timesteps - done, self.callbacks, reset_num_timesteps=self.run is None, **kwargs)
        except KeyboardInterrupt:
            pass  # the model is saved all the same
        finally:
            if self.show_progress:
                self.callbacks[0].on_training_end()
            assert model.env is not None
            with suppress(EOFError, OSError):  # its processes may have been interrupted as well
                model.env.close()


def prepare_training(arguments: list[str]) -> list[str]:
    """
    Have rl_zoo3's script ``train`` make resumable checkpoints if there is a ``--save-freq``, and go on from them.

    :param arguments: those of the script, or ``["--resume", folder of the run]``
    :return: arguments for the script: with ``--resume`` those of the killed run
    :raises ArgumentsError: for further arguments beside ``--resume``, a folder without checkpoints, or a run that is alive
    """
    run = None
    if any(argument.split("=")[0] == "--resume" for argument in arguments):
        parts = [part for argument in arguments for part in argument.split("=", 1)]
        if len(parts) != 2 or parts[0] != "--resume":
            raise ArgumentsError(f"--resume takes the folder of a run and no other arguments, got {' '.join(arguments)}")
        run = Path(parts[1])
        if not run.is_dir():
            raise ArgumentsError(f"--resume: there is no folder {run}")
        if not (run / ARGUMENTS).is_file() or not CheckpointStore(run / CHECKPOINTS).generations():
            raise ArgumentsError(f"--resume: {run} holds no resumable checkpoint, which train writes with --save-freq")
        try:
            # Given back at once: the callback takes it after the files of the run have been opened
            CheckpointStore(run / CHECKPOINTS).lock()
        except ValueError as error:
            raise ArgumentsError(f"--resume: {error}") from error
        arguments = json.loads((run / ARGUMENTS).read_text())
    # The script constructs it
    ResumableExperimentManager.arguments, ResumableExperimentManager.run = arguments, run
    vars(rl_zoo3.exp_manager).update(ExperimentManager=ResumableExperimentManager)
    return arguments
