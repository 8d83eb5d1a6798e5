"""What every example does: train with the defaults, and compare with random actions and with a simple rule."""

import argparse
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_chdp import ALGORITHMS

PAGE = Path(__file__).parents[1] / "docs" / "examples.md"
# Seed of the first test episode
TEST_SEED = 10_000


def mean_return(env: gym.Env, act: Callable[[Any], Any], n_episodes: int) -> float:
    """
    :param env: the environment
    :param act: gives the action for an observation
    :param n_episodes: number of episodes
    :return: mean return over episodes whose seeds are always the same
    """
    total = 0.0
    for episode in range(n_episodes):
        obs, _ = env.reset(seed=TEST_SEED + episode)
        over = False
        while not over:
            obs, reward, terminated, truncated, _ = env.step(act(obs))
            total, over = total + float(reward), terminated or truncated
    return total / n_episodes


def write_row(page: Path, start: str, cells: str) -> None:
    """
    Put what was measured into the row of a Markdown table.

    :param page: the Markdown file
    :param start: first cells of the row
    :param cells: the cells behind them
    :raises ValueError: if no row begins with them
    """
    text, n_rows = re.subn(rf"^\| {re.escape(start)} \|.*$", f"| {start} | {cells} |", page.read_text(), flags=re.MULTILINE)
    if n_rows == 0:
        raise ValueError(f"no row of a table in {page} begins with {start!r}")
    page.write_text(text)


def compare(env: gym.Env, rule: Callable[[gym.Env], Any], n_timesteps: int, name: str) -> None:
    """
    Train and print mean returns.

    :param env: environment with hybrid actions and observations that are a vector
    :param rule: gives the action of a simple rule
    :param n_timesteps: steps of the training
    :param name: of its rows in docs/examples.md
    """
    parser = argparse.ArgumentParser()
    parser.add_argument("--algo", default="chdp", choices=list(ALGORITHMS))
    parser.add_argument("--steps", type=int, default=n_timesteps, help="steps of a training")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0], help="a training each; returns are means over them")
    parser.add_argument("--episodes", type=int, default=20, help="test episodes")
    parser.add_argument("--write", action="store_true", help="write the returns into docs/examples.md")
    args = parser.parse_args()

    env.action_space.seed(0)
    returns = {
        "random actions": mean_return(env, lambda _: env.action_space.sample(), args.episodes),
        "simple rule": mean_return(env, lambda _: rule(env), args.episodes),
    }
    trials = []
    for seed in args.seeds:
        model = ALGORITHMS[args.algo].load_class()("MlpPolicy", env, seed=seed)

        def policy(obs: Any, model: Any = model) -> Any:
            return model.predict(obs, deterministic=True)[0]

        before = mean_return(env, policy, args.episodes)
        model.learn(args.steps)
        trials.append((before, mean_return(env, policy, args.episodes)))
    returns["before training"], returns["after training"] = np.mean(trials, axis=0)
    for what, value in returns.items():
        print(f"{what:16} {value:,.1f}")
    if args.write:
        start, settings = f"{name} | {ALGORITHMS[args.algo].display_name}", f"{args.steps:,} | {len(args.seeds)}"
        write_row(PAGE, start, f"{settings} | {' | '.join(f'{value:,.1f}' for value in returns.values())}")
