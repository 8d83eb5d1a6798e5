"""The two cooperating policies of CHDP with the codebook between them."""

import torch as th
from torch import nn

from sb3_chdp.chdp.codebook import Codebook
from sb3_chdp.chdp.critic import AttentionReads
from sb3_chdp.chdp.diffusion import DiffusionModel
from sb3_chdp.chdp.product_codebook import ProductCodebook
from sb3_chdp.common.hybrid_box import HybridBox


class CooperativeActor(nn.Module):
    """
    The two agents of the cooperative game.

    The discrete policy draws a latent e, the codebook decodes it to k and e_k, and the continuous policy, conditioned on
    the state and e_k, draws the parameters. In a factored space k is (B, L) where (B,) is said, and masks are (B, sum of the
    radices).

    :param action_space: space of the action rows
    :param features_dim: number of features of the state that the policies see; what stands behind them is for the critics
    :param codebook: quantises the latents
    :param discrete_policy: model of the latents given the features
    :param continuous_policy: model of the parameters given :meth:`condition`
    :param reads: what else the continuous policy sees of the features, as the critics do; None: nothing
    """

    parameter_mask: th.Tensor

    def __init__(
        self,
        action_space: HybridBox,
        features_dim: int,
        codebook: Codebook | ProductCodebook,
        discrete_policy: DiffusionModel,
        continuous_policy: DiffusionModel,
        reads: AttentionReads | None = None,
    ):
        super().__init__()
        self.features_dim = features_dim
        self.codebook = codebook
        self.discrete_policy = discrete_policy
        self.continuous_policy = continuous_policy
        self.reads = reads
        mask = action_space.spec.parameter_mask
        self._has_padding = not bool(mask.all())
        # Not needed when no action has padding, and then not kept: K may be 65,536
        self.register_buffer(
            "parameter_mask", th.tensor(mask if self._has_padding else mask[:1], dtype=th.float32), persistent=False
        )

    @property
    def device(self) -> th.device:
        """Where the networks are"""
        return self.parameter_mask.device

    def padding_mask(self, k: th.Tensor) -> th.Tensor | None:
        """:return: (B, Pmax) 1 for the parameters that action k has, None if no action has padding"""
        return self.parameter_mask[k] if self._has_padding else None

    def draw_latents(
        self, features: th.Tensor, noise: th.Tensor | None = None, masks: th.Tensor | None = None
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        :param features: (B, features_dim)
        :param noise: noise of the discrete policy's chain, drawn if None
        :param masks: (B, K) False for discrete actions that may not be taken, None if all may
        :return: latents (B, latent_dim) as the discrete policy draws them, and the discrete actions (B,) that they decode to
        """
        latents = self.discrete_policy.sample(features[:, : self.features_dim], noise=noise)
        return latents, self.codebook.quantize(latents, masks)

    def sample_latents(
        self, features: th.Tensor, noise: th.Tensor | None = None, masks: th.Tensor | None = None
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        See :meth:`draw_latents`.

        :return: latents (B, latent_dim) that critics see, codewords, so that they see one latent for one action, and the
            discrete actions (B,)
        """
        _, k = self.draw_latents(features, noise, masks)
        return self.codebook.representative_latents(k), k

    def latent_loss(self, latents: th.Tensor, features: th.Tensor) -> th.Tensor:
        """:return: diffusion loss of the discrete policy"""
        return self.discrete_policy.diffusion_loss(latents, features[:, : self.features_dim])

    def condition(self, features: th.Tensor, codewords: th.Tensor) -> th.Tensor:
        """
        :param features: (B, features_dim)
        :param codewords: (B, latent_dim)
        :return: (B, condition_dim) what the continuous policy is conditioned on
        """
        features = features[:, : self.features_dim]
        reads = [] if self.reads is None else [self.reads(features, codewords)]
        return th.cat([features, codewords, *reads], dim=1)

    def sample_parameters(self, features: th.Tensor, k: th.Tensor, noise: th.Tensor | None = None) -> th.Tensor:
        """
        :param features: (B, features_dim)
        :param k: (B,) discrete actions
        :param noise: noise of the continuous policy's chain, drawn if None
        :return: (B, Pmax) parameters in [-1, 1], padding 0; their gradient reaches the codewords of k
        """
        condition = self.condition(features, self.codebook(k))
        return self.continuous_policy.sample(condition, self.padding_mask(k), noise)

    def random_actions(
        self, *shape: int, generator: th.Generator | None = None, masks: th.Tensor | None = None
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        Uniformly random actions.

        :param shape: how many actions; its first number is B if there are masks
        :param generator: random generator on the CPU, the global one of the model's device if None
        :param masks: (B, K) False for discrete actions that may not be drawn, None if all may
        :return: codewords as latents (*shape, latent_dim), discrete actions (*shape), parameters (*shape, Pmax), padding 0
        """
        device = self.device if generator is None else "cpu"
        k = self.codebook.random(*shape, generator=generator, masks=masks)
        parameters = 2 * th.rand(*shape, self.continuous_policy.dim, generator=generator, device=device).to(self.device) - 1
        mask = self.padding_mask(k)
        return self.codebook.representative_latents(k), k, parameters if mask is None else parameters * mask
