"""What it costs that nothing is lost and nothing is silent: tables of ``speed.py``."""

import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from timing import ENV_ID, build, medians

from sb3_chdp import CHDP, HPPO, PATD3
from sb3_chdp.chdp import PaperCHDP
from sb3_chdp.common.resume import ResumableCheckpoint
from sb3_chdp.common.row_env import RowVecEnv


def unguarded_step(
    loss: th.Tensor, optimizers: list[th.optim.Optimizer], max_grad_norm: float | None = None, name: str = ""
) -> None:
    """The package's ``gradient_step`` without a look at the numbers."""
    groups = [[p for group in optimizer.param_groups for p in group["params"]] for optimizer in optimizers]
    params = [p for group in groups for p in group]
    for p, gradient in zip(params, th.autograd.grad(loss, params, allow_unused=True), strict=True):
        p.grad = gradient
    for optimizer, group in zip(optimizers, groups, strict=True):
        if max_grad_norm is not None:
            th.nn.utils.clip_grad_norm_(group, max_grad_norm)
        optimizer.step()


def guards(repeats: int) -> Iterator[str]:
    """(i) overhead of the guards against NaN and infinity, processor time; batch 128, baselines with 2 x 256"""
    yield "| step | with guards, ms | without, ms | overhead |\n|---|---|---|---|"
    big: dict[str, Any] = dict(policy_kwargs=dict(net_arch=[256, 256]))

    def of_losses(model: Any) -> tuple[Any, str, Any]:
        return sys.modules[model.train.__func__.__module__], "gradient_step", unguarded_step

    # What is replaced, as (owner, attribute, by what), and what is timed
    cases: list[tuple[str, list[tuple[Any, str, Any]], Callable[[], object]]] = []
    for name, algorithm, kwargs in (("PA-TD3", PATD3, big), ("CHDP", CHDP, {}), ("PaperCHDP", PaperCHDP, {})):
        model = build(algorithm, **kwargs)
        train = lambda m=model: m.train(2, 128)  # noqa: E731
        cases.append((f"{name}, two gradient steps", [of_losses(model)], train))
    hppo = HPPO("MlpPolicy", make_vec_env(ENV_ID, 8, seed=0), n_steps=128, n_epochs=1, seed=0, device="cpu", **big)
    hppo.learn(1024)
    of_gradients = (sys.modules[HPPO.__module__], "check_gradients", lambda gradients: None)
    cases.append(("HPPO, 16 minibatches", [of_gradients], lambda: hppo.train()))
    acting = build(PATD3, **big)
    collect = lambda: acting.learn(400, reset_num_timesteps=False)  # noqa: E731
    of_data = (RowVecEnv, "step_wait", lambda env: env.venv.step_wait())
    cases.append(("PA-TD3, 400 steps of 8 environments", [of_data], collect))
    whole = lambda: hppo.learn(1024, reset_num_timesteps=False)  # noqa: E731
    cases.append(("HPPO, 1,024 steps of 8 environments and what they teach in one epoch", [of_gradients, of_data], whole))
    for name, replaced, call in cases:
        own = [(owner, attribute, getattr(owner, attribute)) for owner, attribute, _ in replaced]

        def run(parts: list[tuple[Any, str, Any]], call: Callable[[], object] = call) -> None:
            for part in parts:
                setattr(*part)
            call()

        guarded, bare = medians([partial(run, own), partial(run, replaced)], 4 * repeats, time.process_time)
        for part in own:
            setattr(*part)
        yield f"| {name} | {1e3 * guarded:.2f} | {1e3 * bare:.2f} | {100 * (guarded / bare - 1):.1f} % |"


def checkpoints(repeats: int) -> Iterator[str]:
    """(j) resumable checkpoints of CHDP with 1e6 transitions, of which 10,000 are new each time"""
    yield "| environment | transitions in memory, MB | first two, s | later ones, s | two on disk, MB |\n|---|---|---|---|---|"
    for env_id in ("Platform-v0", "HardMove10-v0"):
        seconds: list[float] = []

        class Timed(ResumableCheckpoint):
            def _save(self, seconds: list[float] = seconds) -> None:
                start = time.perf_counter()
                super()._save()
                seconds.append(time.perf_counter() - start)

        model = build(CHDP, env_id, buffer_size=1_000_000, learning_starts=10**9)
        arrays = [value for value in vars(model.replay_buffer).values() if isinstance(value, np.ndarray)]
        for array in arrays:
            array[:] = 1
        model.replay_buffer.full = True
        with tempfile.TemporaryDirectory() as folder:
            model.learn((2 + repeats // 6) * 10_000, Timed(10_000 // 8, folder), reset_num_timesteps=False)
            # Links count once
            files = {file.stat().st_ino: file.stat().st_size for file in Path(folder).rglob("*") if file.is_file()}
        values = (sum(array.nbytes for array in arrays) / 1e6, sum(files.values()) / 1e6)
        first, later = statistics.mean(seconds[:2]), statistics.median(seconds[2:])
        yield f"| {env_id} | {values[0]:,.0f} | {first:.2f} | {later:.2f} | {values[1]:,.0f} |"
