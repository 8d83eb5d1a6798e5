"""The action spaces of rows, and how rows are packed."""

import copy
import pickle

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_chdp.common.hybrid_box import ConcatenatedBox, HybridBox, ScoreBox
from sb3_chdp.common.rows import RowLayout, pack_bits, unpack_bits
from tests.hybrid_envs import layouts


@pytest.mark.parametrize("layout", layouts())
@pytest.mark.parametrize("kind", [HybridBox, ConcatenatedBox, ScoreBox])
def test_rows_are_sampled_and_told_apart(layout, kind):
    space = kind(layouts()[layout])
    space.seed(0)
    samples = np.stack([space.sample() for _ in range(200)])
    assert all(space.contains(row) for row in samples) and samples.dtype == space.dtype
    assert set(space.columns.discrete_actions(samples)) == set(range(space.spec.n_discrete_actions))
    assert all(space.native.contains(action) for action in space.to_native(samples))
    assert not space.contains(samples[0] * np.nan) and not space.contains(samples[0][1:])
    if kind is not ScoreBox:
        between = samples[0].copy()
        space.columns.view(between, "discrete_actions")[:] = 1.27
        assert not space.contains(between)


def test_rows_with_masks():
    space = ConcatenatedBox(layouts()["nested"], state_parts=("masks", "next_masks"))
    assert space.shape == (1 + 3 + 2,) and space.columns.action_width == 4
    assert space.low.tolist() == [0, -1, -1, -1, 0, 0] and space.high.tolist() == [2, 1, 1, 1, 2**16 - 1, 2**16 - 1]
    assert pickle.loads(pickle.dumps(space)) == space != ConcatenatedBox(layouts()["nested"])


@settings(max_examples=50, deadline=None)
@given(n=st.integers(0, 3), n_masks=st.integers(1, 40), seed=st.integers(0, 1000))
def test_masks_are_packed_without_loss(n, n_masks, seed):
    masks = np.random.default_rng(seed).random((n, n_masks)) < 0.5
    packed = pack_bits(masks)
    assert packed.dtype == np.float32 and packed.shape == (n, -(-n_masks // 16))
    assert (unpack_bits(packed, n_masks) == masks).all()
    assert (pack_bits(th.tensor(masks)).numpy() == packed).all()
    assert (unpack_bits(th.tensor(packed), n_masks).numpy() == masks).all()


@pytest.mark.parametrize("layout", layouts())
@pytest.mark.parametrize("kind", [HybridBox, ConcatenatedBox, ScoreBox])
def test_random_rows_are_uniform_over_what_masks_allow(layout, kind):
    space = kind(layouts()[layout])
    n = space.spec.n_discrete_actions
    masks = np.tile(np.arange(n) % 2 == 0, (1000, 1))
    rows = space.sample_rows(np.random.default_rng(0), 1000, masks)
    assert all(space.contains(row) for row in rows[:20])
    counts = np.bincount(space.columns.discrete_actions(rows), minlength=n)
    allowed = masks[0].sum()
    assert (counts[1::2] == 0).all() and (np.abs(counts[::2] - 1000 / allowed) < 4 * (1000 / allowed) ** 0.5).all()


@pytest.mark.parametrize("tensor", [np.array, th.tensor])
def test_rows_are_packed_by_name(tensor):
    columns = RowLayout(discrete_actions=1, parameters=2, latents=2)
    k, parameters = tensor([2, 0]), tensor([[0.1, 0.2], [0.3, 0.4]])
    rows = columns.pack(parameters=parameters, discrete_actions=k)
    assert rows.shape == (2, columns.width) and rows[:, 0].tolist() == [2, 0]
    assert columns.discrete_actions(rows).tolist() == [2, 0]
    assert (columns.view(rows, "parameters") == parameters).all() and (columns.view(rows, "latents") == 0).all()
    # Scores decide by the highest
    scores = tensor([[0.1, 0.7, -1.0, 0.0], [0.5, -0.5, 0.2, 0.3]])
    assert RowLayout(scores=3, parameters=1).discrete_actions(scores).tolist() == [1, 0]


def test_hybrid_box_pickles_and_compares():
    first = HybridBox(layouts()["nested"], stored_latent_dim=4)
    assert first.shape == (7,)
    assert pickle.loads(pickle.dumps(first)) == first
    assert first != HybridBox(layouts()["nested"], stored_latent_dim=5) and first != HybridBox(
        layouts()["flat"], stored_latent_dim=4
    )
    assert first != spaces.Box(first.low, first.high)


@pytest.mark.parametrize("kind", [HybridBox, ConcatenatedBox, ScoreBox])
def test_copies_of_rows_have_the_same_generator(kind):
    space = kind(layouts()["nested"])
    space.seed(0)
    for twin in (copy.deepcopy(space), pickle.loads(pickle.dumps(space))):
        np.testing.assert_array_equal(twin.sample(), copy.deepcopy(space).sample())
