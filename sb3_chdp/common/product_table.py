"""Tables of vectors for actions that are made of several choices: a block of the vector for each (product quantisation)."""

import numpy as np
import torch as th
from torch import nn

from sb3_chdp.common.rows import in_order, value_groups


def block_widths(radices: tuple[int, ...], width: int) -> tuple[int, ...]:
    """
    :param radices: numbers of values of the choices
    :param width: width of the vector of a single choice
    :return: width of the block of every choice: r values have all distances that they can have in r - 1 dimensions
    """
    if len(radices) == 1:
        return (width,)
    return tuple(min(width, max(1, radix - 1)) for radix in radices)


class ProductTable(nn.Module):
    """
    A learnable vector for every value of L choices, initialised U(-1, 1). The vector of an action is their concatenation, in
    which choices with equally many values lie side by side.

    Source: Jégou et al. (2011), "Product Quantization for Nearest Neighbor Search". The cost grows with the sum of the
    radices, the number of actions with their product.

    :param radices: numbers of values of the choices
    :param width: width of a block at most, see :func:`block_widths`
    """

    grouped: th.Tensor
    offsets: th.Tensor
    grouped_places: th.Tensor
    choice_of_column: th.Tensor

    def __init__(self, radices: tuple[int, ...], width: int):
        super().__init__()
        self.radices = tuple(radices)
        widths = block_widths(self.radices, width)
        #: width of the vector of an action
        self.width = sum(widths)
        groups = value_groups(self.radices)
        shapes = [(*places.shape, widths[choices[0]]) for choices, places in groups]
        self.tables = nn.ParameterList(th.empty(shape).uniform_(-1, 1) for shape in shapes)
        grouped = np.concatenate([choices for choices, _ in groups])
        buffers = {
            # The choices in the order of the groups, and all values in this order
            "grouped": grouped,
            "grouped_places": np.concatenate([places.flatten() for _, places in groups]),
            # Where the values of a choice begin among all values, as in masks
            "offsets": np.cumsum((0, *self.radices[:-1])),
            "choice_of_column": grouped.repeat(np.array(widths)[grouped]),
        }
        for name, buffer in buffers.items():
            self.register_buffer(name, th.tensor(buffer), persistent=False)

    def vectors(self) -> list[th.Tensor]:
        """:return: for each group of choices the (choices, values, width) vectors"""
        return list(self.tables)

    def forward(self, k: th.Tensor) -> th.Tensor:
        """
        :param k: (..., L) values
        :return: (..., width) their vectors, with gradient
        """
        tables = self.vectors()
        groups = k[..., self.grouped].split([len(table) for table in tables], dim=-1)
        blocks = [table[th.arange(len(table), device=k.device), group] for table, group in zip(tables, groups, strict=True)]
        return th.cat([block.flatten(-2) for block in blocks], dim=-1)

    @th.no_grad()
    def nearest(self, points: th.Tensor, masks: th.Tensor | None = None) -> th.Tensor:
        """
        :param points: (B, width)
        :param masks: (B, sum of the radices) False for values that are passed over
        :return: (B, L) values whose vectors are nearest in Euclidean distance, block by block
        """
        tables = self.vectors()
        blocks = points.split([table[:, 0].numel() for table in tables], dim=1)
        # |p - v|^2 without |p|^2, which is the same for all values
        distances = [
            table.square().sum(dim=2) - 2 * th.einsum("bld,lrd->blr", block.unflatten(1, (len(table), -1)), table)
            for table, block in zip(tables, blocks, strict=True)
        ]
        if masks is not None:
            parts = masks[:, self.grouped_places].split([table[..., 0].numel() for table in tables], dim=1)
            distances = [
                part.masked_fill(~allowed.view(part.shape), th.inf) for part, allowed in zip(distances, parts, strict=True)
            ]
        return in_order([part.argmin(dim=2) for part in distances], self.radices)


def random_values(
    radices: tuple[int, ...], shape: tuple[int, ...], masks: th.Tensor | None = None, generator: th.Generator | None = None
) -> th.Tensor:
    """
    :param radices: numbers of values of L choices
    :param shape: how many actions; its first number is B if there are masks
    :param masks: (B, sum of the radices) False for values that may not be drawn
    :param generator: random generator on the CPU, the global one if None
    :return: (*shape, L) uniformly random values, on the device of the masks
    """
    device = "cpu" if masks is None else masks.device
    draws = th.rand(*shape, len(radices), generator=generator).to(device)
    if masks is None:
        counts = th.tensor(radices)
        # Rounding may lead to the count itself
        return (draws * counts).long().minimum(counts - 1)
    parts = []
    for choices, places in value_groups(radices):
        allowed = masks[:, th.tensor(places, device=device)]
        allowed = allowed.view(len(masks), *[1] * (len(shape) - 1), *places.shape)
        counts = allowed.sum(dim=-1)
        ranks = (draws[..., th.tensor(choices)] * counts).long().minimum(counts - 1)
        parts.append((allowed.cumsum(dim=-1) > ranks[..., None]).byte().argmax(dim=-1))
    return in_order(parts, radices)
