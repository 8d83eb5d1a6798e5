"""The Gymnasium side of the environments."""

import copy
import pickle

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from sb3_chdp import HybridActionSpec, check_hybrid_env
from sb3_chdp.envs import ENV_IDS
from sb3_chdp.envs.point_mass import HardMoveEnv

EDGES = [
    ("Platform-v0", (0, [[np.nan]] * 3)),
    ("Platform-v0", (3, [[0.0]] * 3)),
    ("Goal-v0", (0, [[0.0]] * 3)),
    ("Goal-v0", 1),
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
    check_env(gym.make(env_id).unwrapped, skip_render_check=True)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_check_hybrid_env(env_id):
    check_hybrid_env(gym.make(env_id))


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_seeding_and_pickling(env_id):
    env = gym.make(env_id)
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


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_rendering(env_id, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pytest.importorskip("pygame")
    env = gym.make(env_id, render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    assert before.dtype == np.uint8 and before.shape == (*env.unwrapped.screen_size[::-1], 3)
    spec = HybridActionSpec(env.action_space)
    env.step(spec.to_native(np.append(0, np.full(spec.max_parameters, 0.5))))
    state = env.unwrapped.get_state()
    state[0] += 0.3
    env.unwrapped.set_state(state)
    assert (env.render() != before).any()
    # Not every state is in the picture
    state[:2] = 1e6
    env.unwrapped.set_state(state)
    env.render()
    env.close()
    window = gym.make(env_id, render_mode="human")
    window.reset(seed=0)
    window.close()


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_frame_callback(env_id):
    """It sees every frame inside a step, and changes nothing."""
    watched, other = gym.make(env_id).unwrapped, gym.make(env_id).unwrapped
    spec = HybridActionSpec(watched.action_space)
    states = []
    for env in (watched, other):
        env.reset(seed=3)
    watched.frame_callback = lambda: states.append(watched.get_state())
    for row in spec.sample_rows(np.random.default_rng(0), 20):
        states.clear()
        (*_, info), (*_, other_info) = (env.step(spec.to_native(row)) for env in (watched, other))
        assert len(states) == info["frames"] == other_info["frames"]
        np.testing.assert_array_equal(watched.get_state(), other.get_state())
        assert info["frames"] < 2 or (states[0] != states[-1]).any()


@pytest.mark.parametrize("env_id, action", EDGES)
def test_bad_actions(env_id, action):
    env = gym.make(env_id).unwrapped
    env.reset(seed=0)
    state = env.get_state()
    with pytest.raises(ValueError, match="action must be"):
        env.step(action)
    np.testing.assert_array_equal(env.get_state(), state)


def test_arguments():
    env = HardMoveEnv(n_actuators=6, start=(0.1, 0.2), target=(0.1, 0.5))
    for seed in range(3):
        obs, _ = env.reset(seed=seed)
        np.testing.assert_allclose(obs, [0, 0, 0, 0.3], atol=1e-7)
    with pytest.raises(ValueError, match="target must be"):
        HardMoveEnv(target=(0.1,))
    with pytest.raises(ValueError, match="n_actuators must be"):
        HardMoveEnv(n_actuators=1)
    with pytest.raises(ValueError, match="render_mode must be"):
        HardMoveEnv(render_mode="ascii")
    with pytest.raises(ValueError, match="state must have the columns"):
        env.set_state(np.zeros(3))


def test_noise_is_random_and_can_be_silenced():
    for noise in (True, False):
        env = gym.make("Goal-v0", noise=noise).unwrapped
        env.reset(seed=0)
        state = env.get_state()
        results = []
        for _ in range(2):
            env.set_state(state)
            env.step((0, [np.array([5.0, 0.0]), np.zeros(1), np.zeros(1)]))
            results.append(env.get_state())
        assert (results[0] == results[1]).all() == (not noise)
