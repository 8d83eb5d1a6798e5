"""
What the parts of CHDP are good for: it without diffusion policies, without codebook, without sequential update.

Each is a subclass of CHDP, and of PaperCHDP, the algorithm as published. ``MlpPolicy`` only. In this folder:

    sb3-chdp benchmark --gym-packages ablations --algos chdp_paper chdp_paper_without_codebook --envs HardMove6-v0
"""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import create_mlp, get_actor_critic_arch
from torch import nn

from sb3_chdp.chdp import CHDP, PaperCHDP
from sb3_chdp.chdp.codebook import Codebook
from sb3_chdp.chdp.diffusion import DiffusionModel
from sb3_chdp.chdp.paper import PaperPolicy
from sb3_chdp.chdp.policies import CHDPPolicy
from sb3_chdp.common.hybrid_box import HybridBox
from sb3_chdp.common.samples import HybridReplaySamples
from sb3_chdp.common.spaces import HybridActionSpec
from sb3_chdp.registry import ALGORITHMS, Algorithm
from sb3_chdp.zoo import register

# Standard deviation of the Gaussian noise that deterministic policies explore with
EXPLORATION_NOISE = 0.1


class DeterministicModel(DiffusionModel):
    """
    A tanh MLP with the interface of :class:`DiffusionModel`.

    :param dim: width of the vector
    :param condition_dim: width of the condition
    :param net_arch: hidden layers
    :param activation_fn: activation function
    """

    def __init__(self, dim: int, condition_dim: int, net_arch: list[int], activation_fn: type[nn.Module]):
        nn.Module.__init__(self)
        self.dim, self.n_steps = dim, 1
        self.mlp = nn.Sequential(*create_mlp(condition_dim, dim, net_arch, activation_fn, squash_output=True))

    def sample(self, condition: th.Tensor, mask: th.Tensor | None = None, noise: th.Tensor | None = None) -> th.Tensor:
        """See :meth:`DiffusionModel.sample`; given noise asks for a repeatable sample, which is without exploration."""
        x = self.mlp(condition)
        if noise is None:
            x = (x + EXPLORATION_NOISE * th.randn_like(x)).clamp(-1, 1)
        return x if mask is None else x * mask

    def diffusion_loss(self, x_start: th.Tensor, condition: th.Tensor, mask: th.Tensor | None = None) -> th.Tensor:
        """:return: 0, there is nothing to denoise"""
        return th.zeros((), device=condition.device)


class OneHotCodebook(Codebook):
    """
    One-hot vectors, decoded by arg max.

    :param n_discrete_actions: number K of discrete actions, also the width
    """

    def __init__(self, n_discrete_actions: int):
        super().__init__(n_discrete_actions, n_discrete_actions)
        self.project()

    def quantize(self, latents: th.Tensor, masks: th.Tensor | None = None) -> th.Tensor:
        """:return: (B,) index of the largest entry, of those that (B, K) masks allow"""
        return (latents if masks is None else latents.masked_fill(~masks, -th.inf)).argmax(dim=1)

    def representative_latents(self, k: th.Tensor) -> th.Tensor:
        """:return: (B, K) vectors of 1 at k and -1 elsewhere"""
        return 2 * self.codewords.detach()[k] - 1

    def project(self) -> None:
        """Take back what a gradient step did to the vectors."""
        with th.no_grad():
            nn.init.eye_(self.codewords)


class DeterministicPolicies(CHDPPolicy):
    """MLPs in place of both diffusion models."""

    def _make_model(self, dim: int, condition_dim: int) -> DiffusionModel:
        return DeterministicModel(dim, condition_dim, get_actor_critic_arch(self.net_arch)[0], self.activation_fn)


class OneHotPolicy(CHDPPolicy):
    """One-hot vectors in place of the codebook."""

    def _make_codebook(self) -> Codebook:
        return OneHotCodebook(self.action_space.spec.n_discrete_actions)


class WithoutDiffusion(CHDP):
    """Deterministic policies with Gaussian exploration noise."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": DeterministicPolicies}


class WithoutCodebook(CHDP):
    """Latents of width K, decoded by arg max; the continuous policy is conditioned on a one-hot vector."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": OneHotPolicy}
    takes_factored = False


class WithoutSequentialUpdate(CHDP):
    """The continuous policy is improved for the stored actions, whatever the discrete policy does."""

    def _actions_to_improve(self, replay_data: HybridReplaySamples, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        latents, k = super()._actions_to_improve(replay_data, features)
        n = round(self.uniform_fraction * len(k))
        return th.cat([latents[:n], replay_data.latents[n:]]), th.cat([k[:n], replay_data.discrete_actions[n:]])


class WithoutBoth(WithoutCodebook, WithoutSequentialUpdate):
    """:class:`WithoutCodebook` and :class:`WithoutSequentialUpdate`."""


class PaperDeterministicPolicies(DeterministicPolicies, PaperPolicy):
    """:class:`DeterministicPolicies` of the published algorithm."""


class PaperOneHotPolicy(OneHotPolicy, PaperPolicy):
    """:class:`OneHotPolicy` of the published algorithm."""


class PaperWithoutDiffusion(WithoutDiffusion, PaperCHDP):
    """:class:`WithoutDiffusion` of the published algorithm."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": PaperDeterministicPolicies}


class PaperWithoutCodebook(WithoutCodebook, PaperCHDP):
    """:class:`WithoutCodebook` of the published algorithm."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": PaperOneHotPolicy}

    def _make_hybrid_space(self, action_layout: str) -> HybridBox:
        n_discrete_actions = HybridActionSpec(self.action_space, action_layout).n_discrete_actions
        return HybridBox(self.action_space, action_layout, n_discrete_actions, self._state_parts())


class PaperWithoutSequentialUpdate(WithoutSequentialUpdate, PaperCHDP):
    """:class:`WithoutSequentialUpdate` of the published algorithm."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = PaperCHDP.policy_aliases


class PaperWithoutBoth(WithoutBoth, PaperWithoutCodebook):
    """:class:`WithoutBoth` of the published algorithm."""


@dataclass(frozen=True)
class Ablation(Algorithm):
    """An algorithm with the hyperparameters of the one that it is a variant of."""

    @property
    def hyperparams(self) -> Path:
        return ALGORITHMS[self.name.split("_without_")[0]].hyperparams


def register_ablations(classes: dict[str, type[CHDP]]) -> None:
    """Put variants into the registry, so that command line and benchmark know them by these names."""
    for name, variant in classes.items():
        path = f"{variant.__module__}.{variant.__name__}"
        ALGORITHMS[name] = Ablation(name, name.replace("_", " "), path)
    register()


# By name; CHDP and PaperCHDP themselves have everything
ABLATIONS: dict[str, type[CHDP]] = {
    "chdp_without_diffusion": WithoutDiffusion,
    "chdp_without_codebook": WithoutCodebook,
    "chdp_without_sequential_update": WithoutSequentialUpdate,
    "chdp_without_both": WithoutBoth,
    "chdp_paper_without_diffusion": PaperWithoutDiffusion,
    "chdp_paper_without_codebook": PaperWithoutCodebook,
    "chdp_paper_without_sequential_update": PaperWithoutSequentialUpdate,
    "chdp_paper_without_both": PaperWithoutBoth,
}
register_ablations(ABLATIONS)
