"""Vector quantisation of the discrete policy's latent into a discrete action."""

import torch as th
from torch import nn

from sb3_chdp.common.product_table import random_values
from sb3_chdp.common.utils import nearest_row


class Codebook(nn.Module):
    """
    Learnable codewords, one per discrete action (the paper's E_zeta), initialised U(-1, 1).

    :param n_discrete_actions: number K of codewords
    :param latent_dim: width d_e of a codeword
    """

    def __init__(self, n_discrete_actions: int, latent_dim: int):
        super().__init__()
        self.n_discrete_actions, self.latent_dim = n_discrete_actions, latent_dim
        self.codewords = nn.Parameter(th.empty(n_discrete_actions, latent_dim).uniform_(-1, 1))

    def latent_widths(self) -> th.Tensor:
        """:return: (d_e,) how wide the codeword is that an entry of the latent belongs to"""
        return th.full((self.latent_dim,), self.latent_dim)

    def quantize(self, latents: th.Tensor, masks: th.Tensor | None = None) -> th.Tensor:
        """
        :param latents: (B, d_e)
        :param masks: (B, K) False for discrete actions that may not be taken, None if all may
        :return: (B,) index of the nearest codeword, eq. 12, k = argmin_j |e - e_j|^2
        """
        return nearest_row(latents, self.codewords, masks)

    def forward(self, k: th.Tensor) -> th.Tensor:
        """
        :param k: (B,) discrete actions
        :return: (B, d_e) their codewords e_k, with gradient
        """
        return self.codewords[k]

    def representative_latents(self, k: th.Tensor) -> th.Tensor:
        """:return: (B, d_e) latents that stand for the discrete actions, their codewords"""
        return self.codewords.detach()[k]

    def random(self, *shape: int, generator: th.Generator | None = None, masks: th.Tensor | None = None) -> th.Tensor:
        """
        :param shape: how many actions; its first number is B if there are masks
        :param generator: random generator on the CPU, the global one of the codebook's device if None
        :param masks: (B, K) False for discrete actions that may not be drawn
        :return: (*shape) uniformly random discrete actions
        """
        if masks is not None:
            return random_values((self.n_discrete_actions,), shape, masks, generator)[..., 0]
        device = self.codewords.device
        where = device if generator is None else "cpu"
        return th.randint(self.n_discrete_actions, shape, generator=generator, device=where).to(device)

    def alternatives(self, k: th.Tensor, n: int, repeatable: bool) -> th.Tensor:
        """
        Discrete actions to try beside others.

        :param k: (B,) the others, which are not left out
        :param n: number of alternatives to each; beyond K they repeat
        :param repeatable: whether to return the same ones always
        :return: (B, n) successive discrete actions from a random one on; if ``repeatable``, evenly spread ones
        """
        places = th.arange(n, device=k.device)
        if repeatable:
            return (places * self.n_discrete_actions // n).expand(k.shape[0], n)
        return (th.randint(self.n_discrete_actions, (len(k), 1), device=k.device) + places) % self.n_discrete_actions

    def allowed(self, k: th.Tensor, masks: th.Tensor) -> th.Tensor:
        """
        :param k: (B, n) discrete actions
        :param masks: (B, K) False for discrete actions that may not be taken
        :return: (B, n) which of the discrete actions may be taken
        """
        return masks.gather(1, k)

    def usage(self, k: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        How many actions a batch uses.

        :param k: (B,) discrete actions
        :return: (1,) share of the K actions that occur, and (1,) perplexity of their frequencies: as many, if they were
            equally frequent
        """
        frequencies = th.unique(k, return_counts=True)[1] / len(k)
        perplexity = (-(frequencies * frequencies.log()).sum()).exp()
        return perplexity.new_full((1,), len(frequencies) / self.n_discrete_actions), perplexity[None]

    def project(self) -> None:
        """Move the codewords back into [-1, 1], where the latents are, after a gradient step."""
        with th.no_grad():
            self.codewords.clamp_(-1, 1)
