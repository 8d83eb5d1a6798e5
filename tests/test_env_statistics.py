"""Outcome statistics and noise moments of the original environments, noise on."""

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import ks_2samp

from sb3_chdp import HybridActionSpec
from sb3_chdp.envs.hard_move import motion_table
from tests.hybrid_envs import gym_make

DATA = Path(__file__).parent / "data"
STATISTICS = np.load(DATA / "stats_noise.npz")
MOMENTS = np.load(DATA / "noise_moments.npz")
N_EPISODES = 500
IDS = {
    "platform": "Platform-v0",
    "goal": "Goal-v0",
    "hard_goal": "HardGoal-v0",
    "catch_point": "CatchPoint-v0",
    **{f"hard_move_{n}": f"HardMove{n}-v0" for n in (4, 6, 8, 10)},
}


def far_side(env, height):
    return -height if env.keeper.y > env.ball.y else height


def platform_rules(env, hop=577.0, last_hop=660.0):
    for limit, k, value in (
        (46, 1, 260), (206, 0, 15), (318, 1, hop), (475, 1, 545), (601, 1, 316), (683, 0, 22), (719, 0, 12.5)
    ):  # fmt: skip
        if env.x < limit:
            return k, [value]
    return 1, [last_hop]


def point_mass_push(env, obs, gain_position, gain_velocity):
    return np.array([gain_position * obs[2] - gain_velocity * obs[0], gain_position * obs[3] - gain_velocity * obs[1]])


def hard_move_greedy(env, obs, t):
    push = point_mass_push(env, obs, 5, 3)
    motions = motion_table(env.n_actuators)
    k = int((motions @ push).argmax())
    return k, [np.clip(motions[k] @ push / max(2 * motions[k] @ motions[k], 1e-6), -1, 1)]


def catch(radius):
    def policy(env, obs, t):
        if np.hypot(obs[2], obs[3]) < radius:
            return 1, []
        return 0, [np.arctan2(obs[2], obs[3]) / np.pi]

    return policy


# (env, observation, step) -> k and its parameters
POLICIES = {
    "platform.run_full": lambda env, obs, t: (0, [30.0]),
    "platform.hop_441": lambda env, obs, t: (1, [441.0]),
    "platform.leap_then_run": lambda env, obs, t: (0, [4.0]) if t % 2 else (2, [430.0]),
    "platform.rules": lambda env, obs, t: platform_rules(env),
    "platform.rules_a": lambda env, obs, t: platform_rules(env, hop=565.0),
    "platform.rules_b": lambda env, obs, t: platform_rules(env, last_hop=502.0),
    "goal.shoot_far": lambda env, obs, t: (1, [far_side(env, 7.0)]),
    "goal.back_far": lambda env, obs, t: (2, [far_side(env, 5.5)]) if t else (0, [0.0, 0.0]),
    "goal.idle": lambda env, obs, t: (0, [0.0, 0.0]),
    "goal.diagonal5": lambda env, obs, t: (0, [5.0, -3.0]),
    "hard_goal.shoot_far": lambda env, obs, t: (1 if env.keeper.y > env.ball.y else 5, [0.0]),
    "hard_goal.back_far": lambda env, obs, t: (
        ((6, [-0.0770328]) if env.keeper.y > env.ball.y else (10, [0.0770328])) if t else (0, [0.0, 0.0])
    ),
    "catch_point.greedy": catch(0.15),
    "catch_point.eager": catch(0.35),
    "catch_point.spam_catch": lambda env, obs, t: (1, []),
    "catch_point.spin": lambda env, obs, t: (0, [0.3 * t / np.pi]),
    **{f"hard_move_{n}.greedy": hard_move_greedy for n in (4, 6, 8, 10)},
    **{f"hard_move_{n}.fixed": lambda env, obs, t: (1, [0.5]) for n in (4, 6, 8, 10)},
    **{f"{name}.random": None for name in IDS},
}


def play(name, n_episodes, seed=1):
    """:return: (n_episodes, 4) return, success, length and frames of the episodes of one policy"""
    env = gym_make(IDS[name.split(".")[0]])
    spec = HybridActionSpec(env.action_space)
    rng = np.random.default_rng(seed)
    policy = POLICIES[name]
    empty = [np.zeros(0)] * spec.n_discrete_actions
    results = []
    for episode in range(n_episodes):
        obs, _ = env.reset(seed=seed if episode == 0 else None)
        totals, t, done = np.zeros(4), 0, False
        while not done:
            if policy is None:
                action = spec.to_native(spec.sample_rows(rng, 1)[0])
            else:
                k, parameters = policy(env.unwrapped, obs, t)
                action = (k, [*empty[:k], np.array(parameters), *empty[k + 1 :]])
            obs, reward, terminated, truncated, info = env.step(action)
            t += 1
            done = terminated or truncated
            totals += (reward, info["is_success"], 1, info["frames"])
        results.append(totals)
    return np.array(results)


@pytest.mark.parametrize("name", POLICIES)
def test_outcomes(name):
    ours = play(name, N_EPISODES)
    for column, quantity in enumerate(("return", "success", "length", "frames")):
        theirs = STATISTICS[f"{name}.{quantity}"].astype(float)
        error = np.sqrt(ours[:, column].var() / len(ours) + theirs.var() / len(theirs))
        difference = ours[:, column].mean() - theirs.mean()
        # A rare success may be seen by one side only: three of them stay within the error bars
        slack = 3 / N_EPISODES if quantity == "success" else 1e-6
        assert abs(difference) <= 4 * error + slack, f"{quantity}: {difference} with error {error}"
    theirs = STATISTICS[f"{name}.return"].astype(float)
    if theirs.std() > 1e-6:
        # The records are float32: rounding makes equal returns equal
        assert ks_2samp(ours[:, 0].round(4), theirs.round(4)).pvalue > 1e-4


@pytest.mark.parametrize("case", [f"{name}.{i}" for name in ("platform", "goal") for i in range(8)])
def test_noise_moments(case):
    env = gym_make(IDS[case.split(".")[0]]).unwrapped
    env.reset(seed=2)
    names = np.load(DATA / f"{case.split('.')[0]}.npz")["state_names"].tolist()
    state, k = dict(zip(names, MOMENTS[f"{case}.state"], strict=True)), int(MOMENTS[f"{case}.k"])
    parameters = [np.zeros(0)] * 3
    parameters[k] = MOMENTS[f"{case}.param_native"][: env.action_space[1][k].shape[0]]
    n, n_theirs = 1500, int(MOMENTS[f"{case}.n"])
    following = np.empty((n, len(state)))
    for i in range(n):
        env.set_state(state)
        env.step((k, parameters))
        reached = env.get_state()
        following[i] = [reached[name] for name in names]
    mean, std = MOMENTS[f"{case}.mean"], MOMENTS[f"{case}.std"]
    if case.startswith("platform"):
        # About one jump in 4000 ends on an enemy in the air, which decides the standard deviation: compare quantiles
        quantiles = MOMENTS[f"{case}.quantiles"]
        spread = quantiles[5] - quantiles[1]
        ours = np.quantile(following, [0.05, 0.25, 0.5, 0.75, 0.95], axis=0)
        assert (np.abs(ours - quantiles[1:6]) <= 0.12 * spread + 1e-6).all()
        return
    assert (np.abs(following.mean(axis=0) - mean) <= 5 * std * np.sqrt(1 / n + 1 / n_theirs) + 1e-6).all()
    ours = following.std(axis=0, ddof=1)
    # Mixtures of outcomes have heavy tails: their spread has a larger standard error
    kurtosis = ((following - following.mean(axis=0)) ** 4).mean(axis=0) / np.maximum(ours, 1e-9) ** 4
    tolerance = np.maximum(0.1, 5 * np.sqrt(np.maximum(kurtosis - 1, 0) / (4 * n)))
    assert (np.abs(ours - std) <= tolerance * std + 1e-6).all()
