from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_chdp import HybridActionSpec
from sb3_chdp.common.space_tree import children_of, get_part, leaves_of
from tests.hybrid_envs import box, layouts


@st.composite
def boxes(draw, min_size=0):
    shape = draw(
        st.sampled_from([(0,), (), (1,), (2,), (2, 3), (3, 0)]) if min_size == 0 else st.sampled_from([(1,), (), (2, 2)])
    )
    dtype = draw(st.sampled_from([np.float32, np.float64, np.float16, np.int64, np.int32, np.uint8]))
    size = int(np.prod(shape))
    limits = (0, 255) if dtype is np.uint8 else (-1000, 1000)
    numbers = st.integers(*limits) if np.issubdtype(dtype, np.integer) else st.floats(*limits, width=16)
    pairs = [sorted((draw(numbers), draw(numbers))) for _ in range(size)]
    low, high = np.array(pairs, dtype=dtype).reshape(size, 2).T + dtype(0)  # no -0.0: Box(0.0, -0.0) can not be sampled
    return spaces.Box(low.reshape(shape), high.reshape(shape), dtype=dtype)


@st.composite
def row_boxes(draw, n_rows):
    like = draw(boxes(min_size=1))
    low, high = (np.stack([bound] * n_rows).reshape(n_rows, -1) for bound in (like.low, like.high))
    return spaces.Box(low, high, dtype=like.dtype)


@st.composite
def hybrid_spaces(draw):
    layout = draw(st.sampled_from(["nested", "flat", "shared", "dict_nested", "dict_flat", "rows", "one_of", "product"]))
    n_actions = draw(st.integers(1, 4))
    discrete = spaces.Discrete(n_actions, start=draw(st.integers(-3, 3)))
    # At least one action has a parameter
    options = [draw(boxes(min_size=1)), *(draw(boxes()) for _ in range(n_actions - 1))]
    if layout == "nested":
        return spaces.Tuple((discrete, spaces.Tuple(options)))
    if layout == "flat":
        return spaces.Tuple((discrete, *options))
    if layout == "shared":
        return spaces.Tuple((options[0], discrete))
    if layout == "dict_nested":
        return spaces.Dict({"which": discrete, "how": spaces.Dict({f"p{i}": option for i, option in enumerate(options)})})
    if layout == "dict_flat":
        return spaces.Dict({"which": discrete, **{f"p{i}": option for i, option in enumerate(options)}})
    if layout == "rows":
        return spaces.Tuple((discrete, draw(row_boxes(n_actions))))
    if layout == "one_of":
        parts = [
            [],
            [spaces.Discrete(2, start=-1)],
            [spaces.Dict({"m": spaces.MultiBinary(2), "n": spaces.MultiDiscrete([1, 2])})],
        ]
        return spaces.OneOf([spaces.Tuple((option, *draw(st.sampled_from(parts)))) for option in options])
    others = [spaces.MultiDiscrete([2, 3]), spaces.MultiBinary((2, 1)), spaces.MultiDiscrete(np.array([[2], [1]]))]
    return spaces.Tuple((discrete, draw(st.sampled_from(others)), spaces.Dict({"x": options[0], "y": box(-1, 1, 2)})))


def executed_boxes(space, is_shared, k, native):
    """:return: (path in a native action, box) of the parameters of action k, which are what a row must keep"""
    if isinstance(space, spaces.OneOf):
        leaves = leaves_of(space.spaces[native[0]], (1,))
    elif is_shared:
        leaves = leaves_of(space)
    else:
        rest = [(key, child) for key, child in children_of(space) or [] if not isinstance(child, spaces.Discrete)]
        options: list[tuple[tuple, Any]] = [((key,), child) for key, child in rest]
        nested = children_of(rest[0][1]) if len(rest) == 1 else None
        if len(rest) == 1 and isinstance(array := rest[0][1], spaces.Box) and len(array.shape) > 1:
            return [((rest[0][0], k), spaces.Box(array.low[k], array.high[k], dtype=array.dtype))]
        if nested is not None:
            options = [((rest[0][0], key), child) for key, child in nested]
        path, option = options[k]
        leaves = leaves_of(option, path)
    return [(path, leaf) for path, leaf in leaves if isinstance(leaf, spaces.Box)]


@settings(max_examples=300, deadline=None)
@given(space=hybrid_spaces(), seed=st.integers(0, 2**16))
def test_native_actions_are_in_the_space_and_round_trip(space, seed):
    spec = HybridActionSpec(space)
    space.seed(seed)
    rng = np.random.default_rng(seed)
    rows = spec.sample_rows(rng, 4)
    rows[:2, 1:] *= 1e6  # far outside of [-1, 1]
    for native in spec.to_native_batch(rows):
        assert space.contains(native), native
        # Everything in a native action that was made from a row comes back
        np.testing.assert_equal(spec.to_native(spec.to_row(native)), native)
    for _ in range(4):
        sample = space.sample()
        row = spec.to_row(sample)
        native, k = spec.to_native(row), int(row[0])
        assert space.contains(native)
        assert not row[1:][~spec.parameter_mask[k]].any()
        np.testing.assert_equal(spec.to_row(native)[0], k)
        for path, leaf in executed_boxes(space, spec.is_shared, k, native):
            width = float(np.max(leaf.high.astype(float) - leaf.low.astype(float), initial=0.0))
            before, after = get_part(sample, path), get_part(native, path)
            np.testing.assert_allclose(after, before, rtol=0, atol=4e-16 * max(width, 1000))


@pytest.mark.parametrize("dtype", [np.uint8, np.int8, np.uint16, np.int32, np.int64, np.uint64])
def test_integer_boxes_reach_the_limits_of_their_type(dtype):
    low, high = np.iinfo(dtype).min, np.iinfo(dtype).max
    spec = HybridActionSpec(spaces.Tuple((spaces.Discrete(1), spaces.Box(low, high, (1,), dtype))))
    _, (lowest,) = spec.to_native([0, -1.0])
    _, (highest,) = spec.to_native([0, 1.0])
    assert (int(lowest), int(highest)) == (low, high)
    assert lowest.dtype == dtype and spec.space.contains(spec.to_native([0, 0.3]))


@settings(max_examples=100, deadline=None)
@given(radices=st.lists(st.integers(1, 4), min_size=1, max_size=4), seed=st.integers(0, 1000))
def test_joint_index_is_a_bijection(radices, seed):
    space = spaces.Tuple((spaces.MultiDiscrete(radices), spaces.MultiBinary(2), box(-1, 1, 1)))
    spec = HybridActionSpec(space, "joint")
    assert spec.n_discrete_actions == 4 * np.prod(radices)
    natives = [spec.to_native([k, 0.0]) for k in range(spec.n_discrete_actions)]
    assert len({(tuple(a), tuple(b)) for a, b, _ in natives}) == spec.n_discrete_actions
    assert [spec.to_row(native)[0] for native in natives] == list(range(spec.n_discrete_actions))


def test_tables():
    spec = HybridActionSpec(layouts()["nested"])
    assert (spec.n_discrete_actions, spec.max_parameters, spec.n_parameters, spec.columns.width) == (3, 2, 3, 3)
    assert spec.parameter_mask.sum(axis=1).tolist() == [2, 1, 0]
    assert spec.parameter_mask.tolist() == [[True, True], [True, False], [False, False]]
    assert spec.parameter_index.tolist() == [[0, 1], [2, 0], [0, 0]]
    k, parameters = spec.to_native([1, 0.5, 0.9])
    assert k == 1 and parameters[1] == pytest.approx(3.75)


def test_rows_of_a_box_belong_to_one_action_each():
    low, high = np.array([[0, 1], [2, 3], [4, 5]], np.float32), np.array([[1, 3], [3, 5], [6, 9]], np.float32)
    space = spaces.Dict(which=spaces.Discrete(3, start=1), how=spaces.Box(low, high))
    spec = HybridActionSpec(space)
    assert (spec.n_discrete_actions, spec.max_parameters, spec.n_parameters) == (3, 2, 6)
    native = spec.to_native([1, -1, 1])
    assert native["which"] == 2
    np.testing.assert_equal(native["how"], np.array([[0.5, 2], [2, 5], [5, 7]], np.float32))
    assert spec.to_row(native).tolist() == [1, -1, 1]
    assert HybridActionSpec(space, "shared").max_parameters == 6
    # A vector serves all actions, unless told otherwise
    vector = spaces.Tuple((spaces.Discrete(3), spaces.Box(0, 8, (3,), np.int64)))
    assert HybridActionSpec(vector).max_parameters == 3
    spec = HybridActionSpec(vector, "per_action")
    assert spec.max_parameters == 1 and spec.to_native([2, 1.0])[1].tolist() == [4, 4, 8]


def test_parts_of_a_one_of_may_have_discrete_values():
    jump = spaces.Dict({"x": box(0, 1, 2), "legs": spaces.MultiBinary(2)})
    spec = HybridActionSpec(spaces.OneOf((spaces.Discrete(2, start=5), jump, box(-1, 1, 1))))
    assert spec.parameter_mask.sum(axis=1).tolist() == [0, 0, 2, 2, 2, 2, 1]
    natives = [spec.to_native([k, 0, 0]) for k in range(7)]
    assert [int(part) for part, _ in natives] == [0, 0, 1, 1, 1, 1, 2]
    assert [action for _, action in natives[:2]] == [5, 6]
    assert [action["legs"].tolist() for _, action in natives[2:6]] == [[0, 0], [0, 1], [1, 0], [1, 1]]
    assert [spec.to_row(native)[0] for native in natives] == list(range(7))
    for wrong in ((3, np.zeros(1)), (-1, np.zeros(1)), (0, 4)):
        with pytest.raises(ValueError, match="action must be in"):
            spec.to_row(wrong)


@pytest.mark.parametrize("layout", layouts())
def test_conversion_of_a_batch_equals_single_conversions(layout):
    spec = HybridActionSpec(layouts()[layout])
    rows = spec.sample_rows(np.random.default_rng(0), 50)
    np.testing.assert_equal(spec.to_native_batch(rows), [spec.to_native(row) for row in rows])


@pytest.mark.parametrize("empty", [box(0, 1, 0), spaces.Tuple(()), spaces.Dict({}), spaces.Discrete(1)])
def test_spellings_of_an_action_without_parameters(empty):
    for space in (
        spaces.Tuple((spaces.Discrete(2), spaces.Tuple((box(0, 1, 1), empty)))),
        spaces.Tuple((spaces.Discrete(2), box(0, 1, 1), empty)),
        spaces.OneOf((box(0, 1, 1), empty)),
    ):
        spec = HybridActionSpec(space)
        assert spec.parameter_mask.sum(axis=1).tolist() == [1, 0]
        assert all(space.contains(spec.to_native([k, 0.3])) for k in range(2))


def test_ambiguous_space_and_override():
    space = spaces.Tuple((spaces.Discrete(2), box(0, 1, 1), box(0, 1, 1)))
    assert not HybridActionSpec(space).is_shared
    assert HybridActionSpec(space, "shared").max_parameters == 2
    assert HybridActionSpec(spaces.Tuple((spaces.Discrete(3), box(0, 1, 1), box(0, 1, 1)))).is_shared
    with pytest.raises(ValueError, match="per_action"):
        HybridActionSpec(spaces.Tuple((spaces.Discrete(3), box(0, 1, 1))), "per_action")
    with pytest.raises(ValueError, match="action_layout must be one of"):
        HybridActionSpec(space, "both")


@pytest.mark.parametrize(
    "space, message",
    [
        (spaces.Tuple((spaces.Discrete(2), box(-np.inf, np.inf, 1))), r"action_space\[1\] is unbounded"),
        (spaces.Dict({"k": spaces.Discrete(2), "v": box(0, np.inf, 1)}), r"action_space\['v'\] is unbounded"),
        (spaces.Tuple((spaces.Discrete(2), spaces.Box(0, np.inf, (1,), np.int32))), r"action_space\[1\] is unbounded"),
        (spaces.OneOf((box(0, 1, 1), box(0, np.inf, 1))), r"action_space.spaces\[1\] is unbounded"),
        (spaces.Tuple((box(0, 1, 1), box(0, 1, 1))), "no discrete part"),
        (spaces.Tuple((spaces.Discrete(2), spaces.Discrete(3))), "no continuous part"),
        (spaces.Tuple((spaces.Discrete(2), box(0, 1, 0))), "no continuous part"),
        (spaces.Tuple((spaces.Discrete(2), spaces.Text(3))), "Text"),
        (spaces.Tuple((spaces.Discrete(131_072), box(0, 1, 1))), "131072 joint discrete actions"),
        (spaces.OneOf((box(0, 1, 1), spaces.Text(3))), r"action_space.spaces\[1\] is a Text"),
        (spaces.OneOf((spaces.Discrete(2), spaces.Discrete(3))), "no continuous part"),
        (spaces.OneOf((box(0, 1, 1), spaces.MultiBinary(40))), "1099511627777 discrete actions"),
        (spaces.Discrete(3), "Tuple, Dict or OneOf"),
    ],
)
def test_unsupported_spaces(space, message):
    with pytest.raises(ValueError, match=message):
        HybridActionSpec(space)


def test_nan_bounds():
    space = box(0, 1, 1)
    space.low[:] = np.nan
    with pytest.raises(ValueError, match="NaN bounds"):
        HybridActionSpec(spaces.Tuple((spaces.Discrete(2), space)))


def test_large_joint_space():
    spec = HybridActionSpec(spaces.Tuple((spaces.MultiBinary(16), box(-1, 1, 2))), "joint")
    assert spec.n_discrete_actions == 65_536
    bits, _ = spec.to_native([40_000, 0, 0])
    assert int("".join(map(str, bits)), 2) == 40_000


def test_row_out_of_range():
    with pytest.raises(ValueError, match="first column"):
        HybridActionSpec(layouts()["shared"]).to_native([3, 0, 0])


@pytest.mark.parametrize(
    "layout, action",
    [
        ("shared", (3, [0, 0])),
        ("shared", (0, [0, 9])),
        ("one_of", (-1, [0.0])),
        ("product", {"a": [2, 0], "b": [0], "x": [0]}),
    ],
)
def test_actions_that_are_not_in_the_space(layout, action):
    with pytest.raises(ValueError, match=r"action must be in .*, got"):
        HybridActionSpec(layouts()[layout]).to_row(action)


def test_rows_that_are_no_actions():
    spec = HybridActionSpec(layouts()["shared"])
    with pytest.raises(ValueError, match=r"3 numbers or more, got shape \(2,\)"):
        spec.to_native([1, 0])
    with pytest.raises(ValueError, match="must be finite"):
        spec.to_native([1, 0, np.nan])
    # What lies behind the parameters does not matter
    spec.to_native([1, 0, 0, np.nan])


def zero(action):
    """Set all arrays of a native action to 0, as an environment that clips in place would change them."""
    for part in action.values() if isinstance(action, dict) else action if isinstance(action, tuple) else ():
        zero(part)
    if isinstance(action, np.ndarray):
        action[...] = 0


@pytest.mark.parametrize("layout", layouts())
def test_native_actions_may_be_changed(layout):
    spec = HybridActionSpec(layouts()[layout])
    row = spec.sample_rows(np.random.default_rng(0), 1)[0]
    first, second = spec.to_native(row), spec.to_native(row)
    zero(first)
    np.testing.assert_equal(spec.to_native(row), second)


@pytest.mark.parametrize("layout", layouts())
def test_native_actions_are_of_the_types_of_the_space(layout):
    """Plain tuples and dicts, which subprocesses can unpickle without this package."""
    space = layouts()[layout]
    (action,) = HybridActionSpec(space).to_native_batch(np.array([[2, 0.5, -0.5]]))
    assert type(action) is type(space.sample())
