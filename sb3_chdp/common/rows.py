"""Rows of numbers that stand for actions: the one place that knows which columns hold what."""

from typing import TypeVar

import numpy as np
import torch as th

Array = TypeVar("Array", np.ndarray, th.Tensor)


class RowLayout:
    """
    The columns of rows by name, from left to right.

    Names in use: ``discrete_actions`` (1 column, the index k) or ``scores`` (K columns, of which the highest decides),
    ``parameters`` (scaled to [-1, 1]), ``latents`` and ``masks`` (K columns, 0 for actions that were not allowed).

    :param widths: number of columns by name
    """

    def __init__(self, **widths: int):
        ends = np.cumsum([0, *widths.values()]).tolist()
        self._slices = {name: slice(*ends[i : i + 2]) for i, name in enumerate(widths)}
        self.width: int = ends[-1]

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
