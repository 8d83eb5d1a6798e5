"""
What the critics' target of CHDP makes of next states on Goal or Hard Goal, and what agents get from there.

    python benchmarks/next_values.py                      the published model of Hard Goal
    python benchmarks/next_values.py --env Goal-v0 --model benchmarks/results/main/chdp/Goal-v0/seed_91.zip

For the states after the first action, if play goes on, by the height of the start: min(Q1, Q2) of the best of the target's own
candidates; of the best that the search of deterministic predictions finds; and the discounted return of these predictions.
A target far below the return means that critics cannot learn what the first action is worth.
"""

from itertools import pairwise
from typing import Any

import numpy as np
import torch as th
from goal_kicks import MAX_STEPS, model_and_env, state_values

from sb3_chdp import CHDP
from sb3_chdp.chdp.losses import best_next_actions
from sb3_chdp.common.type_aliases import HybridReplaySamples

EDGES = (-15.0, -13.5, -12.0, -9.0, -6.0, -3.0, 0.0, 3.0, 6.0, 9.0, 12.0, 13.5, 15.0)
# Starts per range, and draws of the target's candidates
N_STARTS, N_DRAWS = 60, 8


def target_values(model: CHDP, obs: np.ndarray) -> np.ndarray:
    """:return: (n,) values of n next observations in the target of the critics, without what a buffer remembers"""
    nothing = th.zeros(len(obs), 0)
    parts: dict[str, Any] = dict.fromkeys(HybridReplaySamples._fields, nothing) | dict(next_observations=th.as_tensor(obs))
    data = HybridReplaySamples(**parts)
    draws = [best_next_actions(model.policy, data, model.n_target_candidates, 0)[1] for _ in range(N_DRAWS)]
    return th.stack(draws).mean(dim=0).numpy().ravel()


def discounted_return(model: CHDP, env: Any) -> float:
    """:return: discounted return of deterministic predictions from the present state of the environment on"""
    obs, total = env._observation(), 0.0
    for t in range(MAX_STEPS):
        obs, reward, over, _, _ = env.step(model.predict(obs, deterministic=True)[0])
        total += model.gamma**t * reward
        if over:
            break
    return total


def main() -> None:
    model, env = model_and_env(__doc__)
    print("| start | play goes on, % | target | search | return |")
    print("|---|---|---|---|---|")
    for low, high in pairwise(EDGES):
        observations, returns = [], []
        for y in np.linspace(low, high, N_STARTS):
            env._place_at_start(y)
            obs, _, over, _, _ = env.step(model.predict(env._observation(), deterministic=True)[0])
            if not over:
                observations.append(obs)
                returns.append(discounted_return(model, env))
        entries = ["-"] * 3
        if observations:
            obs = np.stack(observations)
            values = (target_values(model, obs), state_values(model, obs), returns)
            entries = [f"{np.mean(value):.0f}" for value in values]
        share = 100 * len(observations) / N_STARTS
        print(f"| {low:g} to {high:g} | {share:.0f} | " + " | ".join(entries) + " |", flush=True)


if __name__ == "__main__":
    main()
