"""Hybrid action spaces: the only module that knows how users spell them."""

from collections.abc import Iterator
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

MAX_DISCRETE_ACTIONS = 65_536
LAYOUTS = ("auto", "per_action", "shared")

Path = tuple[Any, ...]


class HybridAction(tuple):
    """
    A native action that is a tuple and remembers its row.

    ``np.asarray`` of it gives the row ``[k | scaled parameters]``, so that ``VecCheckNan`` can look at a list of them.
    It pickles as a plain tuple: a subprocess of the user never needs this class.
    """

    row: np.ndarray

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.row, dtype=dtype)

    def __reduce__(self) -> tuple[Any, ...]:
        return tuple, (tuple(self),)


class _BoxLeaf(NamedTuple):
    """A ``Box`` of the action space and the columns of the padded parameter vector that it occupies."""

    path: Path
    space: spaces.Box
    columns: slice


class _DiscreteLeaf(NamedTuple):
    """A discrete leaf, its digits (one for ``Discrete``, one per element otherwise) and their offset."""

    path: Path
    space: spaces.Space
    radices: tuple[int, ...]
    start: np.ndarray


def _children(space: spaces.Space) -> list[tuple[Any, spaces.Space]] | None:
    """:return: (key, child) pairs of a ``Tuple`` or ``Dict``, None for a leaf."""
    if isinstance(space, spaces.Tuple):
        return list(enumerate(space.spaces))
    if isinstance(space, spaces.Dict):
        return list(space.spaces.items())
    return None


def _leaves(space: spaces.Space, path: Path = ()) -> Iterator[tuple[Path, spaces.Space]]:
    children = _children(space)
    if children is None:
        yield path, space
        return
    for key, child in children:
        yield from _leaves(child, (*path, key))


def _is_empty_discrete(space: spaces.Space) -> bool:
    return isinstance(space, spaces.Discrete) and space.n == 1


def _is_parameter_space(space: spaces.Space) -> bool:
    """Whether a subtree can be the parameters of one action: boxes only, ``Discrete(1)`` standing for none."""
    return all(isinstance(leaf, spaces.Box) or _is_empty_discrete(leaf) for _, leaf in _leaves(space))


def _name(path: Path) -> str:
    return "action_space" + "".join(f"[{key!r}]" for key in path)


def _get(action: Any, path: Path) -> Any:
    for key in path:
        action = action[key]
    return action


def _replace(action: Any, path: Path, value: Any) -> Any:
    """:return: ``action`` with ``value`` at ``path``; only the containers on the way are copied."""
    if not path:
        return value
    key, rest = path[0], path[1:]
    container: Any = dict(action) if isinstance(action, dict) else list(action)
    container[key] = _replace(action[key], rest, value)
    return container if isinstance(action, dict) else tuple(container)


def _digits(space: spaces.Space) -> tuple[tuple[int, ...], np.ndarray]:
    """:return: the number of values of every digit of a discrete leaf, and the smallest value of each."""
    if isinstance(space, spaces.Discrete):
        return (int(space.n),), np.array([int(space.start)])
    if isinstance(space, spaces.MultiDiscrete):
        return tuple(int(n) for n in space.nvec.flat), np.asarray(space.start).flatten()
    assert isinstance(space, spaces.MultiBinary)
    size = int(np.prod(space.shape))
    return (2,) * size, np.zeros(size, dtype=np.int64)


class HybridActionSpec:
    """
    Codec between a user's hybrid action space and rows ``[k | scaled parameters]``.

    Accepted, at any nesting depth and with any ``Dict`` keys (children count in the order of the space, which for a
    ``Dict`` built from a plain mapping is the sorted order of its keys):

    * one box per action: ``Tuple(Discrete(K), Tuple(Box_1, ..., Box_K))``, ``Tuple(Discrete(K), Box_1, ..., Box_K)``,
      ``OneOf((Box_1, ..., Box_K))``. An action without parameters is an empty ``Box``, ``Tuple`` or ``Dict``, or
      ``Discrete(1)``;
    * parameters shared by all actions: ``Tuple(Discrete(K), Box)``, and every product of several ``Discrete``,
      ``MultiDiscrete`` or ``MultiBinary`` leaves with ``Box`` leaves. The discrete leaves form one joint index
      (mixed radix, first leaf most significant).

    A space with one ``Discrete(K)`` at the top and exactly K further parts can be read both ways. Rule: it is one box
    per action; ``layout="shared"`` overrides it.

    :param space: the native action space
    :param layout: "auto" (the rule above), "per_action" or "shared"
    :raises ValueError: for a space without discrete or continuous part, with unbounded or non-numeric boxes, with other
        kinds of leaves, or with more than 65,536 joint discrete actions
    """

    def __init__(self, space: spaces.Space, layout: str = "auto"):
        if layout not in LAYOUTS:
            raise ValueError(f"action_layout must be one of {LAYOUTS}, got {layout!r}")
        self.space = space
        self.layout = layout
        if isinstance(space, spaces.OneOf):
            if layout == "shared":
                raise ValueError("action_layout='shared' does not apply to a OneOf space, whose parts exclude each other")
            self._discrete_leaves: list[_DiscreteLeaf] = []
            options: list[tuple[Path, spaces.Space]] = [(("option",), option) for option in space.spaces]
            self.is_shared = False
        elif isinstance(space, (spaces.Tuple, spaces.Dict)):
            choice = None if layout == "shared" else self._find_options(space)
            if choice is None and layout == "per_action":
                raise ValueError(f"action_layout='per_action' needs a Discrete(K) and exactly K parameter spaces, got {space}")
            self.is_shared = choice is None
            if choice is None:
                self._discrete_leaves = self._collect_discrete(space)
                options = [((), space)]
            else:
                discrete_path, options = choice
                discrete_space = _get(space, discrete_path)
                self._discrete_leaves = [_DiscreteLeaf(discrete_path, discrete_space, *_digits(discrete_space))]
        else:
            raise ValueError(
                f"The action space must be a Tuple, Dict or OneOf with a discrete and a continuous part, got {space}"
            )

        self._radices = tuple(radix for leaf in self._discrete_leaves for radix in leaf.radices)
        # Python integers: the product of many radices may overflow int64
        n_joint = len(options) if not self._discrete_leaves else 1
        for radix in self._radices:
            n_joint *= radix
        if n_joint > MAX_DISCRETE_ACTIONS:
            raise ValueError(
                f"{n_joint} joint discrete actions are more than the {MAX_DISCRETE_ACTIONS} supported, in {space}"
            )
        self.n_discrete_actions = n_joint
        self._boxes = [self._collect_boxes(option, path) for path, option in options]
        if isinstance(space, spaces.OneOf):
            # The part of the native action behind the index lives under the key "option" while it is being built
            self._templates: list[Any] = [{"option": self._template(option)} for option in space.spaces]
        else:
            self._templates = [self._template(space)]
        self._build_tables()

    @staticmethod
    def _find_options(space: spaces.Space) -> tuple[Path, list[tuple[Path, spaces.Space]]] | None:
        """
        Look for a ``Discrete(K)`` next to K parameter spaces, flat or gathered in one container.

        :return: path of the discrete leaf and (path, space) of the K options, None if there is no such reading
        """
        children = _children(space) or []
        for key, child in children:
            if not isinstance(child, spaces.Discrete):
                continue
            rest: list[tuple[Path, spaces.Space]] = [((other,), part) for other, part in children if other != key]
            candidates = [rest]
            if len(rest) == 1 and (inner := _children(rest[0][1])) is not None:
                candidates.insert(0, [((*rest[0][0], name), part) for name, part in inner])
            for options in candidates:
                if len(options) == child.n and all(_is_parameter_space(part) for _, part in options):
                    return (key,), options
        return None

    @staticmethod
    def _collect_discrete(space: spaces.Space) -> list[_DiscreteLeaf]:
        leaves = []
        for path, leaf in _leaves(space):
            if isinstance(leaf, (spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)):
                leaves.append(_DiscreteLeaf(path, leaf, *_digits(leaf)))
            elif not isinstance(leaf, spaces.Box):
                raise ValueError(
                    f"{_name(path)} is a {type(leaf).__name__}; a hybrid action is made of Discrete, MultiDiscrete, "
                    "MultiBinary and Box parts"
                )
        if not leaves:
            raise ValueError(f"{space} has no discrete part: use an algorithm for Box actions, e.g. SAC or TD3")
        return leaves

    @staticmethod
    def _collect_boxes(space: spaces.Space, prefix: Path) -> list[_BoxLeaf]:
        boxes: list[_BoxLeaf] = []
        offset = 0
        for path, leaf in _leaves(space, prefix):
            if not isinstance(leaf, spaces.Box):
                if prefix == ("option",) and not _is_empty_discrete(leaf):
                    raise ValueError(f"A part of a OneOf action space must hold Box spaces only, got {leaf}")
                continue
            if leaf.dtype.kind not in "fiu":
                raise ValueError(f"{_name(path)} has dtype {leaf.dtype}; use a floating or integer Box")
            if not (np.isfinite(leaf.low).all() and np.isfinite(leaf.high).all()):
                raise ValueError(
                    f"{_name(path)} is unbounded or has NaN bounds ({leaf}); give it finite bounds, "
                    "for example with gymnasium.wrappers.TransformAction"
                )
            size = int(np.prod(leaf.shape))
            boxes.append(_BoxLeaf(path, leaf, slice(offset, offset + size)))
            offset += size
        return boxes

    @classmethod
    def _template(cls, space: spaces.Space) -> Any:
        """:return: a native action with every box at the middle of its bounds, to be filled in by ``to_native``"""
        cache: dict[Any, np.ndarray] = {}

        def build(part: spaces.Space) -> Any:
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
                middle = 0.5 * part.low.astype(np.float64) + 0.5 * part.high.astype(np.float64)
                cache[key] = cls._cast(middle, part)
                cache[key].setflags(write=False)
            return cache[key]

        return build(space)

    def _build_tables(self) -> None:
        """Fill the (K, Pmax) tables: mask, centre and half range of every parameter, column in the concatenated vector."""
        sizes = [boxes[-1].columns.stop if boxes else 0 for boxes in self._boxes]
        self.max_parameters = max(sizes)
        if self.max_parameters == 0:
            raise ValueError(f"{self.space} has no continuous part: use an algorithm for discrete actions, e.g. DQN or PPO")
        n_options = len(self._boxes)
        mask = np.zeros((n_options, self.max_parameters), dtype=bool)
        centre, half = np.zeros(mask.shape), np.zeros(mask.shape)
        for i, boxes in enumerate(self._boxes):
            mask[i, : sizes[i]] = True
            for box in boxes:
                low, high = (bound.astype(np.float64).ravel() for bound in (box.space.low, box.space.high))
                centre[i, box.columns] = 0.5 * low + 0.5 * high
                half[i, box.columns] = 0.5 * high - 0.5 * low
        offsets = np.cumsum([0, *sizes])
        self.n_parameters = int(offsets[-1])
        index = np.where(mask, offsets[:-1, None] + np.arange(self.max_parameters), 0)
        # A shared layout has a single option that serves all K actions
        shape = (self.n_discrete_actions, self.max_parameters)
        self.mask, self._centre, self._half, self.parameter_index = (
            np.broadcast_to(table, shape) for table in (mask, centre, half, index)
        )

    @property
    def row_size(self) -> int:
        """Length of a row ``[k | scaled parameters]``: 1 + Pmax."""
        return 1 + self.max_parameters

    @cached_property
    def parameter_sizes(self) -> np.ndarray:
        """(K,) number of parameters of every discrete action"""
        return self.mask.sum(axis=1)

    @staticmethod
    def _cast(values: np.ndarray, box: spaces.Box) -> np.ndarray:
        """Reshape float64 values to a box; integers are rounded, and the result is inside the bounds in the box's dtype."""
        if box.dtype.kind in "iu":
            values = np.rint(values)
            # The bounds of 64-bit integers are not floats: clip before the cast and after it
            limits = np.iinfo(box.dtype.name)
            values = np.clip(values, np.nextafter(float(limits.min), 0), np.nextafter(float(limits.max), 0))
        values = values.reshape(box.shape).astype(box.dtype)
        # Faster than clip; asarray because ufuncs make scalars of 0-dimensional arrays
        return np.asarray(np.minimum(np.maximum(values, box.low), box.high))

    def to_native(self, row: np.ndarray) -> Any:
        """
        :param row: (1 + Pmax,) ``[k | scaled parameters]``; parameters are clipped to [-1, 1], padding is ignored
        :return: the native action; ``space.contains`` holds for it
        """
        return self.to_native_batch(np.asarray(row)[None])[0]

    def to_native_batch(self, rows: np.ndarray) -> list[Any]:
        """
        :param rows: (n, 1 + Pmax) or wider, ``[k | scaled parameters | ignored]``
        :return: n native actions
        """
        rows = np.asarray(rows)
        choices = rows[:, 0].astype(np.int64)
        if ((choices < 0) | (choices >= self.n_discrete_actions)).any():
            raise ValueError(f"The first column of a row must be in 0..{self.n_discrete_actions - 1}, got {choices}")
        scaled = np.clip(rows[:, 1 : self.row_size].astype(np.float64), -1.0, 1.0)
        values = self._centre[choices] + self._half[choices] * scaled
        return [self._assemble(int(k), v, row[: self.row_size]) for k, v, row in zip(choices, values, rows, strict=True)]

    def _assemble(self, k: int, values: np.ndarray, row: np.ndarray) -> Any:
        option = 0 if self.is_shared else k
        native = self._templates[option if isinstance(self.space, spaces.OneOf) else 0]
        for box in self._boxes[option]:
            native = _replace(native, box.path, self._cast(values[box.columns], box.space))
        if isinstance(self.space, spaces.OneOf):
            native = (np.int64(k), native["option"])
        else:
            for leaf, digits in zip(self._discrete_leaves, self._split_index(k), strict=True):
                native = _replace(native, leaf.path, self._native_digits(leaf, digits))
        if isinstance(native, tuple):
            native = HybridAction(native)
            native.row = row
        return native

    def _split_index(self, k: int) -> Iterator[np.ndarray]:
        # A single Discrete is by far the most common case
        digits = np.array([k] if len(self._radices) == 1 else np.unravel_index(k, self._radices))
        offset = 0
        for leaf in self._discrete_leaves:
            yield digits[offset : offset + len(leaf.radices)]
            offset += len(leaf.radices)

    @staticmethod
    def _native_digits(leaf: _DiscreteLeaf, digits: np.ndarray) -> Any:
        values = digits + leaf.start
        if isinstance(leaf.space, spaces.Discrete):
            return leaf.space.dtype.type(values[0])
        return values.reshape(leaf.space.shape).astype(leaf.space.dtype)

    def to_row(self, action: Any) -> np.ndarray:
        """
        Inverse of :meth:`to_native`. Parameters of actions that are not chosen have no place in a row and are dropped.

        :param action: a native action
        :return: (1 + Pmax,) float64 ``[k | scaled parameters]``, padding 0
        """
        if isinstance(self.space, spaces.OneOf):
            k = int(action[0])
            action = {"option": action[1]}
        else:
            digits = [np.ravel(_get(action, leaf.path)) - leaf.start for leaf in self._discrete_leaves]
            k = int(np.ravel_multi_index(tuple(np.concatenate(digits).astype(np.int64)), self._radices))
        row = np.zeros(self.row_size)
        row[0] = k
        for box in self._boxes[0 if self.is_shared else k]:
            values = np.ravel(_get(action, box.path)).astype(np.float64) - self._centre[k, box.columns]
            half = self._half[k, box.columns]
            row[1:][box.columns] = np.divide(values, half, out=np.zeros_like(values), where=half > 0)
        return row

    def sample_rows(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """
        :param rng: random generator
        :param n: number of rows
        :return: (n, 1 + Pmax) rows, k uniform over the K actions, parameters uniform in [-1, 1], padding 0
        """
        choices = rng.integers(self.n_discrete_actions, size=n)
        parameters = rng.uniform(-1.0, 1.0, size=(n, self.max_parameters)) * self.mask[choices]
        return np.concatenate([choices[:, None], parameters], axis=1)


class HybridBox(spaces.Box):
    """
    The flat space ``[k | scaled parameters | latent]`` that buffers and networks see instead of the native one.

    :param native: the user's action space
    :param layout: see :class:`HybridActionSpec`
    :param latent_dim: width of the latent that an algorithm stores behind the parameters
    """

    def __init__(self, native: spaces.Space, layout: str = "auto", latent_dim: int = 0):
        self.native = native
        self.spec = HybridActionSpec(native, layout)
        self.latent_dim = latent_dim
        high = np.ones(self.spec.row_size + latent_dim, dtype=np.float32)
        low = -high
        low[0], high[0] = 0, self.spec.n_discrete_actions - 1
        super().__init__(low, high, dtype=np.float32)

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, HybridBox) and (self.native, self.spec.layout, self.latent_dim) == (
            other.native,
            other.spec.layout,
            other.latent_dim,
        )

    def __reduce__(self) -> tuple[Any, ...]:
        # The tables of the spec follow from the native space
        return HybridBox, (self.native, self.spec.layout, self.latent_dim)
