"""
Whether an agent on Goal or Hard Goal puts off its shot, step by step, from starts in the lower corner.

    python benchmarks/goal_delays.py                      the published model of Hard Goal
    python benchmarks/goal_delays.py --env Goal-v0 --model benchmarks/results/main/chdp/Goal-v0/seed_91.zip

Means over the episodes in which play goes on at that step: how often the agent kicks instead of shooting; its value of the
state and the discounted return that follows; min(Q1, Q2) of the best of random shots, by the critics, and how often that shot
scores, tried in a copy of the state. A value far above the return that does not fall from step to step keeps itself up.
"""

from typing import Any

import numpy as np
import torch as th
from goal_kicks import MAX_STEPS, model_and_env, state_values

from sb3_chdp import CHDP

# Range of the starts, and their number
LOW, HIGH, N_STARTS = -15.0, -12.0, 200
N_SHOTS = 1000
STEPS_SHOWN = (0, 1, 2, 3, 4, 5, 7, 10, 15, 20)


def best_shot(model: CHDP, obs: np.ndarray, rng: np.random.Generator) -> tuple[Any, float]:
    """:return: of random shots that of highest min(Q1, Q2) by the target critics, as a native action, and that value"""
    spec, critic = model.hybrid_space.spec, model.critic_target
    k = rng.integers(1, spec.n_discrete_actions, N_SHOTS)
    parameters = rng.uniform(-1, 1, (N_SHOTS, spec.max_parameters)) * spec.mask[k]
    with th.no_grad():
        features = critic.features(th.as_tensor(obs)[None]).expand(N_SHOTS, -1)
        latents = model.actor_target.codebook.representative_latents(th.as_tensor(k))
        q_values = th.min(*critic.q_values(features, latents, th.as_tensor(parameters, dtype=th.float32)))
    best = int(q_values.argmax())
    return spec.to_native(np.concatenate([[k[best]], parameters[best]])), q_values[best].item()


def trace(model: CHDP, env: Any, y: float, rng: np.random.Generator) -> np.ndarray:
    """:return: (steps, 5) whether the agent kicks, value, discounted return, Q of the best shot and whether it scores"""
    env._place_at_start(y)
    rows, rewards, over = [], [], False
    while not over and len(rows) < MAX_STEPS:
        obs, state = env._observation(), env.get_state()
        shot, q_value = best_shot(model, obs, rng)
        scores = env.step(shot)[4]["is_success"]
        env.set_state(state)
        action, _ = model.predict(obs, deterministic=True)
        _, reward, over, _, _ = env.step(action)
        rows.append([action[0] == 0, state_values(model, obs[None]).item(), 0.0, q_value, scores])
        rewards.append(reward)
    values = np.array(rows, dtype=float)
    following = 0.0
    for t in reversed(range(len(rewards))):
        following = values[t, 2] = rewards[t] + model.gamma * following
    return values


def main() -> None:
    model, env = model_and_env(__doc__)
    rng = np.random.default_rng(0)
    traces = [trace(model, env, y, rng) for y in np.linspace(LOW, HIGH, N_STARTS)]
    print("| step | play goes on, % | kicks, % | value | return | best shot: Q | scores, % |")
    print("|---|---|---|---|---|---|---|")
    for step in STEPS_SHOWN:
        rows = [values[step] for values in traces if len(values) > step]
        if rows:
            # Means: kicks, value, return, Q, scores
            kicks, *middle, scores = np.mean(rows, axis=0)
            numbers = [100 * len(rows) / N_STARTS, 100 * kicks, *middle, 100 * scores]
            print(f"| {step} | " + " | ".join(f"{number:.0f}" for number in numbers) + " |")


if __name__ == "__main__":
    main()
