"""Reading nested action spaces and putting native actions together, part by part."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

# Keys that lead from the action space, or a native action, to one of its parts
Path = tuple[Any, ...]


class BoxLeaf(NamedTuple):
    """A ``Box`` of the action space and the columns of the padded parameter vector that it occupies."""

    path: Path
    space: spaces.Box
    columns: slice


class DiscreteLeaf(NamedTuple):
    """A discrete leaf, its digits (one for ``Discrete``, one per element otherwise) and their offset."""

    path: Path
    space: spaces.Space[Any]
    radices: tuple[int, ...]
    start: np.ndarray

    def value_of(self, digits: np.ndarray) -> Any:
        """:return: the native value of digits that count from 0"""
        values = digits + self.start
        if isinstance(self.space, spaces.Discrete):
            return self.space.dtype.type(values[0])
        return values.reshape(self.space.shape).astype(self.space.dtype)

    def digits_of(self, value: Any) -> np.ndarray:
        """Inverse of :meth:`value_of`."""
        return (np.ravel(value) - self.start).astype(np.int64)


def children_of(space: spaces.Space[Any]) -> list[tuple[Any, spaces.Space[Any]]] | None:
    """:return: (key, child) pairs of a ``Tuple`` or ``Dict``, None for a leaf."""
    if isinstance(space, spaces.Tuple):
        return list(enumerate(space.spaces))
    if isinstance(space, spaces.Dict):
        return list(space.spaces.items())
    return None


def leaves_of(space: spaces.Space[Any], path: Path = ()) -> Iterator[tuple[Path, spaces.Space[Any]]]:
    children = children_of(space)
    if children is None:
        yield path, space
        return
    for key, child in children:
        yield from leaves_of(child, (*path, key))


def is_empty_discrete(space: spaces.Space[Any]) -> bool:
    return isinstance(space, spaces.Discrete) and space.n == 1


def is_parameter_space(space: spaces.Space[Any]) -> bool:
    """Whether a subtree can be the parameters of one action: boxes only, ``Discrete(1)`` standing for none."""
    return all(isinstance(leaf, spaces.Box) or is_empty_discrete(leaf) for _, leaf in leaves_of(space))


def name_of(path: Path, root: str = "action_space") -> str:
    return root + "".join(f"[{key!r}]" for key in path)


def get_part(action: Any, path: Path) -> Any:
    for key in path:
        action = action[key]
    return action


def replace_part(action: Any, path: Path, value: Any) -> Any:
    """:return: ``action`` with ``value`` at ``path``; only the containers on the way are copied."""
    if not path:
        return value
    key, rest = path[0], path[1:]
    if isinstance(action, np.ndarray):
        array = action.copy()
        array[key] = replace_part(action[key], rest, value)
        return array
    container: Any = dict(action) if isinstance(action, dict) else list(action)
    container[key] = replace_part(action[key], rest, value)
    return container if isinstance(action, dict) else tuple(container)


def digits_of(space: spaces.Space[Any]) -> tuple[tuple[int, ...], np.ndarray]:
    """:return: the number of values of every digit of a discrete leaf, and the smallest value of each."""
    if isinstance(space, spaces.Discrete):
        return (int(space.n),), np.array([int(space.start)])
    if isinstance(space, spaces.MultiDiscrete):
        return tuple(int(n) for n in space.nvec.flat), np.asarray(space.start).flatten()
    assert isinstance(space, spaces.MultiBinary)
    size = int(np.prod(space.shape))
    return (2,) * size, np.zeros(size, dtype=np.int64)


def rows_of(box: spaces.Box) -> list[tuple[int, spaces.Space[Any]]]:
    """:return: (index, row) of an array"""
    return [(i, spaces.Box(box.low[i], box.high[i], box.shape[1:], box.dtype.type)) for i in range(box.shape[0])]


def find_options(space: spaces.Space[Any], vectors: bool = False) -> tuple[Path, list[tuple[Path, spaces.Space[Any]]]] | None:
    """
    Look for a ``Discrete(K)`` next to K parameter spaces, flat, gathered in one container or as the rows of one ``Box``.

    :param space: an action space
    :param vectors: whether numbers of a vector are such rows too
    :return: path of the discrete leaf and (path, space) of the K options, None if there is no such reading
    """
    children = children_of(space) or []
    for key, child in children:
        if not isinstance(child, spaces.Discrete):
            continue
        rest: list[tuple[Path, spaces.Space[Any]]] = [((other,), part) for other, part in children if other != key]
        candidates = [rest]
        if len(rest) == 1 and (inner := children_of(rest[0][1])) is not None:
            candidates.insert(0, [((*rest[0][0], name), part) for name, part in inner])
        if len(rest) == 1 and isinstance(array := rest[0][1], spaces.Box) and len(array.shape) >= (1 if vectors else 2):
            if array.shape[0] == child.n:
                candidates.append([((*rest[0][0], i), row) for i, row in rows_of(array)])
        for options in candidates:
            if len(options) == child.n and all(is_parameter_space(part) for _, part in options):
                return (key,), options
    return None


def discrete_leaves(space: spaces.Space[Any], name: str = "action_space") -> Iterator[DiscreteLeaf]:
    """
    :param space: an action space, or a part of one
    :param name: what to call it in messages
    :return: its discrete leaves
    :raises ValueError: if a leaf is neither discrete nor a box
    """
    for path, leaf in leaves_of(space):
        if isinstance(leaf, (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)):
            yield DiscreteLeaf(path, leaf, *digits_of(leaf))
        elif not isinstance(leaf, spaces.Box):
            raise ValueError(
                f"{name_of(path, name)} is a {type(leaf).__name__}; a hybrid action is made of Discrete, MultiDiscrete, "
                "MultiBinary and Box parts, or is a OneOf of such parts as a whole"
            )


def collect_boxes(space: spaces.Space[Any], prefix: Path, name: str | None = None) -> list[BoxLeaf]:
    """
    :param space: the parameters of one action, or of all
    :param prefix: path of ``space`` in the native action
    :param name: what to call ``space`` in messages, from its path if None
    :return: its boxes, with consecutive columns of the parameter vector
    :raises ValueError: for boxes that are unbounded or not numeric
    """
    boxes: list[BoxLeaf] = []
    offset = 0
    for path, leaf in leaves_of(space, prefix):
        leaf_name = name_of(path[len(prefix) :], name or name_of(prefix))
        if not isinstance(leaf, spaces.Box):
            continue
        if leaf.dtype.kind not in "fiu":
            raise ValueError(f"{leaf_name} has dtype {leaf.dtype}; use a floating or integer Box")
        # is_bounded() knows integers, whose bounds are numbers even if none were given
        if not (leaf.is_bounded() and np.isfinite(leaf.low).all() and np.isfinite(leaf.high).all()):
            raise ValueError(
                f"{leaf_name} is unbounded or has NaN bounds ({leaf}); give it finite bounds, in the environment or with "
                "gymnasium.wrappers.TransformAction(env, lambda action: action, space), where space is the action space with "
                "a bounded Box in this place"
            )
        size = int(np.prod(leaf.shape))
        boxes.append(BoxLeaf(path, leaf, slice(offset, offset + size)))
        offset += size
    return boxes


def template_action(space: spaces.Space[Any], place: float) -> Any:
    """:return: a native action with every box at a place from -1, its lower bounds, to 1, to be filled in by ``to_native``"""
    cache: dict[Any, np.ndarray] = {}

    def build(part: spaces.Space[Any]) -> Any:
        if isinstance(part, spaces.Tuple):
            return tuple(build(child) for child in part.spaces)
        if isinstance(part, spaces.Dict):
            return {key: build(child) for key, child in part.spaces.items()}
        if isinstance(part, spaces.Discrete):
            return part.dtype.type(part.start)
        if not isinstance(part, spaces.Box):
            return None
        # Equal boxes share one array: cheap to hold and, in subprocesses, to pickle
        key = (part.shape, part.dtype, part.low.tobytes(), part.high.tobytes())
        if key not in cache:
            low, high = part.low.astype(np.float64), part.high.astype(np.float64)
            cache[key] = cast_to_box((0.5 - place / 2) * low + (0.5 + place / 2) * high, part)
        return cache[key]

    return build(space)


def cast_to_box(values: np.ndarray, box: spaces.Box) -> np.ndarray:
    """Reshape float64 values to a box; integers are rounded, and the result is inside the bounds in the box's dtype."""
    values = values.reshape(box.shape)
    cast = values
    if box.dtype.kind in "iu":
        # The bounds of 64-bit integers are not floats: clip to the floats inside before the cast, and to the bounds after
        # it. Rounding comes second, else nextafter would cost narrow integers their largest value (255 -> 254)
        limits = np.iinfo(box.dtype.name)
        cast = np.rint(np.clip(values, np.nextafter(float(limits.min), 0), np.nextafter(float(limits.max), 0)))
    cast = cast.astype(box.dtype)
    if box.dtype.itemsize == 8 and box.dtype.kind in "iu":
        # What reaches the float nearest to a bound stands for the bound
        cast = np.where(values >= box.high.astype(np.float64), box.high, cast)
        cast = np.where(values <= box.low.astype(np.float64), box.low, cast)
    # Faster than clip; asarray because ufuncs make scalars of 0-dimensional arrays
    return np.asarray(np.minimum(np.maximum(cast, box.low), box.high))
