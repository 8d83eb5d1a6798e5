"""Every recorded transition of the original environments must be reproduced, noise off."""

from pathlib import Path

import numpy as np
import pytest

from tests.hybrid_envs import gym_make

DATA = Path(__file__).parent / "data"
FILES: dict[str, tuple[str, dict]] = {
    "platform": ("Platform-v0", {}),
    "goal": ("Goal-v0", {}),
    "hard_goal": ("HardGoal-v0", {}),
    "catch_point": ("CatchPoint-v0", {}),
    **{f"hard_move_{n}": ("HardMove-v0", {"n_actuators": n}) for n in (4, 6, 8, 10)},
}
# Absolute tolerances on state and reward, and on the observation
TOLERANCES = {"goal": (1e-7, 1e-5), "hard_goal": (1e-7, 1e-5)}


def native_action(env, golden, row):
    """The action of a row; point masses and the shots of Hard Goal take scaled parameters, the others native ones."""
    k = int(golden["k"][row])
    n = int(golden["param_dim"][k])
    own_units = golden["param_native"][row]
    is_scaled = env.action_space[1][k].shape == (1,) and env.action_space[1][k].high[0] == 1.0
    # A parameter of an action without one was recorded as well, and must have no effect
    values = golden["param_scaled"][row] if is_scaled else own_units
    parameters = [np.zeros(0)] * len(env.action_space[1])
    parameters[k] = values[:n]
    return k, parameters


def values(env, names):
    """:return: the named entries of the state"""
    state = env.unwrapped.get_state()
    return np.array([state[name] for name in names])


@pytest.mark.parametrize("name", FILES)
def test_golden_transitions(name):
    env_id, kwargs = FILES[name]
    golden = dict(np.load(DATA / f"{name}.npz"))  # a dict: the archive unpacks at every access
    env = gym_make(f"sb3_chdp/{env_id}", noise=False, **kwargs).unwrapped
    names = golden["state_names"].tolist()
    assert set(env.get_state()) == {*names, "np_random"}
    tolerance, obs_tolerance = TOLERANCES.get(name, (1e-9, 1e-6))
    fragile = golden["fragile"].astype(bool) if "fragile" in golden else np.zeros(len(golden["k"]), dtype=bool)
    agrees = np.zeros(len(fragile), dtype=bool)
    for row in range(len(fragile)):
        state = dict(zip(names, golden["state"][row], strict=True))
        np.testing.assert_allclose(env.set_state(state), golden["obs"][row], rtol=0, atol=obs_tolerance)
        np.testing.assert_array_equal(values(env, names), golden["state"][row])
        obs, reward, terminated, truncated, info = env.step(native_action(env, golden, row))
        agrees[row] = (
            np.abs(values(env, names) - golden["next_state"][row]).max() <= tolerance
            and abs(reward - golden["reward"][row]) <= tolerance
            and np.abs(obs - golden["next_obs"][row]).max() <= obs_tolerance
            and terminated == golden["terminated"][row]
            and info["is_success"] == golden["success"][row]
            and info["frames"] == golden["frames"][row]
            and not truncated  # step limits are the wrapper's
        )
        assert agrees[row] or fragile[row], f"row {row}"
    # Rows on a knife's edge: the same order of operations agrees on them too
    assert agrees[fragile].all()


def test_step_limits_truncate():
    env = gym_make("HardMove4-v0")
    env.reset(seed=0)
    action = (0, [np.zeros(1, dtype=np.float32)] * 16)
    for t in range(1, 31):
        _, _, terminated, truncated, info = env.step(action)
        assert not terminated and truncated == (t == 30) and info["is_success"] is False


def test_goal_terminates_at_its_own_limit():
    env = gym_make("Goal-v0")
    env.reset(seed=0)
    env.unwrapped.set_state({"time": 99})
    _, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert terminated and not truncated and info["outcome"] == "timeout" and info["frames"] == 0 and reward < 0


def test_fixed_intervals_of_hard_goal():
    """A shot goes to where Goal's own shot at the recorded height goes."""
    golden = np.load(DATA / "hard_goal.npz")
    hard_goal = gym_make("HardGoal-v0", fixed_intervals=True, noise=False)
    goal = gym_make("Goal-v0", noise=False)
    hard_goal.reset(seed=0)
    goal.reset(seed=0)
    names = golden["state_names"].tolist()
    for row in np.flatnonzero(golden["k"] > 0)[::10]:
        k, state = int(golden["k"][row]), dict(zip(names, golden["state"][row], strict=True))
        for env in (hard_goal, goal):
            env.unwrapped.set_state(state)
        hard_goal.step((k, [[0.0, 0.0], *[golden["param_scaled"][row][:1]] * 10]))
        goal.step((1 if k <= 5 else 2, [[0.0, 0.0], *[golden["param_native_fixed"][row][:1]] * 2]))
        np.testing.assert_allclose(values(hard_goal, names), values(goal, names), atol=1e-5)


@pytest.mark.parametrize("n", [4, 6, 8, 10])
def test_motion_table(n):
    from sb3_chdp.envs.hard_move import motion_table

    np.testing.assert_allclose(motion_table(n), np.load(DATA / f"hard_move_{n}.npz")["motion_table"], atol=1e-15)


def test_resets():
    resets = np.load(DATA / "resets.npz")
    names = np.load(DATA / "goal.npz")["state_names"].tolist()
    env = gym_make("Goal-v0")
    for state, expected in zip(resets["goal.state"], resets["goal.obs"], strict=True):
        obs, _ = env.reset(options={"start": state[1]})
        np.testing.assert_allclose(values(env, names), state, atol=1e-12)
        np.testing.assert_allclose(obs, expected, atol=1e-6)
    names = np.load(DATA / "platform.npz")["state_names"].tolist()
    platform = gym_make("Platform-v0")
    np.testing.assert_allclose(platform.reset(seed=3)[0], resets["platform.obs"][0], atol=1e-6)
    np.testing.assert_array_equal(values(platform, names), resets["platform.state"][0])
