"""
What the critics of CHDP make of the states of episodes on Goal or Hard Goal, and what agents get from there.

    python benchmarks/goal_values.py                      the published model of Hard Goal
    python benchmarks/goal_values.py --env Goal-v0 --model benchmarks/results/main/chdp/Goal-v0/seed_104.zip

For the states of deterministic episodes, by the height of the start and the number of actions that follow the one taken there:
min(Q1, Q2) of the best of the target's candidates; of the best that the search of deterministic predictions finds; and the
discounted return. A target far below the search is one that does not find the action, a value far below the return one that
does not resolve it; a value above the return puts off what scores.
"""

from collections import defaultdict
from itertools import pairwise
from typing import Any

import numpy as np
import torch as th
from goal_kicks import MAX_STEPS, model_and_env, state_values

from sb3_chdp import CHDP
from sb3_chdp.chdp.losses import next_state_values

EDGES = (-15.0, -13.5, -12.0, -9.0, -6.0, -3.0, 0.0, 3.0, 6.0, 9.0, 12.0, 13.5, 15.0)
# Starts per range, how many states make an entry, and draws of the target's candidates
N_STARTS, MIN_STATES, N_DRAWS = 60, 10, 8


def target_values(model: CHDP, obs: np.ndarray) -> np.ndarray:
    """:return: (n,) values of n next observations in the target of the critics"""
    policy, n = model.policy, model.n_target_candidates
    draws = [next_state_values(policy, th.as_tensor(obs), n) for _ in range(N_DRAWS)]
    return th.stack(draws).mean(dim=0).numpy().ravel()


def trace(model: CHDP, env: Any, y: float) -> tuple[list[np.ndarray], list[float]]:
    """:return: observations of an episode from this height and the discounted returns from there on"""
    env._place_at_start(y)
    observations, rewards, over = [], [], False
    while not over and len(rewards) < MAX_STEPS:
        obs = env._observation()
        _, reward, over, _, _ = env.step(model.predict(obs, deterministic=True)[0])
        observations.append(obs)
        rewards.append(reward)
    returns, following = [], 0.0
    for reward in reversed(rewards):
        following = reward + model.gamma * following
        returns.append(following)
    return observations, returns[::-1]


def main() -> None:
    model, env = model_and_env(__doc__)
    print("| start | actions after this one | states | target | search | return |")
    print("|---|---|---|---|---|---|")
    for low, high in pairwise(EDGES):
        states = defaultdict(list)
        for y in np.linspace(low, high, N_STARTS):
            episode = list(zip(*trace(model, env, y), strict=True))
            for to_go, state in enumerate(reversed(episode)):
                states[to_go].append(state)
        for to_go, entries in sorted(states.items()):
            if len(entries) < MIN_STATES:
                continue
            observations, returns = zip(*entries, strict=True)
            obs = np.stack(observations)
            values = (target_values(model, obs), state_values(model, obs), returns)
            numbers = " | ".join(f"{np.mean(value):.0f}" for value in values)
            print(f"| {low:g} to {high:g} | {to_go} | {len(entries)} | {numbers} |", flush=True)


if __name__ == "__main__":
    main()
