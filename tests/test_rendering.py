"""Pictures of the environments."""

import copy

import numpy as np
import pytest

from sb3_chdp import HybridActionSpec
from sb3_chdp.envs import ENV_IDS
from tests.hybrid_envs import gym_make


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_rendering(env_id, monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pytest.importorskip("pygame")
    env = gym_make(env_id, render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    assert before.dtype == np.uint8 and before.shape == (*env.unwrapped.screen_size[::-1], 3)
    assert max(before.shape) >= 480
    spec = HybridActionSpec(env.action_space)
    env.step(spec.to_native(np.append(0, np.full(spec.max_parameters, 0.5))))
    state = env.get_state()
    x = next(iter(state))
    env.set_state({x: state[x] + 0.3})
    assert (env.render() != before).any()
    # Not every state is in the picture
    env.set_state({x: 1e6})
    env.render()
    assert copy.deepcopy(env).unwrapped.get_state() == env.unwrapped.get_state()
    env.close()


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_windows(env_id, monkeypatch):
    """pygame has one for all environments; whoever is closed first takes it away."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pytest.importorskip("pygame")
    window, other = (gym_make(env_id, render_mode="human") for _ in range(2))
    window.reset(seed=0)
    other.reset(seed=0)
    other.close()
    window.render()
    window.close()


def test_last_picture_says_how_the_episode_ended():
    pictures = {}
    for target in ((0.0, 0.1), (0.0, 1.0)):
        env = gym_make("HardMove4-v0", render_mode="rgb_array")
        env.reset(options={"start": (0.0, 0.0), "target": target})
        *_, info = env.step((0, [np.zeros(1)] * 16))
        pictures[info.get("outcome")] = env.render()
    assert set(pictures) == {"reached", None}
    green = [(picture[:40, 240:] == (36, 140, 70)).all(axis=-1).sum() for picture in pictures.values()]
    assert green[0] > 1000 and green[1] == 0
    # A new episode does not show the end of the former
    env.reset(options={"target": (0.5, 0.5)})
    assert not (env.render()[:40, 240:] == (36, 140, 70)).all(axis=-1).any()


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_every_frame_is_shown(env_id):
    """A window shows every frame inside a step, and changes nothing."""
    watched, other = gym_make(env_id).unwrapped, gym_make(env_id).unwrapped
    spec = HybridActionSpec(watched.action_space)
    states = []
    for env in (watched, other):
        env.reset(seed=3)
    watched.render_mode, watched.render = "human", lambda: states.append(watched.get_state())
    watched.reset(), other.reset()
    assert len(states) == 1, "the first frame of an episode"
    for row in spec.sample_rows(np.random.default_rng(0), 20):
        states.clear()
        (*_, info), (*_, other_info) = (env.step(spec.to_native(row)) for env in (watched, other))
        assert len(states) == info["frames"] == other_info["frames"]
        assert watched.get_state() == other.get_state()
        assert info["frames"] < 2 or states[0] != states[-1]


@pytest.mark.parametrize("env_id", ["Platform-v0", "Goal-v0", "HardMove4-v0"])
def test_pictures_of_every_frame(env_id):
    pytest.importorskip("pygame")
    env = gym_make(env_id, render_mode="rgb_array")
    env.reset(seed=0)
    env.action_space.seed(0)
    with pytest.raises(ValueError, match="render_mode must be"):
        gym_make(env_id).unwrapped.render_frames()
    (first,) = env.unwrapped.render_frames()
    np.testing.assert_array_equal(first, env.render())
    *_, info = env.step(env.action_space.sample())
    pictures = env.unwrapped.render_frames()
    # The last picture of an episode stands for half a second
    held = env.metadata["render_fps"] // 2 if "outcome" in info else 0
    assert len(pictures) == info["frames"] + held
    np.testing.assert_array_equal(pictures[-1], env.render())
    # Not asked for in between, the frames of a step are not drawn
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.step(env.action_space.sample())
    assert len(env.unwrapped.render_frames()) == 1
