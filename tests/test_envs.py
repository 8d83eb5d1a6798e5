"""The Gymnasium side of the environments."""

import copy
import importlib.util
import inspect
import pickle
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sb3_chdp import HybridActionSpec, check_hybrid_env
from sb3_chdp.envs import ENV_IDS
from sb3_chdp.envs.hard_move import HardMoveEnv
from tests.hybrid_envs import gym_make

EDGES = [
    ("Platform-v0", (0, [[np.nan]] * 3)),
    ("Platform-v0", (3, [[0.0]] * 3)),
    ("Goal-v0", (0, [[0.0]] * 3)),
    ("Goal-v0", 1),
]
# Bad reset options: what is given, and what the error must name
OPTIONS = [
    ("Platform-v0", {"start": 300.0}, "start"),
    ("Platform-v0", {"start": [1.0, 2.0]}, "start"),
    ("Platform-v0", {"start": "a"}, "start"),
    ("Goal-v0", {"start": None}, "start"),
    ("Platform-v0", {"target": 0.0}, "target"),
    ("Goal-v0", {"start": 15.1}, "start"),
    ("Goal-v0", {"start": float("nan")}, "start"),
    ("HardGoal-v0", {"height": 1.0}, "height"),
    ("CatchPoint-v0", {"start": 1.0}, "start"),
    ("HardMove4-v0", {"target": (0.1, np.inf)}, "target"),
    ("HardMove4-v0", {"target": "ab"}, "target"),
    ("HardMove4-v0", {"target": None}, "target"),
]
# A start that is allowed, and the state that it must lead to
STARTS = [
    ("Platform-v0", {"start": 500.0}, {"player_x": 500.0, "player_y": 40.0, "enemy2_x": 730.0}),
    ("Goal-v0", {"start": -12.5}, {"player_x": 0.0, "player_y": -12.5, "goalie_x": 14.5, "time": 0}),
    ("HardGoal-v0", {"start": 7}, {"player_y": 7.0}),
    ("CatchPoint-v0", {"target": (0.5, 1.5)}, {"target_x": 0.5, "target_y": 1.5, "agent_vx": 0.0, "misses": 0}),
    ("HardMove6-v0", {"start": [0.1, 0.2], "target": np.zeros(2)}, {"agent_x": 0.1, "agent_y": 0.2, "target_x": 0.0}),
]


def rollout(env, seed, n_steps=40):
    """Random actions from a seed; :return: all that the environment gave"""
    spec = HybridActionSpec(env.action_space)
    rng = np.random.default_rng(seed)
    obs, _ = env.reset(seed=seed)
    trace = [obs]
    for _ in range(n_steps):
        obs, reward, terminated, truncated, info = env.step(spec.to_native(spec.sample_rows(rng, 1)[0]))
        assert set(info) >= {"is_success", "frames"} and isinstance(info["is_success"], bool)
        trace.append((obs, reward, terminated, truncated))
        if terminated or truncated:
            obs, _ = env.reset()
            trace.append(obs)
    return trace


@pytest.mark.parametrize("env_id", ENV_IDS)
# Native bounds are the originals', and velocities have none there
@pytest.mark.filterwarnings("ignore:.*(infinity|symmetric and normalized|render_mode)")
def test_api(env_id):
    check_env(gym_make(env_id).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_check_hybrid_env(env_id):
    check_hybrid_env(gym_make(env_id))


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_seeding_and_pickling(env_id):
    env = gym_make(env_id)
    first = rollout(env, seed=7)
    np.testing.assert_equal(rollout(env, seed=7), first)
    np.testing.assert_equal(rollout(pickle.loads(pickle.dumps(env)), seed=7), first)
    with pytest.raises(AssertionError):
        np.testing.assert_equal(rollout(env, seed=8), first)
    # A copy in the middle of an episode goes on in the same way, noise included
    twin = copy.deepcopy(env)
    spec = HybridActionSpec(env.action_space)
    action = spec.to_native(spec.sample_rows(np.random.default_rng(0), 1)[0])
    np.testing.assert_equal(env.step(action), twin.step(action))


@pytest.mark.parametrize("env_id, action", EDGES)
def test_bad_actions(env_id, action):
    env = gym_make(env_id).unwrapped
    env.reset(seed=0)
    state = env.get_state()
    with pytest.raises(ValueError, match="action must be"):
        env.step(action)
    assert env.get_state() == state


@pytest.mark.parametrize("env_id, options, expected", STARTS)
def test_reset_options(env_id, options, expected):
    env = gym_make(env_id)
    obs, _ = env.reset(seed=4, options=options)
    state = env.get_state()
    assert {name: state[name] for name in expected} == expected
    np.testing.assert_array_equal(env.set_state(state), obs)
    # The option neither lasts nor changes what is random afterwards
    other = gym_make(env_id)
    other.reset(seed=4)
    np.testing.assert_array_equal(env.reset()[0], other.reset()[0])
    assert env.get_state() == other.get_state()


@pytest.mark.parametrize("env_id, options, named", OPTIONS)
def test_bad_reset_options(env_id, options, named):
    with pytest.raises(ValueError, match=rf"options\['{named}'\]"):
        gym_make(env_id).reset(options=options)


def test_reset_options_reach_vectorised_environments():
    from stable_baselines3.common.env_util import make_vec_env

    env: Any = make_vec_env("sb3_chdp/HardMove4-v0", 2)
    env.set_options([{"start": (0.0, 0.0), "target": (0.5, y)} for y in (0.25, -0.25)])
    np.testing.assert_array_equal(env.reset()[:, 2:], [[0.5, 0.25], [0.5, -0.25]])


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_states_resume_an_episode(env_id):
    """After set_state the same actions lead to the same steps, noise, step limit and next episodes included."""
    env = gym_make(f"sb3_chdp/{env_id}")
    env.action_space.seed(1)

    def go_on(env, actions):
        steps = []
        for action in actions:
            *step, info = env.step(action)
            steps.append((*step, info))
            if step[2] or step[3]:
                steps.append(env.reset())
        return steps

    env.reset(seed=2)
    # Near the end of an episode that only the step limit ends
    go_on(env, [env.action_space.sample() for _ in range(23)])
    actions = [env.action_space.sample() for _ in range(10)]
    state = pickle.loads(pickle.dumps(env.get_state()))
    expected = go_on(env, actions)
    env.set_state(state)
    np.testing.assert_equal(go_on(env, actions), expected)
    # In another process the environment is a new one
    fresh = gym_make(f"sb3_chdp/{env_id}")
    fresh.reset(seed=99)
    fresh.set_state(state)
    np.testing.assert_equal(go_on(fresh, actions), expected)
    state["np_random"] = fresh.get_state()["np_random"]
    env.set_state(state)
    with pytest.raises(AssertionError):
        np.testing.assert_equal(go_on(env, actions), expected)


def test_states_of_vectorised_environments():
    """As SB3's env_method reaches them, through Monitor."""
    from stable_baselines3.common.env_util import make_vec_env

    env: Any = make_vec_env("sb3_chdp/HardMove4-v0", 2, seed=0)
    env.reset()
    actions = [(3, [np.ones(1)] * 16)] * 2
    for _ in range(28):
        env.step(actions)
    states = env.env_method("get_state")
    assert [state["elapsed_steps"] for state in states] == [28, 28]
    env.step(actions)
    for i, state in enumerate(states):
        env.env_method("set_state", state, indices=i)
    assert not env.step(actions)[2].any() and env.step(actions)[2].all()


def test_bad_states():
    env = gym_make("Goal-v0")
    env.reset(seed=0)
    state = env.get_state()
    with pytest.raises(ValueError, match="got ball_z"):
        env.set_state({"ball_x": 1.0, "ball_z": 0.0})
    for value in (np.nan, "a", [0.0]):
        with pytest.raises(ValueError, match=r"state\['ball_x'\] must be a finite number"):
            env.set_state({"ball_y": 1.0, "ball_x": value})
    assert env.get_state() == state


def test_arguments():
    env = HardMoveEnv(n_actuators=6, start=(0.1, 0.2), target=(0.1, 0.5))
    for seed in range(3):
        obs, _ = env.reset(seed=seed)
        np.testing.assert_allclose(obs, [0, 0, 0, 0.3], atol=1e-7)
    obs, _ = env.reset(options={"target": (0.1, 0.2)})
    np.testing.assert_array_equal(obs, np.zeros(4))
    with pytest.raises(ValueError, match="target must be"):
        HardMoveEnv(target=(0.1,))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="n_actuators must be"):
        HardMoveEnv(n_actuators=1)
    with pytest.raises(ValueError, match="render_mode must be"):
        HardMoveEnv(render_mode="ascii")


def test_noise_is_random_and_can_be_silenced():
    for noise in (True, False):
        env = gym_make("Goal-v0", noise=noise)
        env.reset(seed=0)
        state = env.get_state()
        del state["np_random"]
        results = []
        for _ in range(2):
            env.set_state(state)
            env.step((0, [np.array([5.0, 0.0]), np.zeros(1), np.zeros(1)]))
            results.append(env.get_state()["ball_x"])
        assert (results[0] == results[1]) == (not noise)


@pytest.mark.parametrize("first", ["gym_platform", "sb3_chdp"])
def test_ids_beside_a_package_that_takes_the_same(first):
    """hybrid-platform registers Platform-v0: the full id is ours whoever comes first, and nothing is taken in silence."""
    if importlib.util.find_spec("gym_platform") is None:  # imported here it would take the bare id from all other tests
        pytest.skip("needs hybrid-platform")
    second = {"gym_platform": "sb3_chdp", "sb3_chdp": "gym_platform"}[first]
    code = (
        f"import {first}, {second}, gymnasium as gym;"
        "print(*(gym.spec(i).entry_point for i in ('sb3_chdp/Platform-v0', 'Platform-v0', 'Goal-v0')));"
        "print(type(gym.make('sb3_chdp/Platform-v0').unwrapped).__module__)"
    )
    result = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert result.stdout.split() == [
        "sb3_chdp.envs.platform:PlatformEnv",
        "gym_platform.envs:PlatformEnv",
        "sb3_chdp.envs.goal:GoalEnv",
        "sb3_chdp.envs.platform",
    ]
    # Our own warning names both, Gymnasium warns of an override
    told = "this package's is sb3_chdp/Platform-v0" if first == "gym_platform" else "Overriding environment Platform-v0"
    assert told in result.stderr


def test_ids_alone():
    """Both ids are ours, without a warning, even if the module is loaded again."""
    code = (
        "import warnings; warnings.simplefilter('error');"
        "import gymnasium as gym, sb3_chdp, importlib; importlib.reload(sb3_chdp.envs);"
        "pairs = [(gym.spec(i), gym.spec('sb3_chdp/' + i)) for i in (*sb3_chdp.envs.ENV_IDS, 'HardMove-v0')];"
        "print(all(bare.entry_point == full.entry_point and bare.kwargs == full.kwargs for bare, full in pairs))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.stdout.split() == ["True"], result.stderr


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_pages_name_all_arguments_and_options(env_id):
    env_class: Any = type(gym_make(env_id).unwrapped)
    page = env_class.__doc__.split("## Arguments")[1]
    for name, parameter in list(inspect.signature(env_class).parameters.items()):
        assert f"| `{name}` | {str(parameter.default).strip()} |" in page
    if env_id != "HardGoal-v0":  # which refers to Goal's
        options = page.split("## Reset options")[1]
        assert all(f"| `{name}` |" in options for name in env_class.option_names)
