"""Tables of vectors for actions that are made of several choices: a block of the vector for each (product quantisation)."""

import torch as th
from torch import nn

from sb3_chdp.common.rows import value_table


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
    A learnable vector for every value of L choices, initialised U(-1, 1). The vector of an action is their concatenation.

    Source: Jégou et al. (2011), "Product Quantization for Nearest Neighbor Search". The cost grows with the sum of the
    radices, the number of actions with their product.

    :param radices: numbers of values of the choices
    :param width: width of a block at most, see :func:`block_widths`
    """

    exists: th.Tensor
    places: th.Tensor
    slots: th.Tensor
    choice_of_slot: th.Tensor

    def __init__(self, radices: tuple[int, ...], width: int):
        super().__init__()
        self.radices = tuple(radices)
        widths = th.tensor(block_widths(self.radices, width))
        #: width of the vector of an action
        self.width = int(widths.sum())
        places, exists = value_table(self.radices)
        is_slot = th.arange(int(widths.max())) < widths[:, None]
        table = th.empty(*exists.shape, is_slot.shape[1]).uniform_(-1, 1)
        # Blocks are filled up with zeros to the width of the widest one
        self.vectors = nn.Parameter(table * is_slot[:, None])
        self.register_buffer("exists", th.tensor(exists), persistent=False)
        self.register_buffer("places", th.tensor(places), persistent=False)
        self.register_buffer("slots", th.nonzero(is_slot.flatten()).squeeze(1), persistent=False)
        self.register_buffer("choice_of_slot", th.nonzero(is_slot)[:, 0], persistent=False)

    def forward(self, k: th.Tensor, vectors: th.Tensor | None = None) -> th.Tensor:
        """
        :param k: (..., L) values
        :param vectors: a function of ``self.vectors`` that leaves 0 at 0, in their place
        :return: (..., width) their vectors, with gradient
        """
        vectors = self.vectors if vectors is None else vectors
        return vectors[th.arange(len(vectors), device=k.device), k].flatten(-2)[..., self.slots]

    @th.no_grad()
    def nearest(self, points: th.Tensor, masks: th.Tensor | None = None, vectors: th.Tensor | None = None) -> th.Tensor:
        """
        :param points: (B, width)
        :param masks: (B, sum of the radices) False for values that are passed over
        :param vectors: as for :meth:`forward`
        :return: (B, L) values whose vectors are nearest in Euclidean distance, block by block
        """
        vectors = self.vectors if vectors is None else vectors
        n_choices, _, block_width = vectors.shape
        blocks = points.new_zeros(points.shape[0], n_choices * block_width)
        blocks[:, self.slots] = points
        # |p - v|^2 without |p|^2, which is the same for all values
        distances = vectors.square().sum(dim=2) - 2 * th.einsum(
            "bld,lrd->blr", blocks.view(-1, n_choices, block_width), vectors
        )
        allowed = self.exists if masks is None else self.exists & masks[:, self.places]
        return distances.masked_fill(~allowed, th.inf).argmin(dim=2)


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
    table, exists = value_table(radices)
    allowed = masks[:, th.tensor(table, device=device)] & th.tensor(exists, device=device)
    allowed = allowed.view(len(masks), *[1] * (len(shape) - 1), *table.shape)
    counts = allowed.sum(dim=-1)
    ranks = (draws * counts).long().minimum(counts - 1)
    return (allowed.cumsum(dim=-1) > ranks[..., None]).byte().argmax(dim=-1)
