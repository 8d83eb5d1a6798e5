"""
Learning curves of one algorithm on the benchmarks, several seeds in parallel, one process and one thread each.

    python benchmarks/learning.py --envs HardMove6-v0 Platform-v0 --seeds 0 1 2 --steps 60000 --jobs 2

Every cell appends its evaluations to <out>/<env>/seed_<k>.csv and keeps its settings and versions beside it in
seed_<k>.json. Cells that are complete are skipped. --evaluate prints a table row per saved model: success and return of
deterministic actions, then of sampled ones. Hyperparameters are those of hyperparams/<algo>.yml, --set overrides.
"""

import argparse
import csv
import json
import multiprocessing
import os
import platform
import time
from pathlib import Path
from typing import Any

import numpy as np
import stable_baselines3 as sb3
import torch as th
import yaml
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv

import sb3_chdp

ALGORITHMS = {
    "chdp": sb3_chdp.CHDP,
    "pa_td3": sb3_chdp.PATD3,
    "pdqn_td3": sb3_chdp.PDQNTD3,
    "hhqn_td3": sb3_chdp.HHQNTD3,
    "hyar_td3": sb3_chdp.HyARTD3,
    "hppo": sb3_chdp.HPPO,
}
ROOT = Path(__file__).parent
FIELDS = ("timesteps", "gradient_steps", "success", "return", "length", "deterministic", "seconds")


class CurveCallback(BaseCallback):
    """
    Evaluate on a separate environment and append a line to a CSV.

    :param eval_env: evaluation environment
    :param path: CSV file
    :param eval_freq: number of training steps between two evaluations
    :param n_eval_episodes: number of episodes of an evaluation
    :param stochastic: whether to evaluate sampled actions as well
    """

    def __init__(self, eval_env: VecEnv, path: Path, eval_freq: int, n_eval_episodes: int, stochastic: bool):
        super().__init__()
        self.eval_env, self.path, self.eval_freq, self.n_eval_episodes = eval_env, path, eval_freq, n_eval_episodes
        self.modes = (True, False) if stochastic else (True,)
        self.next_evaluation = eval_freq
        self.seconds = 0.0
        self.started = time.perf_counter()

    def _init_callback(self) -> None:
        with self.path.open("w", newline="") as file:
            csv.writer(file).writerow(FIELDS)

    def _on_step(self) -> bool:
        if self.num_timesteps >= self.next_evaluation:
            self.next_evaluation += self.eval_freq
            self.evaluate()
        return True

    def score(self, deterministic: bool) -> tuple[float, float, float]:
        """:return: mean success, return and length of the evaluation episodes"""
        successes: list[bool] = []

        def note(local_vars: dict[str, Any], _: dict[str, Any]) -> None:
            if local_vars["done"]:
                successes.append(local_vars["info"]["is_success"])

        returns, lengths = evaluate_policy(
            self.model,
            self.eval_env,
            self.n_eval_episodes,
            deterministic=deterministic,
            return_episode_rewards=True,
            callback=note,
        )
        return float(np.mean(successes)), float(np.mean(returns)), float(np.mean(lengths))

    def evaluate(self) -> None:
        # The clock stands still while evaluating
        self.seconds += time.perf_counter() - self.started
        for deterministic in self.modes:
            scores = [round(score, 4) for score in self.score(deterministic)]
            line = [self.num_timesteps, self.model._n_updates, *scores, int(deterministic), round(self.seconds, 1)]
            with self.path.open("a", newline="") as file:
                csv.writer(file).writerow(line)
        self.started = time.perf_counter()


def run_cell(cell: tuple[str, int, argparse.Namespace]) -> str:
    """Train one seed on one environment."""
    env_id, seed, args = cell
    th.set_num_threads(1)
    settings = yaml.safe_load((ROOT.parent / "hyperparams" / f"{args.algo}.yml").read_text())
    hyperparams = {**settings.get(env_id, settings["default"]), **args.set}
    n_envs = hyperparams.pop("n_envs", 1)
    total = int(args.steps or hyperparams["n_timesteps"])
    for key in ("n_timesteps", "monitor_kwargs"):  # rl_zoo3's
        hyperparams.pop(key, None)
    folder = Path(args.out) / env_id
    folder.mkdir(parents=True, exist_ok=True)
    path, meta_path = folder / f"seed_{seed}.csv", folder / f"seed_{seed}.json"
    if meta_path.exists():
        return f"{env_id} seed {seed}: already complete"
    env = make_vec_env(env_id, n_envs, seed=seed)
    eval_env = make_vec_env(env_id, 8, seed=10_000 + seed)
    model = ALGORITHMS[args.algo](env=env, seed=seed, device="cpu", **hyperparams)
    callback = CurveCallback(eval_env, path, args.eval_freq, args.eval_episodes, args.stochastic)
    model.learn(total, callback=callback)
    meta = {
        "env": env_id,
        "seed": seed,
        "steps": total,
        "n_envs": n_envs,
        "hyperparams": {key: str(value) for key, value in hyperparams.items()},
        "versions": {"sb3_chdp": sb3_chdp.__version__, "stable_baselines3": sb3.__version__, "torch": th.__version__},
        "machine": f"{platform.machine()}, Python {platform.python_version()}, 1 thread",
    }
    meta_path.write_text(json.dumps(meta, indent=1))
    if args.save:
        model.save(folder / f"seed_{seed}.zip")
    return f"{env_id} seed {seed}: {path.read_text().splitlines()[-1]}"


def evaluate_cell(cell: tuple[str, int, argparse.Namespace]) -> str:
    """Evaluate the saved model of one seed, with deterministic and with sampled actions."""
    env_id, seed, args = cell
    th.set_num_threads(1)
    model = ALGORITHMS[args.algo].load(Path(args.out) / env_id / f"seed_{seed}.zip", device="cpu", buffer_size=1)
    callback = CurveCallback(make_vec_env(env_id, 8, seed=20_000 + seed), Path(os.devnull), 0, args.eval_episodes, True)
    callback.model = model
    results = [callback.score(deterministic) for deterministic in (True, False)]
    (success, mean_return, _), (sampled_success, sampled_return, _) = results
    return f"| {env_id} | {seed} | {success:.3f} | {mean_return:.3f} | {sampled_success:.3f} | {sampled_return:.3f} |"


def parse_args() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algo", default="chdp", choices=list(ALGORITHMS))
    parser.add_argument("--envs", nargs="+", default=list(sb3_chdp.envs.ENV_IDS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--steps", type=int, help="environment steps (default: those of the YAML file)")
    parser.add_argument("--eval-freq", type=int, default=5000)
    parser.add_argument("--eval-episodes", type=int, default=100)
    parser.add_argument("--stochastic", action="store_true", help="evaluate sampled actions as well")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--evaluate", action="store_true", help="only evaluate the models that --save left")
    parser.add_argument("--save", action="store_true", help="save the models")
    parser.add_argument("--set", nargs="+", default=[], metavar="KEY=VALUE", help="override hyperparameters (YAML values)")
    parser.add_argument("--out", default=str(ROOT / "results" / "learning"))
    args = parser.parse_args()
    args.set = {key: yaml.safe_load(value) for key, value in (item.split("=", 1) for item in args.set)}
    return args


if __name__ == "__main__":
    args = parse_args()
    cells = [(env_id, seed, args) for seed in args.seeds for env_id in args.envs]
    with multiprocessing.get_context("spawn").Pool(args.jobs, maxtasksperchild=1) as pool:
        for message in pool.imap(evaluate_cell if args.evaluate else run_cell, cells):
            print(message, flush=True)
