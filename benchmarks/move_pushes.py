"""
What a model of CHDP knows about the pushes of Hard Move: far targets are reached in time only at nearly full speed.

    python benchmarks/move_pushes.py                      the published models of n = 4, 6, 8 and 10
    python benchmarks/move_pushes.py --envs HardMove6-v0 --model benchmarks/results/main/chdp/HardMove6-v0/seed_40.zip

Prints success by the distance of the target; for all pushes at full strength, forwards and backwards, the rank correlation of
their Q with their component towards the target; that component for the pushes that the model takes on its way to targets
more than 1.5 away (1: the longest push, exactly towards it); and how much of the variance of the pushes is a linear function
of the codewords (of random ones: latent_dim / K).
"""

import argparse
from itertools import pairwise

import gymnasium as gym
import numpy as np
import torch as th
from cells import ROOT
from scipy.stats import spearmanr

from sb3_chdp import CHDP
from sb3_chdp.envs.point_mass import motion_table

DISTANCES = (0.0, 1.0, 1.5, 2.9)
FAR = 1.5


def push_values(model: CHDP, obs: np.ndarray) -> np.ndarray:
    """:return: (2 K,) min(Q1, Q2) of the target critics for all pushes at full strength, forwards, then backwards"""
    critic, codebook = model.critic_target, model.actor_target.codebook
    n_actions = codebook.n_discrete_actions
    k = th.arange(n_actions).repeat(2)
    strengths = th.ones(2 * n_actions, 1)
    strengths[n_actions:] = -1
    with th.no_grad():
        features = critic.features(th.as_tensor(obs)[None]).expand(2 * n_actions, -1)
        return th.min(*critic.q_values(features, codebook.representative_latents(k), strengths)).numpy().ravel()


def codebook_order(model: CHDP, motions: np.ndarray) -> float:
    """
    :param motions: (K, 2) pushes of the discrete actions
    :return: share of their variance that a linear function of the codewords explains
    """
    codewords = model.actor_target.codebook.codewords.detach().numpy()
    inputs = np.column_stack([codewords, np.ones(len(codewords))])
    weights = np.linalg.lstsq(inputs, motions, rcond=None)[0]
    return 1 - float(np.square(motions - inputs @ weights).sum() / np.square(motions - motions.mean(axis=0)).sum())


def run(model: CHDP, env_id: str, episodes: int) -> tuple[list[tuple[float, bool]], list[float], list[float]]:
    """:return: distance and success of every episode; rank correlations at far starts; components of pushes there"""
    env = gym.make(env_id)
    motions = motion_table(env.unwrapped.n_actuators)
    pushes = np.concatenate([motions, -motions])
    results, correlations, components = [], [], []
    for seed in range(episodes):
        obs, _ = env.reset(seed=seed)
        distance, over = float(np.linalg.norm(obs[2:])), False
        if distance > FAR:
            correlations.append(spearmanr(push_values(model, obs), pushes @ obs[2:]).statistic)
        while not over:
            action, _ = model.predict(obs, deterministic=True)
            if distance > FAR and np.linalg.norm(obs[2:]) > 0.5:
                k, strength = int(action[0]), float(action[1][int(action[0])][0])
                components.append(float(strength * motions[k] @ obs[2:] / np.linalg.norm(obs[2:])))
            obs, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        results.append((distance, info["is_success"]))
    return results, correlations, components


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", nargs="+", default=[f"HardMove{n}-v0" for n in (4, 6, 8, 10)])
    parser.add_argument("--model", help="zip of a trained model (default: the published one of each environment)")
    parser.add_argument("--episodes", type=int, default=300)
    parser.add_argument("--random-candidates", type=int, help="n_random_candidates (default: the model's)")
    args = parser.parse_args()
    bins = list(pairwise(DISTANCES))
    print("| environment | random candidates | " + " | ".join(f"success, {a:g} to {b:g} away" for a, b in bins), end=" ")
    print("| correlation of Q | component of pushes | order of codewords |")
    print("|---|---|" + "---|" * len(bins) + "---|---|---|")
    for env_id in args.envs:
        path = args.model or ROOT / "models" / "chdp" / f"{env_id}_1" / f"{env_id}.zip"
        model = CHDP.load(path, device="cpu")
        if args.random_candidates is not None:
            model.policy.n_random_candidates = args.random_candidates
        results, correlations, components = run(model, env_id, args.episodes)
        distances, successes = (np.array(values) for values in zip(*results, strict=True))
        rates = [f"{100 * successes[(a <= distances) & (distances < b)].mean():.0f} %" for a, b in bins]
        order = codebook_order(model, motion_table(gym.make(env_id).unwrapped.n_actuators))
        measures = f"{np.mean(correlations):.2f} | {np.mean(components):.2f} | {order:.2f}"
        print(f"| {env_id} | {model.policy.n_random_candidates} | {' | '.join(rates)} | {measures} |", flush=True)


if __name__ == "__main__":
    main()
