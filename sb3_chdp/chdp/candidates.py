"""Candidates: several actions per observation, of which the critics choose one."""

import math
from typing import NamedTuple

import torch as th

from sb3_chdp.chdp.actor import CooperativeActor
from sb3_chdp.chdp.critic import HybridCritic

# Number of noise chains that repeatable candidates choose from
FIXED_NOISE_CHAINS = 1024
# Standard deviations of the changes of the parameters in successive refinements
REFINEMENT_SPREADS = (0.1, 0.03)


class Candidates(NamedTuple):
    """
    n hybrid actions for each of B observations.

    :ivar latents: (B, n, latent_dim)
    :ivar discrete_actions: (B, n)
    :ivar parameters: (B, n, Pmax), padding 0
    """

    latents: th.Tensor
    discrete_actions: th.Tensor
    parameters: th.Tensor

    def join(self, others: "Candidates") -> "Candidates":
        """:return: these and the others, which may be the same for all observations (B = 1)"""
        batch_size = len(self.latents)
        return Candidates(*(th.cat([a, b.expand(batch_size, *b.shape[1:])], dim=1) for a, b in zip(self, others, strict=True)))

    def best(self, critic: HybridCritic, features: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor]:
        """
        :param critic: twin critic
        :param features: (B, features_dim) its features of the observations
        :return: latents (B, latent_dim), discrete actions (B,), parameters (B, Pmax) and min(Q1, Q2) (B, 1) of the candidates
            for which the latter is highest
        """
        batch_size, n = self.discrete_actions.shape
        latents, k, parameters = (part.flatten(0, 1) for part in self)
        q_values = th.min(*critic.q_values(features.repeat_interleave(n, dim=0), latents, parameters))
        best = q_values.view(batch_size, n).argmax(dim=1) + th.arange(batch_size, device=features.device) * n
        return latents[best], k[best], parameters[best], q_values[best]


def policy_candidates(
    actor: CooperativeActor,
    features: th.Tensor,
    n: int,
    uniform_fraction: float,
    hashes: th.Tensor | None = None,
    fixed_noise: tuple[th.Tensor, th.Tensor] | None = None,
) -> Candidates:
    """
    Actions that the policies draw.

    :param actor: the policies
    :param features: (B, features_dim) their features of the observations
    :param n: number of actions per observation
    :param uniform_fraction: share of them, rounded up, but never all, with successive discrete actions from a random one on
        instead: all discrete actions if there are no more
    :param hashes: (B,) numbers that decide everything random, taken from ``fixed_noise``; None: draw
    :param fixed_noise: ``FIXED_NOISE_CHAINS`` noises for the chains of latents and parameters
    """
    batch_size, device = features.shape[0], features.device
    n_uniform = min(math.ceil(uniform_fraction * n), n - 1)
    latent_noise = parameter_noise = None
    if hashes is not None and fixed_noise is not None:
        chains = (hashes[:, None] + th.arange(n, device=device)) % FIXED_NOISE_CHAINS
        latent_noise = fixed_noise[0][..., chains[:, n_uniform:].flatten(), :]
        parameter_noise = fixed_noise[1][..., chains.flatten(), :]
    latents, k = actor.sample_latents(features.repeat_interleave(n - n_uniform, dim=0), latent_noise)
    latents, k = latents.view(batch_size, n - n_uniform, -1), k.view(batch_size, -1)
    if n_uniform > 0:
        if hashes is None:
            hashes = th.randint(2**31, (batch_size,), device=device)
        uniform_k = (hashes[:, None] + th.arange(n_uniform, device=device)) % actor.codebook.n_discrete_actions
        latents = th.cat([actor.codebook.representative_latents(uniform_k), latents], dim=1)
        k = th.cat([uniform_k, k], dim=1)
    parameters = actor.sample_parameters(features.repeat_interleave(n, dim=0), k.flatten(), parameter_noise)
    return Candidates(latents, k, parameters.view(batch_size, n, -1))


def random_candidates(actor: CooperativeActor, batch_size: int, n: int, repeatable: bool) -> Candidates:
    """
    Uniformly random actions.

    :param actor: the policies, whose codewords are the latents
    :param batch_size: number B of observations
    :param n: number of actions per observation
    :param repeatable: whether to return the same actions always, for all observations (B = 1)
    """
    if repeatable:
        return Candidates(*actor.random_actions(1, n, generator=th.Generator().manual_seed(0)))
    return Candidates(*actor.random_actions(batch_size, n))


def varied_candidates(
    actor: CooperativeActor, latents: th.Tensor, k: th.Tensor, parameters: th.Tensor, n: int, spread: float
) -> Candidates:
    """
    Actions and n Gaussian variations of the parameters of each, always the same ones.

    :param actor: the policies
    :param latents: (B, latent_dim)
    :param k: (B,) discrete actions
    :param parameters: (B, Pmax)
    :param n: number of variations per action
    :param spread: their standard deviation
    :return: candidates of B observations, the given action first, n + 1 in all
    """
    noise = th.randn(1, n, parameters.shape[1], generator=th.Generator().manual_seed(0)).to(parameters.device)
    mask = actor.mask(k)
    varied = (parameters[:, None] + spread * (noise if mask is None else noise * mask[:, None])).clamp(-1, 1)
    return Candidates(
        latents[:, None].expand(-1, n + 1, -1), k[:, None].expand(-1, n + 1), th.cat([parameters[:, None], varied], dim=1)
    )
