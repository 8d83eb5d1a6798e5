"""Quantisation of a latent to several discrete choices at once, block by block."""

import torch as th

from sb3_chdp.common.product_table import ProductTable, random_values


class ProductCodebook(ProductTable):
    """
    A :class:`Codebook` for factored discrete actions: one sub-codebook per choice, the latent is the concatenation of their
    codewords. Discrete actions are (B, L).

    :param radices: numbers of values of the L choices
    :param block_dim: width of the codewords of a choice at most, see :func:`block_widths`
    """

    values: th.Tensor

    def __init__(self, radices: tuple[int, ...], block_dim: int):
        super().__init__(radices, block_dim)
        #: width d_e of a latent
        self.latent_dim = self.width
        # (M, 2) choice and value, in the order of the masks
        values = [(choice, value) for choice, radix in enumerate(self.radices) for value in range(radix)]
        self.register_buffer("values", th.tensor(values), persistent=False)

    def latent_widths(self) -> th.Tensor:
        """:return: (d_e,) how wide the codeword is that an entry of the latent belongs to"""
        return self.choice_of_column.bincount()[self.choice_of_column]

    def quantize(self, latents: th.Tensor, masks: th.Tensor | None = None) -> th.Tensor:
        """
        :param latents: (B, d_e)
        :param masks: (B, sum of the radices) False for values that may not be taken
        :return: (B, L) values of the nearest codewords
        """
        return self.nearest(latents, masks)

    def representative_latents(self, k: th.Tensor) -> th.Tensor:
        """:return: (..., d_e) latents that stand for the (..., L) discrete actions, their codewords"""
        return self(k).detach()

    def random(self, *shape: int, generator: th.Generator | None = None, masks: th.Tensor | None = None) -> th.Tensor:
        """
        :param shape: how many actions; its first number is B if there are masks
        :param generator: random generator on the CPU, the global one if None
        :param masks: (B, sum of the radices) False for values that may not be drawn
        :return: (*shape, L) uniformly random discrete actions
        """
        return random_values(self.radices, shape, masks, generator).to(self.offsets.device)

    def alternatives(self, k: th.Tensor, n: int, repeatable: bool) -> th.Tensor:
        """
        Other discrete actions to try, which differ from the given ones in one choice at most.

        :param k: (B, L) discrete actions
        :param n: number of alternatives to each, at most the sum of the radices
        :param repeatable: whether to give the same choices the same values always
        :return: (B, n, L) the actions with one value changed: successive values of all choices from a random one on; if
            ``repeatable``, evenly spread ones
        """
        n_values, places = len(self.values), th.arange(n, device=k.device)
        if repeatable:
            places = places * n_values // n
        else:
            places = (th.randint(n_values, (len(k), 1), device=k.device) + places) % n_values
        changes = self.values[places].expand(k.shape[0], n, 2)
        return k[:, None].repeat(1, n, 1).scatter(2, changes[..., :1], changes[..., 1:])

    def allowed(self, k: th.Tensor, masks: th.Tensor) -> th.Tensor:
        """
        :param k: (B, n, L) discrete actions
        :param masks: (B, sum of the radices) False for values that may not be taken
        :return: (B, n) which of the discrete actions may be taken
        """
        return masks.gather(1, (self.offsets + k).flatten(1)).view(k.shape).all(dim=2)

    def usage(self, k: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        How many values of its choices a batch uses.

        :param k: (B, L) discrete actions
        :return: (L,) share of the values that occur, and (L,) perplexity of their frequencies
        """
        choices = self.values[:, 0]
        frequencies = th.bincount((self.offsets + k).flatten(), minlength=len(choices)) / len(k)
        summands = th.stack([(frequencies > 0).float(), th.special.xlogy(frequencies, frequencies)])
        sums = summands.new_zeros(2, len(self.radices)).index_add(1, choices, summands)
        return sums[0] / choices.bincount(), (-sums[1]).exp()

    def project(self) -> None:
        """Move the codewords back into [-1, 1], where the latents are, after a gradient step."""
        with th.no_grad():
            for table in self.tables:
                table.clamp_(-1, 1)
