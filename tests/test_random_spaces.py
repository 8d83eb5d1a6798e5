"""
Action spaces of every kind, drawn at random: rows, native actions and masks fit together.

Thoroughly: ``pytest tests/test_random_spaces.py --hypothesis-profile=thorough``
"""

from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from sb3_chdp import HybridActionSpec
from sb3_chdp.common.hybrid_box import ConcatenatedBox, HybridBox, ScoreBox
from sb3_chdp.common.masks import read_masks
from sb3_chdp.common.space_tree import get_part
from tests.algorithms import ALGORITHMS, make_model
from tests.hybrid_envs import LayoutEnv

FLOATS, INTEGERS = (np.float16, np.float32, np.float64), (np.uint8, np.int8, np.int16, np.int32, np.int64)


@st.composite
def bounds(draw, dtype):
    """:return: low and high of one element, from equal to as far apart as the type allows"""
    if np.issubdtype(dtype, np.integer):
        limits = np.iinfo(dtype)
        # Floats, in which rows are kept, hold no larger integers exactly
        numbers: st.SearchStrategy[float] = st.integers(max(int(limits.min), -(2**50)), min(int(limits.max), 2**50))
    else:
        largest = float(np.finfo(dtype).max) / 4
        width = np.dtype(dtype).itemsize * 8
        near = st.floats(-100, 100, width=16)
        numbers = st.one_of(near, st.floats(-largest, largest, width=width, allow_subnormal=False)) if width > 16 else near
    low, high = sorted((draw(numbers), draw(numbers)))
    return (low, low) if draw(st.integers(0, 4)) == 0 else (low, high)


@st.composite
def random_boxes(draw):
    dtype = draw(st.sampled_from(FLOATS + INTEGERS))
    shape = draw(st.sampled_from([(1,), (), (2,), (2, 2), (0,)]))
    pairs = [draw(bounds(dtype)) for _ in range(int(np.prod(shape)))]
    low, high = np.array(pairs, dtype=dtype).reshape(-1, 2).T + dtype(0)
    return spaces.Box(low.reshape(shape), high.reshape(shape), dtype=dtype)


@st.composite
def discrete_parts(draw):
    kind = draw(st.sampled_from(["discrete", "multi_discrete", "multi_binary", "many_bits"]))
    if kind == "discrete":
        return spaces.Discrete(draw(st.integers(1, 6)), start=draw(st.integers(-5, 5)))
    if kind == "multi_discrete":
        radices = draw(st.lists(st.integers(1, 4), min_size=1, max_size=3))
        start = draw(st.lists(st.integers(-3, 3), min_size=len(radices), max_size=len(radices)))
        return spaces.MultiDiscrete(radices, start=start)
    return spaces.MultiBinary(draw(st.sampled_from([1, 3, (2, 2)]) if kind == "multi_binary" else st.integers(11, 80)))


@st.composite
def product_spaces(draw):
    """Discrete parts and boxes in any order, one level deep or two, in a ``Tuple`` or a ``Dict``."""
    parts = draw(st.lists(discrete_parts(), min_size=1, max_size=3)) + draw(st.lists(random_boxes(), max_size=2))
    parts.append(spaces.Box(-1.0, 1.0, (1,), dtype=np.float32))
    parts = draw(st.permutations(parts))

    def gather(children):
        if draw(st.booleans()):
            return spaces.Tuple(children)
        return spaces.Dict({f"part {i}": child for i, child in enumerate(children)})

    cut = draw(st.integers(0, len(parts)))
    return gather([*parts[:cut], gather(parts[cut:])]) if cut < len(parts) - 1 else gather(parts)


def layout_of(space, data):
    """:return: one of the layouts that the space allows"""
    spec = HybridActionSpec(space, "shared")
    layouts = ["shared"]
    if spec.n_discrete_actions <= 4096:
        layouts.append("joint")
    if len(spec.digits) > 1:
        layouts.append("factored")
    return data.draw(st.sampled_from(layouts))


@settings(deadline=None)
@given(space=product_spaces(), data=st.data(), seed=st.integers(0, 2**16))
def test_native_actions(space, data, seed):
    spec = HybridActionSpec(space, layout_of(space, data))
    rows = spec.sample_rows(np.random.default_rng(seed), 4)
    spec.columns.view(rows, "parameters")[:2] *= 1e6
    for row, native in zip(rows, spec.to_native_batch(rows), strict=True):
        assert space.contains(native), native
        again = spec.to_row(native)
        assert spec.columns.view(again, "discrete_actions").tolist() == spec.columns.view(row, "discrete_actions").tolist()
        assert space.contains(spec.to_native(again))
    space.seed(seed)
    for _ in range(3):
        sample = space.sample()
        native = spec.to_native(spec.to_row(sample))
        assert space.contains(native)
        for leaf in spec._discrete_leaves:
            np.testing.assert_array_equal(get_part(native, leaf.path), get_part(sample, leaf.path))


@settings(deadline=None)
@given(space=product_spaces(), data=st.data(), seed=st.integers(0, 2**16))
def test_masks(space, data, seed):
    """Rows that masks allow, whichever kind of rows, are of values that they allow."""
    kind = data.draw(st.sampled_from([HybridBox, ConcatenatedBox, ScoreBox]))
    rows_space = kind(space, layout_of(space, data), state_parts=("masks", "next_masks"))
    spec, rng = rows_space.spec, np.random.default_rng(seed)
    digits = spec.digits
    starts = np.cumsum((0, *digits[:-1]))
    of_parts = rng.random((6, sum(digits))) < 0.4
    for start, radix in zip(starts, digits, strict=True):
        of_parts[np.arange(6), start + rng.integers(radix, size=6)] = True
    masks = read_masks(spec, of_parts, 6)
    assert masks.shape == (6, sum(spec.radices))
    rows = rows_space.sample_rows(rng, 6, masks)
    assert all(rows_space.contains(row) for row in rows)
    for i, native in enumerate(rows_space.to_native(rows)):
        assert space.contains(native)
        row = spec.to_row(native)[: len(spec.radices)].astype(int)
        values = row if spec.is_factored else np.array(np.unravel_index(row[0], digits))
        assert of_parts[i, starts + values].all()
    if not spec.is_factored:
        k = int(rng.integers(spec.n_discrete_actions))
        values = np.array(np.unravel_index(k, digits))
        assert (masks[:, k] == of_parts[:, starts + values].all(axis=1)).all()


class RandomMasksEnv(LayoutEnv):
    """Allows some values of every discrete choice; an action with another one is an error."""

    def __init__(self, space):
        super().__init__(space)
        self.codec = HybridActionSpec(space, "shared")
        self.starts = np.cumsum((0, *self.codec.digits[:-1]))

    def action_masks(self):
        rng = np.random.default_rng(self.t)
        masks = rng.random(self.codec.n_mask_values) < 0.4
        masks[self.starts + rng.integers(self.codec.digits)] = True
        return masks

    def step(self, action):
        choices = self.codec.to_row(action)[: len(self.codec.radices)].astype(int)
        allowed = read_masks(self.codec, self.action_masks(), 1)[0]
        assert allowed[self.starts + choices if self.codec.is_factored else choices].all(), f"{action} is masked"
        return super().step(action)


@pytest.mark.parametrize("algorithm", ALGORITHMS)
@settings(deadline=None, max_examples=settings().max_examples // 25)
@given(space=product_spaces(), masked=st.booleans())
def test_rows_of_every_algorithm(algorithm, space, masked):
    """The environment raises for an action that is not in its space or that masks forbid."""
    env: Any = RandomMasksEnv(space) if masked else LayoutEnv(space)
    assume(algorithm.takes_factored or not HybridActionSpec(space, "shared").is_factored)
    model = make_model(algorithm, env, action_layout="shared" if masked else "auto").learn(20)
    masks = [env.action_masks()] * 5 if masked else None
    actions, _ = model.predict(np.zeros((5, 2), dtype=np.float32), action_masks=masks)
    assert all(space.contains(action) for action in actions)
