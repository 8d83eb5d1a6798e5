"""Rows of numbers that stand for actions: the one place that knows which columns hold what."""

from typing import TypeVar

import numpy as np
import torch as th

Array = TypeVar("Array", np.ndarray, th.Tensor)

# Booleans that a float32 column holds; it counts up to 2^24 without a gap
BITS = 16
# Parts that hold masks; they come last
MASK_PARTS = ("masks", "next_masks")


class RowLayout:
    """
    The columns of rows by name, from left to right.

    Names in use: ``discrete_actions`` (1 column, the index k) or ``scores`` (K columns, of which the highest decides),
    ``parameters`` (scaled to [-1, 1]), ``latents``, ``masks`` and ``next_masks`` (which discrete actions were allowed in the
    state and in the next one, 16 of them in a column).

    :param n_masks: number of booleans in a mask, for the parts that hold masks
    :param widths: number of columns by name
    """

    def __init__(self, n_masks: int = 0, **widths: int):
        self.n_masks = n_masks
        ends = np.cumsum([0, *widths.values()]).tolist()
        self._slices = {name: slice(*ends[i : i + 2]) for i, name in enumerate(widths)}
        self.width: int = ends[-1]
        #: number of columns without masks
        self.action_width: int = self.width - sum(widths.get(name, 0) for name in MASK_PARTS)

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
        :return: (n,) int64 indices of the discrete actions
        """
        if "scores" in self:
            return self.view(rows, "scores").argmax(-1)
        indices = self.view(rows, "discrete_actions")[..., 0]
        return indices.long() if isinstance(indices, th.Tensor) else indices.astype(np.int64)

    def masks(self, rows: Array, name: str = "masks") -> Array:
        """
        :param rows: (n, width) rows
        :param name: of the part
        :return: (n, n_masks) booleans, which discrete actions were allowed
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
            shape = (len(first), place.stop - place.start)
            if name not in columns:
                columns[name] = first.new_zeros(shape) if isinstance(first, th.Tensor) else np.zeros(shape, first.dtype)
            assert columns[name].shape == shape, f"{name} must have shape {shape}, got {columns[name].shape}"
        ordered = [columns[name] for name in self._slices]
        return th.cat(ordered, dim=1) if isinstance(first, th.Tensor) else np.concatenate(ordered, axis=1)


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
