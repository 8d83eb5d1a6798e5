"""The scripts that explain the published models, on models that are none."""

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("matplotlib")

from benchmarks.probes import codebook, expressivity, gifs, rollout, starts
from sb3_chdp.envs.hard_move import motion_table


class Model:
    """:param act: observation -> native action"""

    def __init__(self, act):
        self.act, self.seen = act, []

    def predict(self, obs, deterministic=True):
        self.seen.append(obs)
        return self.act(obs), None


def shoot(height):
    return (1, [np.zeros(2), np.array([height]), np.zeros(1)])


def catch_straight(distance_left):
    """Push towards the target until a glide comes near enough."""

    def act(obs):
        vx, vy, dx, dy = map(float, obs)
        glided = np.hypot(dx - 0.1 * 0.75 * vx, dy - 0.1 * 0.75 * vy)
        if glided <= 0.2 - distance_left:
            return 1, [np.zeros(1), np.zeros(0)]
        return 0, [np.array([np.arctan2(dx, dy) / np.pi]), np.zeros(0)]

    return act


def test_play():
    env = rollout.make_env("HardMove4-v0")
    model = Model(lambda obs: (0, [np.zeros(1)] * 16))
    episode = rollout.play(model, env, options={"start": (0.0, 0.0), "target": (0.5, 0.0)})
    assert len(episode.actions) == len(episode.observations) == len(model.seen) == 30 and not episode.success
    np.testing.assert_array_equal(episode.observations[0], [0, 0, 0.5, 0])
    assert rollout.play(model, env, options={"start": (0.0, 0.0), "target": (0.1, 0.0)}).success


def test_goals_by_evenly_spaced_heights():
    model = Model(lambda obs: shoot(0.0))
    lines = starts.goal_table(model, rollout.make_env("Goal-v0"), 40)
    assert lines[2].startswith("| -15 to -13.5 |") and lines[-1].startswith("| -15 to 15 |") and len(lines) == 2 + 21
    np.testing.assert_allclose([15 * obs[1] for obs in model.seen], np.arange(-15, 15, 0.75), atol=1e-5)
    # A shot is the whole episode
    assert lines[-1].endswith("| 1.0 |")


@pytest.mark.parametrize("distance", [0.1, 0.45, 1.2, 1.85])
def test_fewest_steps_are_those_of_straight_play(distance):
    env = rollout.make_env("CatchPoint-v0")
    model = Model(catch_straight(1e-6))
    episode = rollout.play(model, env, options={"start": (0.0, 0.0), "target": (0.0, distance)})
    assert episode.success and len(episode.actions) == starts.fewest_steps(distance)


def test_catches_by_distance():
    lines = starts.catch_point_table(Model(catch_straight(1e-6)), rollout.make_env("CatchPoint-v0"), 60)
    *_, all_starts = [line.strip("| ").split(" | ") for line in lines]
    _, n_starts, in_reach, success, misses = all_starts
    # Straight play catches what is within reach, and misses nothing
    assert (n_starts, success, misses) == ("60", in_reach, "0.0") and 80 < float(in_reach) <= 100


def test_explained_share_of_pushes():
    motions = motion_table(6)
    linear = motions @ np.random.default_rng(0).normal(size=(2, 8)) + 3
    assert codebook.explained_share(linear, motions) == pytest.approx(1)
    assert codebook.explained_share(np.random.default_rng(0).normal(size=(64, 2)), motions) < 0.3


def test_table_of_draws():
    # Subsets 0 and 63 move nothing: one base direction of two
    draws = pd.DataFrame({"k": [63, 0, 32, 0], "s": [1.0, 0.0, 0.5, 0.5], "reached": [False, False, True, False]})
    first, second = expressivity.markdown({"X": draws}).splitlines()[2:]
    assert first.startswith("| X | (0.000, 0.000) | 3 % |") and first.endswith("| 0 % |")
    assert second == "| X | (0.500, 0.000) | 1 % | 0.500 ± 0.000 | 100 % |"


def test_gif(tmp_path):
    image = pytest.importorskip("PIL.Image")
    model = Model(lambda obs: (1, [np.zeros(1), np.full(1, 300.0), np.zeros(1)]))
    gifs.record(model, "Platform-v0", tmp_path / "x.gif", episodes=1)
    with image.open(tmp_path / "x.gif") as picture:
        assert picture.size == (800, 240) and picture.n_frames > 2 * len(model.seen)
