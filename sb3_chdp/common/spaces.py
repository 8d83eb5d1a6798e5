"""Hybrid action spaces: the only module, with ``space_tree``, that knows how users spell them."""

import math
import pickle
from collections.abc import Iterator
from copy import copy
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_chdp.common.arguments import check, one_of
from sb3_chdp.common.one_of import OneOfChoices
from sb3_chdp.common.rows import Array, RowLayout, in_order, value_groups
from sb3_chdp.common.space_tree import (
    DiscreteLeaf,
    Path,
    cast_to_box,
    collect_boxes,
    digits_of,
    discrete_leaves,
    find_options,
    get_part,
    name_of,
    replace_part,
    template_action,
)

MAX_DISCRETE_ACTIONS = 65_536
# More joint discrete actions than these, too many to compare all of them, are factored unless the layout says otherwise
FACTORED_ABOVE = 64
# Of scaled parameters
ROUNDING = 1e-3
LAYOUTS = ("auto", "per_action", "shared", "joint", "factored")


class HybridActionSpec:
    """
    Codec between a user's hybrid action space and rows ``[k | scaled parameters]``.

    Accepted, with any ``Dict`` keys (children count in the order of the space, which for a ``Dict`` built from a plain
    mapping is the sorted order of its keys), parameters at any nesting depth:

    * one box per action: ``Tuple(Discrete(K), Tuple(Box_1, ..., Box_K))``, ``Tuple(Discrete(K), Box_1, ..., Box_K)``,
      ``Tuple(Discrete(K), Box)`` with a ``Box`` of K rows, ``OneOf((Box_1, ..., Box_K))``. An action without parameters is an
      empty ``Box``, ``Tuple`` or ``Dict``, or ``Discrete(1)``. A part of a ``OneOf`` may have discrete leaves, of which every
      combination is an action;
    * parameters shared by all actions: ``Tuple(Discrete(K), Box)``, and every product of several ``Discrete``,
      ``MultiDiscrete`` or ``MultiBinary`` leaves with ``Box`` leaves. Up to 64 combinations the discrete leaves form one
      joint index (mixed radix, first leaf most significant). Beyond that the space is factored: every digit of a leaf is a
      choice of its own, and k has a column for each. ``layout="joint"`` and ``layout="factored"`` override the rule.

    A space with one ``Discrete(K)`` at the top and exactly K further parts, or one ``Box`` of shape (K, d, ...), can be read
    both ways. Rule: it is one box per action; ``layout="shared"`` overrides it. A ``Box`` of shape (K,) is shared by all
    actions; ``layout="per_action"`` overrides that.

    :param space: the native action space
    :param layout: "auto" (the rules above), "per_action", "shared", "joint" (shared, one index) or "factored" (shared)
    :raises ValueError: for a space without discrete or continuous part, with unbounded or non-numeric boxes, with other
        kinds of leaves, with more than 65,536 discrete actions that are not factored, or with a single discrete part that
        shall be factored
    """

    def __init__(self, space: spaces.Space[Any], layout: str = "auto"):
        check(one_of(LAYOUTS), action_layout=layout)
        self.space = space
        self.layout = layout
        self._one_of: OneOfChoices | None = None
        choice: tuple[Path, list[tuple[Path, spaces.Space[Any]]]] | None = None
        if isinstance(space, spaces.OneOf):
            if layout not in ("auto", "per_action"):
                raise ValueError(f"action_layout={layout!r} does not apply to a OneOf space, whose parts exclude each other")
            self._one_of = OneOfChoices(space.spaces, MAX_DISCRETE_ACTIONS)
            # Read as one box per action; of its native actions only the chosen part is handed out
            parts = [space.spaces[i] for i in self._one_of.parts]
            space = spaces.Tuple((spaces.Discrete(len(parts)), spaces.Tuple(parts)))
            choice = (0,), [((1, k), part) for k, part in enumerate(parts)]
        elif not isinstance(space, (spaces.Tuple, spaces.Dict)):
            raise ValueError(
                f"The action space must be a Tuple, Dict or OneOf with a discrete and a continuous part, got {space}"
            )
        elif layout in ("auto", "per_action"):
            choice = find_options(space, vectors=layout == "per_action")
        if choice is None and layout == "per_action":
            raise ValueError(
                "action_layout='per_action' needs at the top a Discrete(K) and exactly K parameter spaces, or one Box with K "
                f"rows, got {space}"
            )
        self.is_shared = choice is None
        if choice is None:
            self._discrete_leaves = list(discrete_leaves(space))
            if not self._discrete_leaves:
                raise ValueError(f"{space} has no discrete part: as one Box SB3's SAC takes it")
            options: list[tuple[Path, spaces.Space[Any]]] = [((), space)]
        else:
            discrete_path, options = choice
            discrete_space = get_part(space, discrete_path)
            self._discrete_leaves = [DiscreteLeaf(discrete_path, discrete_space, *digits_of(discrete_space))]
        self._template_space = space

        #: numbers of values of all digits of the discrete leaves
        self.digits = tuple(radix for leaf in self._discrete_leaves for radix in leaf.radices)
        n_joint = math.prod(self.digits)
        can_factor = self.is_shared and len(self.digits) > 1
        if layout == "factored" and not can_factor:
            raise ValueError(f"action_layout='factored' needs several discrete parts, got {space}")
        self.is_factored = can_factor and (layout == "factored" or (layout != "joint" and n_joint > FACTORED_ABOVE))
        if n_joint > MAX_DISCRETE_ACTIONS and not self.is_factored:
            hint = (
                "action_layout='factored'" if can_factor else "several choices, as in a MultiDiscrete, with shared parameters"
            )
            raise ValueError(
                f"{n_joint} joint discrete actions are more than the {MAX_DISCRETE_ACTIONS} supported; {hint} has no limit, "
                f"in {self.space}"
            )
        self.n_discrete_actions = n_joint
        #: numbers of values of the choices that a row makes: a single one, K, unless the space is factored
        self.radices: tuple[int, ...] = self.digits if self.is_factored else (n_joint,)
        parts_of_options = [None] * len(options) if self._one_of is None else self._one_of.parts
        names = [None if i is None else f"action_space.spaces[{i}]" for i in parts_of_options]
        self._boxes = [collect_boxes(part, path, name) for (path, part), name in zip(options, names, strict=True)]
        self._template = self._make_template(0.0)
        self._build_tables()

    def _make_template(self, place: float) -> bytes:
        # Pickled: to load one is the fastest way to copy it, and every action has arrays of its own, which may be changed
        return pickle.dumps(template_action(self._template_space, place))

    def leaving_others_at(self, place: float) -> "HybridActionSpec":
        """
        :param place: scaled value in [-1, 1]
        :return: a codec whose native actions have all parameters there that are not those of the chosen action, instead of in
            the middle
        """
        spec = copy(self)
        spec._template = self._make_template(place)
        return spec

    def _build_tables(self) -> None:
        """Fill the (K, Pmax) tables: which parameters there are, centres, half ranges, columns in the concatenated vector."""
        sizes = [boxes[-1].columns.stop if boxes else 0 for boxes in self._boxes]
        self.max_parameters = max(sizes)
        self.columns = RowLayout(discrete_actions=len(self.radices), parameters=self.max_parameters)
        if self.max_parameters == 0:
            raise ValueError(f"{self.space} has no continuous part: as a Discrete or MultiDiscrete SB3's PPO takes it")
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
        # A shared layout has a single option that serves all K actions; in a factored one these are not to be counted
        shape = (1 if self.is_factored else self.n_discrete_actions, self.max_parameters)
        self.parameter_mask, self.centre, self.half_range, self.parameter_index = (
            np.broadcast_to(table, shape) for table in (mask, centre, half, index)
        )

    @cached_property
    def choices_of_leaves(self) -> dict[str, slice]:
        """which of the L choices of a factored space belong to which of its leaves, by the leaves' keys; {} of others"""
        choices: dict[str, slice] = {}
        start = 0
        for leaf in self._discrete_leaves if self.is_factored else ():
            end = start + len(leaf.radices)
            choices["/".join(map(str, leaf.path))] = slice(start, end)
            start = end
        return choices

    @property
    def n_mask_values(self) -> int:
        """Length of the masks of all discrete parts one after the other: the sum of their numbers of values."""
        return sum(self.digits)

    def join_masks(self, masks: np.ndarray) -> np.ndarray:
        """
        :param masks: (n, n_mask_values) booleans, False for values of a discrete part that may not be taken
        :return: (n, K) booleans, whether all values of a joint discrete action may be taken; the masks as they are if the
            space is factored
        """
        if self.is_factored or len(self.digits) <= 1:
            return masks
        joint = np.ones((len(masks), 1), dtype=bool)
        for part in np.split(masks, np.cumsum(self.digits)[:-1], axis=1):
            joint = (joint[:, :, None] & part[:, None]).reshape(len(masks), -1)
        return joint

    def options_of(self, choices: Array) -> Array:
        """
        :param choices: (n,) discrete actions, (n, L) of a factored space
        :return: (n,) their rows in the tables of parameters: ``parameter_mask`` and ``parameter_index``
        """
        return choices if choices.ndim == 1 else choices[:, 0] * 0

    def __repr__(self) -> str:
        sizes = sorted({*self.parameter_mask.sum(axis=1).tolist()})
        discrete = f"{len(self.radices)} choices" if self.is_factored else f"{self.n_discrete_actions} discrete actions"
        of_actions = f"{sizes[0]} shared parameters" if self.is_shared else f"{' or '.join(map(str, sizes))} parameters each"
        return f"HybridActionSpec({discrete}, {of_actions})"

    def to_native(self, row: npt.ArrayLike) -> Any:
        """
        :param row: (columns.width,) ``[k | scaled parameters]``; parameters are clipped to [-1, 1], padding is ignored
        :return: the native action; ``space.contains`` holds for it
        """
        return self.to_native_batch(np.asarray(row)[None])[0]

    def to_native_batch(self, rows: npt.ArrayLike) -> list[Any]:
        """
        :param rows: (n, columns.width) or wider, ``[k | scaled parameters | ignored]``
        :return: n native actions
        :raises ValueError: if rows are too narrow, have no such discrete action or are not finite
        """
        rows = np.asarray(rows)
        width = self.columns.width
        if rows.ndim != 2 or rows.shape[1] < width:
            raise ValueError(f"A row must be {width} numbers or more, got shape {rows.shape[1:]}")
        if not np.isfinite(rows[:, :width]).all():
            raise ValueError(f"The first {width} numbers of a row must be finite, got {rows[:, :width]}")
        choices = self.columns.discrete_actions(rows)
        largest = np.array(self.radices) - 1
        if ((choices < 0) | (choices > (largest if self.is_factored else largest[0]))).any():
            first = f"The first {len(largest)} columns" if self.is_factored else "The first column"
            raise ValueError(f"{first} of a row must be in 0..{', 0..'.join(map(str, largest))}, got {choices}")
        scaled = np.clip(self.columns.view(rows, "parameters").astype(np.float64), -1.0, 1.0)
        options = self.options_of(choices)
        values = self.centre[options] + self.half_range[options] * scaled
        return [self._assemble(k, v) for k, v in zip(choices, values, strict=True)]

    def _assemble(self, k: Any, values: np.ndarray) -> Any:
        option = 0 if self.is_shared else int(k)
        native = pickle.loads(self._template)
        for box in self._boxes[option]:
            native = replace_part(native, box.path, cast_to_box(values[box.columns], box.space))
        if self._one_of is not None:
            return self._one_of.native(option, native[1][option])
        for leaf, digits in zip(self._discrete_leaves, self._split_index(k), strict=True):
            native = replace_part(native, leaf.path, leaf.value_of(digits))
        return native

    def _split_index(self, k: Any) -> Iterator[np.ndarray]:
        if not self.is_factored:
            # A single Discrete is by far the most common case
            k = [k] if len(self.digits) == 1 else np.unravel_index(int(k), self.digits)
        digits = np.array(k)
        offset = 0
        for leaf in self._discrete_leaves:
            yield digits[offset : offset + len(leaf.radices)]
            offset += len(leaf.radices)

    def names_of(self, k: int) -> str:
        """:return: the boxes of a discrete action"""
        return ", ".join(name_of(box.path) for box in self._boxes[k]) or "no parameters"

    def to_row(self, action: Any) -> np.ndarray:
        """
        Inverse of :meth:`to_native`. Parameters of actions that are not chosen have no place in a row and are dropped.

        :param action: a native action
        :return: (columns.width,) float64 ``[k | scaled parameters]``, padding 0
        :raises ValueError: for a discrete value or a parameter outside of its range
        """
        given = action
        if self._one_of is not None:
            index = self._one_of.index_of(action)
            action = (index, {index: action[1]})
        k = np.concatenate([leaf.digits_of(get_part(action, leaf.path)) for leaf in self._discrete_leaves])
        if not ((k >= 0) & (k < self.digits)).all():
            raise ValueError(f"action must be in {self.space}, got {given!r}")
        if not self.is_factored:
            k = np.array([np.ravel_multi_index(tuple(k), self.digits)])
        option = 0 if self.is_shared else int(k[0])
        parameters = np.zeros(self.max_parameters)
        for box in self._boxes[option]:
            values = np.ravel(get_part(action, box.path)).astype(np.float64) - self.centre[option, box.columns]
            half = self.half_range[option, box.columns]
            parameters[box.columns] = np.divide(values, half, out=np.zeros_like(values), where=half > 0)
        if not (np.abs(parameters) <= 1 + ROUNDING).all():
            raise ValueError(f"action must be in {self.space}, got {given!r}")
        return self.columns.pack(discrete_actions=k[None], parameters=parameters[None])[0]

    def sample_choices(self, rng: np.random.Generator, n: int, masks: np.ndarray | None = None) -> np.ndarray:
        """
        :param rng: random generator
        :param n: number of choices
        :param masks: (n, sum of the radices) False for values that may not be taken
        :return: (n,) uniformly random discrete actions, (n, L) of a factored space
        """
        if masks is None:
            high = self.radices if self.is_factored else self.n_discrete_actions
            return rng.integers(high, size=(n, len(self.radices)) if self.is_factored else n)
        parts = []
        for _, places in value_groups(self.radices):
            allowed = masks[:, places]
            ranks = rng.integers(allowed.sum(axis=2))
            parts.append((allowed.cumsum(axis=2) > ranks[:, :, None]).argmax(axis=2))
        choices = in_order(parts, self.radices)
        return choices if self.is_factored else choices[:, 0]

    def sample_rows(self, rng: np.random.Generator, n: int, masks: np.ndarray | None = None) -> np.ndarray:
        """
        :param rng: random generator
        :param n: number of rows
        :param masks: (n, sum of the radices) False for values that may not be taken
        :return: (n, columns.width) rows, k uniform over the K actions, parameters uniform in [-1, 1], padding 0
        """
        choices = self.sample_choices(rng, n, masks)
        parameters = rng.uniform(-1.0, 1.0, size=(n, self.max_parameters)) * self.parameter_mask[self.options_of(choices)]
        return self.columns.pack(discrete_actions=choices, parameters=parameters)

    def own_parameters(self, choices: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """
        :param choices: (n,) discrete actions
        :param parameters: (n, P) scaled parameters of all actions, one after the other
        :return: (n, columns.width) rows of the chosen actions with their own parameters
        """
        options = self.options_of(choices)
        own_parameters = np.take_along_axis(parameters, self.parameter_index[options], axis=1) * self.parameter_mask[options]
        return self.columns.pack(discrete_actions=choices, parameters=own_parameters)
