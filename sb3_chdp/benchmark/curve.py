"""The learning curve of a run: evaluations, and checkpoints from which it goes on to the last bit."""

import math
import time
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import sync_envs_normalization

from sb3_chdp.benchmark.manager import RunManager
from sb3_chdp.benchmark.results import Row, append_row, write_rows
from sb3_chdp.benchmark.runs import Run
from sb3_chdp.common.evaluation import evaluate_episodes
from sb3_chdp.common.resume import ResumableCheckpoint

EVAL_SEED = 10_000


def gradient_steps_of(model: Any) -> int:
    """:return: gradient steps taken so far, those of PPO at most as many: it counts epochs, of which target_kl ends some"""
    n_updates: int = getattr(model, "_n_updates", 0)
    if hasattr(model, "n_epochs"):
        return n_updates * math.ceil(model.n_steps * model.n_envs / model.batch_size)
    return n_updates


class Stopwatch:
    """Time of this process, which checkpoints leave out: they hold plain data only."""

    def __init__(self) -> None:
        self.saved = self.last = time.perf_counter()
        self.has_begun = False

    def lap(self) -> float:
        """:return: seconds since the last call"""
        before, self.last = self.last, time.perf_counter()
        return self.last - before


class CurveCallback(ResumableCheckpoint):
    """
    Evaluate on an environment of its own, append a row to the CSV, and leave a checkpoint now and then.

    :param run: where to write
    :param manager: what the model was made by
    """

    def __init__(self, run: Run, manager: RunManager):
        super().__init__(1, run.checkpoints)
        self.run, self.manager = run, manager
        self.eval_env = manager.create_envs(manager.n_eval_envs, eval_env=True)
        self.eval_env.seed(EVAL_SEED + run.seed)
        # A checkpoint holds these two
        self.curve: list[Row] = []
        self.seconds = 0.0
        self._watch = Stopwatch()

    def _is_due(self) -> bool:
        return time.perf_counter() - self._watch.saved > self.run.checkpoint_interval and self.num_timesteps > 0

    def _on_rollout_start(self) -> None:
        super()._on_rollout_start()
        if not self._watch.has_begun:
            # The curve is that of the checkpoint now; rows behind it are evaluated again
            write_rows(self.run.csv, self.curve)
            self._watch.has_begun = True
            self._watch.lap()

    def _save(self) -> None:
        self.seconds += self._watch.lap()
        super()._save()
        self._watch.lap()
        self._watch.saved = self._watch.last

    def _on_training_end(self) -> None:
        # The run is finished: what comes next is its model
        self.seconds += self._watch.lap()

    def _on_step(self) -> bool:
        due = self.run.evaluation_step(len(self.curve) + 1, self.manager.n_timesteps)
        if due <= min(self.num_timesteps, self.manager.n_timesteps):
            self.evaluate()
        return super()._on_step()

    def evaluate(self) -> None:
        """The clock stands still meanwhile. Success is nan if an episode does not tell it."""
        self.seconds += self._watch.lap()
        sync_envs_normalization(self.training_env, self.eval_env)
        episodes = evaluate_episodes(self.model, self.eval_env, self.run.eval_episodes, self.manager.deterministic_eval)
        mean_return, length, success = (round(float(np.mean(values)), 4) for values in episodes)
        self.curve.append(
            {
                "timesteps": self.num_timesteps,
                "gradient_steps": gradient_steps_of(self.model),
                "success": success,
                "return": mean_return,
                "length": length,
                "seconds": round(self.seconds, 1),
            }
        )
        append_row(self.run.csv, self.curve[-1])
        self._watch.lap()
