"""Rows of numbers that stand for actions: the one place that knows which columns hold what."""

from functools import lru_cache
from typing import TypeVar

import numpy as np
import torch as th

Array = TypeVar("Array", np.ndarray, th.Tensor)

# Booleans that a float32 column holds; it counts up to 2^24 without a gap
BITS = 16
# What is known of the states before and after an action; these parts come last
MASK_PARTS, RETURN_PARTS = ("masks", "next_masks"), ("returns", "next_returns")


class RowLayout:
    """
    The columns of rows by name, from left to right.

    Names in use: ``discrete_actions`` (a column per choice, with the index of the value) or ``scores`` (a column per value, of
    which the highest of each choice decides), ``parameters`` (scaled to [-1, 1]), ``latents``, ``masks`` and ``next_masks``
    (which values were allowed in the state and in the next one, 16 of them in a column), ``returns`` and ``next_returns``
    (the sum of the episode's rewards before the action, and with its reward).

    :param radices: numbers of values of the choices that an action makes
    :param widths: number of columns by name
    """

    def __init__(self, radices: tuple[int, ...] = (), **widths: int):
        self.radices = radices
        self.n_masks = sum(radices)
        ends = np.cumsum([0, *widths.values()]).tolist()
        self._slices = {name: slice(*ends[i : i + 2]) for i, name in enumerate(widths)}
        self.width: int = ends[-1]
        #: number of columns that the action needs
        self.action_width: int = self.width - sum(widths.get(name, 0) for name in MASK_PARTS + RETURN_PARTS)

    def __contains__(self, name: str) -> bool:
        return name in self._slices

    def view(self, rows: Array, name: str) -> Array:
        """
        :param rows: (..., width) rows, or wider ones
        :param name: of the part
        :return: (..., columns of the part), which shares its memory with the rows
        """
        return rows[..., self._slices[name]]

    def discrete_actions(self, rows: Array) -> Array:
        """
        :param rows: (n, width) rows
        :return: int64 indices of the discrete actions: (n,), or (n, L) if they are made of L > 1 choices
        """
        if "scores" in self:
            return best_values(self.view(rows, "scores"), self.radices)
        indices = self.view(rows, "discrete_actions")
        indices = indices[..., 0] if indices.shape[-1] == 1 else indices
        return indices.long() if isinstance(indices, th.Tensor) else indices.astype(np.int64)

    def masks(self, rows: Array, name: str = "masks") -> Array:
        """
        :param rows: (n, width) rows
        :param name: of the part
        :return: (n, n_masks) booleans, which values were allowed
        """
        return unpack_bits(self.view(rows, name), self.n_masks)

    def pack(self, **parts: Array) -> Array:
        """
        :param parts: (n,) or (n, columns) by name; what is left out becomes 0
        :return: (n, width) rows
        """
        columns = {name: part[:, None] if part.ndim == 1 else part for name, part in parts.items()}
        first = next(iter(columns.values()))
        for name, place in self._slices.items():
            # Not len(), at which torch.export would take the size of its example for the only one
            shape = (first.shape[0], place.stop - place.start)
            if name not in columns:
                columns[name] = first.new_zeros(shape) if isinstance(first, th.Tensor) else np.zeros(shape, first.dtype)
            assert columns[name].shape == shape, f"{name} must have shape {shape}, got {columns[name].shape}"
        ordered = [columns[name] for name in self._slices]
        return th.cat(ordered, dim=1) if isinstance(first, th.Tensor) else np.concatenate(ordered, axis=1)


@lru_cache
def value_groups(radices: tuple[int, ...]) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """
    Choices that have equally many values, so that one array holds what belongs to these.

    :param radices: numbers of values of L choices
    :return: for every number r of values the (n,) choices that have so many, and (n, r) where their values are among those of
        all choices one after the other
    """
    offsets = np.cumsum((0, *radices[:-1]))
    groups = []
    for radix in dict.fromkeys(radices):
        choices = np.flatnonzero(np.array(radices) == radix)
        groups.append((choices, offsets[choices, None] + np.arange(radix)))
        for array in groups[-1]:
            array.setflags(write=False)
    return tuple(groups)


def in_order(parts: list[Array], radices: tuple[int, ...]) -> Array:
    """
    :param parts: (..., n) for each of :func:`value_groups` something of its n choices
    :param radices: numbers of values of the L choices
    :return: (..., L) the same in the order of the choices
    """
    order = np.concatenate([choices for choices, _ in value_groups(radices)]).argsort()
    first = parts[0]
    if isinstance(first, th.Tensor):
        return th.cat(parts, dim=-1)[..., th.tensor(order, device=first.device)]
    return np.concatenate(parts, axis=-1)[..., order]


def best_values(scores: Array, radices: tuple[int, ...]) -> Array:
    """
    :param scores: (..., sum of the radices) scores of all values
    :param radices: numbers of values of L choices
    :return: (...) index of the best value for a single choice, else (..., L)
    """
    if len(radices) <= 1:
        return scores.argmax(-1)
    parts = []
    for _, places in value_groups(radices):
        index = th.tensor(places, device=scores.device) if isinstance(scores, th.Tensor) else places
        parts.append(scores[..., index].argmax(-1))
    return in_order(parts, radices)


def pack_bits(masks: Array) -> Array:
    """
    :param masks: (n, M) booleans
    :return: (n, ceil(M / 16)) float32 columns of whole numbers, the first boolean the lowest bit
    """
    n, n_masks = masks.shape
    width = -(-n_masks // BITS)
    if isinstance(masks, th.Tensor):
        padded = th.nn.functional.pad(masks.long(), (0, width * BITS - n_masks)).view(n, width, BITS)
        return (padded << th.arange(BITS, device=masks.device)).sum(dim=2).float()
    padded = np.pad(masks.astype(np.int64), ((0, 0), (0, width * BITS - n_masks))).reshape(n, width, BITS)
    return (padded << np.arange(BITS)).sum(axis=2).astype(np.float32)


def unpack_bits(columns: Array, n_masks: int) -> Array:
    """Inverse of :func:`pack_bits`, for M = n_masks."""
    if isinstance(columns, th.Tensor):
        bits = (columns.long()[:, :, None] >> th.arange(BITS, device=columns.device)) & 1
    else:
        bits = (columns.astype(np.int64)[:, :, None] >> np.arange(BITS)) & 1
    masks = bits.reshape(len(columns), bits.shape[1] * BITS)[:, :n_masks]
    return masks.bool() if isinstance(masks, th.Tensor) else masks.astype(bool)
