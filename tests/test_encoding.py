"""Where entries of observations lie in their ranges, as ramps."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_chdp.common.encoding import MAX_BINS, N_BINS, RunningRanges, n_bins_of, ramps
from tests.algorithms import fast_model
from tests.hybrid_envs import HybridIdentityEnv, box


def column(*numbers):
    return th.tensor(numbers, dtype=th.float32)[:, None]


def ranges_of(x):
    """:return: those of one entry, after a batch"""
    ranges = RunningRanges(box(-np.inf, np.inf, 1))
    ranges.update(x)
    return ranges


def test_ramps():
    encoded = ramps(th.tensor([[0.0, 0.3], [1.0, 0.5]]), 4)
    assert encoded[:, ::2].tolist() == [4 * [0.0], 4 * [1.0]]
    assert encoded[:, 1::2].numpy() == pytest.approx(np.array([[1.0, 0.2, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0]]))


@pytest.mark.parametrize("n, n_bins", [(0, N_BINS), (1, N_BINS), (32, N_BINS), (100, 5), (128, 4), (129, 0), (10_000, 0)])
def test_many_entries_have_fewer_bins(n, n_bins):
    assert n_bins_of(n) == n_bins and n_bins * n <= MAX_BINS
    assert RunningRanges(box(-1, 1, n)).n == (n if n_bins else 0)


@pytest.mark.parametrize("unit, offset", [(1.0, 0.0), (1e-12, 0.0), (1e9, 1e12), (1.0, 1e3)])
def test_positions_in_any_units(unit, offset):
    """From the least to the largest value of the training batch, and no further."""
    ranges = ranges_of(unit * column(2, 3, 6) + offset)
    assert ranges(unit * column(1, 2, 3, 6, 7) + offset)[:, 0].numpy() == pytest.approx([0, 0, 0.25, 1, 1], abs=0.02)


def test_nothing_is_known_before_the_first_batch():
    assert RunningRanges(box(-1, 1, 2))(th.tensor([[-5.0, 5.0]])).tolist() == [[0.0, 0.0]]


@pytest.mark.parametrize("value", [0.0, 3.0, -123456.7])
def test_an_entry_that_is_always_the_same(value):
    """What rounding makes of it is no position."""
    ranges = ranges_of(value * (1 + 1e-7 * th.randn(100, 1)))
    assert (ranges(value * (1 + 1e-7 * th.randn(100, 1))) < 0.2).all()
    assert th.isfinite(ranges(column(1e9, -1e9))).all()


def test_ranges_grow_at_once_and_shrink_slowly():
    ranges = ranges_of(column(0, 1))
    ranges.update(column(0, 100))
    ranges.update(column(0, 1))
    assert ranges(column(1)).item() == pytest.approx(0.01, rel=0.01)
    for _ in range(10_000):
        ranges.update(column(0, 1))
    assert ranges(column(1)).item() == pytest.approx(1, rel=0.01)


def test_entries_are_numbers_of_boxes():
    """Neither images, nor those of discrete spaces."""
    space = spaces.Dict(
        image=spaces.Box(0, 255, (3, 36, 36), np.uint8), matrix=box(-1, 1, 4), choice=spaces.Discrete(4), count=box(0, 9, 1)
    )
    ranges = RunningRanges(space)
    obs = {"image": th.zeros(2, 3, 36, 36), "matrix": th.eye(4)[:2], "choice": th.eye(4)[:2], "count": column(0, 9)}
    ranges.update(obs)
    assert ranges.n == 5
    assert ranges(obs).tolist() == [[1.0, 0.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0, 1.0]]
    assert RunningRanges(spaces.Discrete(3)).n == 0


@pytest.mark.parametrize("space", [spaces.Discrete(3), box(-1, 1, 200)])
def test_observations_without_positions(space):
    class Env(HybridIdentityEnv):
        def __init__(self):
            super().__init__()
            self.observation_space = space

        def reset(self, **kwargs):
            return space.sample(), super().reset(**kwargs)[1]

        def step(self, action):
            return space.sample(), *super().step(action)[1:]

    model = fast_model(env=Env()).learn(40)
    assert model.critic.ranges is None
    model.predict(space.sample())


@pytest.mark.parametrize("policy_kwargs", [{}, dict(features_extractor_class=FlattenExtractor)])
def test_critics_and_targets_know_the_ranges_after_training(policy_kwargs, tmp_path):
    """Those of observations, whatever the features extractor makes of them."""
    model = fast_model(policy_kwargs=policy_kwargs).learn(80)
    model.save(tmp_path / "model")
    for policy in (model.policy, type(model).load(tmp_path / "model").policy):
        for critic in (policy.critic, policy.critic_target):
            assert critic.ranges.running_low.tolist() == pytest.approx([-1, -1, -1, -1], abs=0.1)
            assert critic.ranges.running_high.tolist() == pytest.approx([1, 1, 1, 1], abs=0.1)
