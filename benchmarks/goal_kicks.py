"""
What a model of CHDP knows about the first kick on Goal or Hard Goal, by the height of the start.

    python benchmarks/goal_kicks.py                       the published model of Hard Goal
    python benchmarks/goal_kicks.py --env Goal-v0 --model benchmarks/results/main/chdp/Goal-v0/seed_104.zip

Prints success and length of episodes; how often the best of 200 random kicks, followed by the policy, scores: what better
first kicks could gain; and for kicks to (v, 0) two values that agree if the critics have learnt: Q of the kick, and the
discounted value of what follows it, by the same critics.
"""

import argparse
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from cells import ROOT

from sb3_chdp import CHDP

KICKS = (0.0, 0.5, 1.0, 2.0, 4.0, 6.0)
N_STARTS, N_KICKS = 100, 12
# Random kicks to (0 to 6, -15 to 15), how many of those that scored are tried again, and how often
N_RANDOM_KICKS, N_RETRIED, RETRIALS = 200, 12, 10
# A kick that moves the ball back and forth is no progress
MAX_STEPS = 40


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


def play(model: CHDP, env: Any, y: float, kick: np.ndarray | None = None) -> tuple[bool, int]:
    """
    :param env: Goal or Hard Goal
    :param y: height of the start
    :param kick: (2,) target of the first kick, None if the policy decides
    :return: whether the episode ends in a goal, and its length
    """
    env._place_at_start(y)
    over, length, info = False, 0, {"is_success": False}
    while not over and length < MAX_STEPS:
        if kick is not None and length == 0:
            action = (0, (kick.astype(np.float32), *(space.low for space in env.action_space[1].spaces[1:])))
        else:
            action, _ = model.predict(env._observation(), deterministic=True)
        _, _, over, _, info = env.step(action)
        length += 1
    return info["is_success"], length


def best_first_kick(model: CHDP, env: Any, y: float, rng: np.random.Generator) -> float:
    """:return: success rate of the best of random first kicks, followed by the policy, in trials of its own"""
    kicks = rng.uniform((0, -15), (6, 15), (N_RANDOM_KICKS, 2))
    scoring = [kick for kick in kicks if play(model, env, y, kick)[0]][:N_RETRIED]
    rates = [np.mean([play(model, env, y, kick)[0] for _ in range(RETRIALS)]) for kick in scoring]
    if not scoring:
        return 0.0
    best = scoring[int(np.argmax(rates))]
    return float(np.mean([play(model, env, y, best)[0] for _ in range(2 * RETRIALS)]))


def model_and_env(description: str) -> tuple[CHDP, Any]:
    """:return: the model and the environment, without its wrappers, that the command line names"""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HardGoal-v0", choices=["Goal-v0", "HardGoal-v0"])
    parser.add_argument("--model", help="zip of a trained model (default: the published one)")
    args = parser.parse_args()
    model = CHDP.load(args.model or ROOT / "models" / "chdp" / f"{args.env}_1" / f"{args.env}.zip", device="cpu")
    model.policy.set_training_mode(False)
    env = gym.make(args.env).unwrapped
    env.reset(seed=0)
    return model, env


def main() -> None:
    model, env = model_and_env(__doc__)
    kick = [space.sample() for space in env.action_space[1]]

    rng = np.random.default_rng(0)
    columns = ["start", "success, %", "steps", "best first kick, %"]
    print("| " + " | ".join([*columns, *(f"kick to {v:g}: Q, then" for v in KICKS)]) + " |")
    print("|---|---|---|---|" + "---|" * len(KICKS))
    for low in range(-15, 15, 3):
        heights = np.linspace(low, low + 3, N_STARTS)
        successes, lengths = zip(*[play(model, env, y) for y in heights], strict=True)
        best = best_first_kick(model, env, low + 1.5, rng)
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
        numbers = [f"{100 * np.mean(successes):.0f}", f"{np.mean(lengths):.1f}", f"{100 * best:.0f}"]
        print(f"| {low} to {low + 3} | " + " | ".join([*numbers, *entries]) + " |", flush=True)


if __name__ == "__main__":
    main()
