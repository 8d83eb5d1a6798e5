"""Quantisation of a latent to several discrete choices at once, block by block."""

import torch as th

from sb3_chdp.common.product_table import ProductTable


class ProductCodebook(ProductTable):
    """
    A :class:`Codebook` for factored discrete actions: one sub-codebook per choice, the latent is the concatenation of their
    codewords. Discrete actions are (B, L).

    :param radices: numbers of values of the L choices
    :param block_dim: width of the codewords of a choice at most, see :func:`block_widths`
    """

    def __init__(self, radices: tuple[int, ...], block_dim: int):
        super().__init__(radices, block_dim)
        #: width d_e of a latent
        self.latent_dim = self.width

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

    def project(self) -> None:
        """Move the codewords back into [-1, 1], where the latents are, after a gradient step."""
        with th.no_grad():
            self.vectors.clamp_(-1, 1)


def choice_usage(k: th.Tensor, radices: tuple[int, ...]) -> tuple[float, float]:
    """
    How many values of its choices a batch uses.

    :param k: (B, L) discrete actions
    :param radices: numbers of values of the choices
    :return: means over the choices: share of the values that occur, and perplexity of their frequencies
    """
    values = th.arange(max(radices), device=k.device)
    frequencies = (k[:, :, None] == values).float().mean(dim=0)
    usage = (frequencies > 0).sum(dim=1) / th.tensor(radices, device=k.device)
    perplexity = (-(th.special.xlogy(frequencies, frequencies)).sum(dim=1)).exp()
    return usage.mean().item(), perplexity.mean().item()
