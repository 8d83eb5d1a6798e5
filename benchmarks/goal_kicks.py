"""
What a model of CHDP knows about the first kick on Goal or Hard Goal, by the height of the start.

    python benchmarks/goal_kicks.py                       the published model of Hard Goal
    python benchmarks/goal_kicks.py --env Goal-v0 --model benchmarks/results/main/chdp/Goal-v0/seed_60.zip

Prints success and length of episodes, and for kicks to (v, 0) two values that agree if the critics have learnt: Q of the kick,
and the discounted value of what follows it, by the same critics.
"""

import argparse

import gymnasium as gym
import numpy as np
import torch as th
from cells import ROOT

from sb3_chdp import CHDP

KICKS = (0.0, 0.5, 1.0, 2.0, 4.0, 6.0)
N_STARTS, N_KICKS = 20, 12


def state_values(model: CHDP, obs: np.ndarray) -> np.ndarray:
    """:return: (n,) values of n observations: min(Q1, Q2) of the target critics for the best of the candidates"""
    policy, obs_tensor = model.policy, th.as_tensor(obs)
    with th.no_grad():
        features, critic_features = policy.actor_target.features(obs_tensor), policy.critic_target.features(obs_tensor)
        n_candidates = (policy.n_action_candidates, policy.n_random_candidates, policy.n_refinement_candidates)
        *_, values = policy.best_candidate(policy.actor_target, features, critic_features, *n_candidates)
    return values.numpy().ravel()


def kick_values(model: CHDP, obs: np.ndarray, kicks: np.ndarray) -> np.ndarray:
    """:return: (n,) min(Q1, Q2) of the target critics for n kicks at one observation"""
    spec, critic, n = model.hybrid_space.spec, model.critic_target, len(kicks)
    parameters = th.zeros(n, spec.max_parameters)
    parameters[:, 0] = th.as_tensor(kicks / 20 - 1)
    with th.no_grad():
        features = critic.features(th.as_tensor(obs)[None]).expand(n, -1)
        latents = model.actor_target.codebook.representative_latents(th.zeros(n, dtype=th.long))
        return th.min(*critic.q_values(features, latents, parameters)).numpy().ravel()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HardGoal-v0", choices=["Goal-v0", "HardGoal-v0"])
    parser.add_argument("--model", help="zip of a trained model (default: the published one)")
    args = parser.parse_args()
    model = CHDP.load(args.model or ROOT / "models" / "chdp" / f"{args.env}_1" / f"{args.env}.zip", device="cpu")
    env = gym.make(args.env).unwrapped
    env.reset(seed=0)
    kick = [space.sample() for space in env.action_space[1]]

    print("| start | success, % | steps | " + " | ".join(f"kick to {v:g}: Q, then" for v in KICKS) + " |")
    print("|---|---|---|" + "---|" * len(KICKS))
    for low in range(-15, 15, 3):
        successes, lengths = [], []
        for y in np.linspace(low, low + 3, N_STARTS):
            env._place_at_start(y)
            over, length = False, 0
            while not over:
                action, _ = model.predict(env._observation(), deterministic=True)
                _, _, over, _, info = env.step(action)
                length += 1
            successes.append(info["is_success"])
            lengths.append(length)
        entries = []
        env._place_at_start(low + 1.5)
        q_values = kick_values(model, env._observation(), np.array(KICKS))
        for v, q_value in zip(KICKS, q_values, strict=True):
            returns = []
            for _ in range(N_KICKS):
                env._place_at_start(low + 1.5)
                kick[0] = np.array([v, 0.0], dtype=np.float32)
                obs, reward, over, _, _ = env.step((0, tuple(kick)))
                returns.append(reward if over else model.gamma * state_values(model, obs[None]).item())
            entries.append(f"{q_value:.0f}, {np.mean(returns):.0f}")
        mean_success, mean_length = 100 * np.mean(successes), np.mean(lengths)
        print(f"| {low} to {low + 3} | {mean_success:.0f} | {mean_length:.1f} | " + " | ".join(entries) + " |", flush=True)


if __name__ == "__main__":
    main()
