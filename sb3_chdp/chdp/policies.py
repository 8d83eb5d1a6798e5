"""Networks of CHDP: a discrete and a continuous diffusion policy, their codebook, the twin critic and all targets."""

from copy import deepcopy
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor, get_actor_critic_arch
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_chdp.chdp.actor import CooperativeActor
from sb3_chdp.chdp.candidates import (
    FIXED_NOISE_CHAINS,
    REFINEMENT_SPREADS,
    policy_candidates,
    random_candidates,
    varied_candidates,
)
from sb3_chdp.chdp.codebook import Codebook
from sb3_chdp.chdp.critic import HybridCritic
from sb3_chdp.chdp.diffusion import DiffusionModel
from sb3_chdp.chdp.whitening import WhiteningExtractor
from sb3_chdp.common.hybrid_box import HybridBox
from sb3_chdp.common.policies import CnnFeatures, CombinedFeatures, HybridPolicy
from sb3_chdp.common.spaces import HybridActionSpec
from sb3_chdp.common.utils import default_optimizer_kwargs, hash_observations

# Spread of the latents around a codeword in random actions
RANDOM_LATENT_NOISE = 0.1


class CHDPPolicy(HybridPolicy):
    """
    Policy class (with both agents, their codebook and the critics) for CHDP.

    The arguments from ``latent_dim`` on are set by the arguments of the same name of :class:`CHDP`.

    :param observation_space: observation space
    :param action_space: space of the action rows, with ``latent_dim`` latent columns
    :param lr_schedule: learning rate schedule
    :param net_arch: hidden layers, one list for all networks or ``dict(pi=..., qf=...)`` for the noise predictors and
        the critics; by default ``dict(pi=[128, 128], qf=[256, 256])``
    :param activation_fn: activation function
    :param features_extractor_class: features extractor to use
    :param features_extractor_kwargs: its keyword arguments
    :param normalize_images: whether to divide images by 255
    :param optimizer_class: optimizer of all networks
    :param optimizer_kwargs: its keyword arguments, without the learning rate; ``fused=True`` for Adam if None
    :param share_features_extractor: whether both agents use the critic's features extractor, which then learns from the
        critic's loss alone; otherwise they have their own, which learns from the loss of the discrete policy
    :param whitening: whether all networks see flat observations whitened as well, see :class:`WhiteningExtractor`
    :param layer_norm: whether the critics have layer normalisation, see :class:`HybridCritic`; it steadies and speeds up
        learning with few discrete actions, and slows it down with many
    :param parameter_degree: highest degree of the Chebyshev polynomials of the parameters that the critics see (1: the
        parameters as they are), see :func:`chebyshev_features`
    :param bilinear: whether the critics see the products of latent and parameters as well, see :class:`HybridCritic`
    :param n_diffusion_steps: number N of denoising steps
    :param n_action_candidates: number of actions drawn per observation, of which the one with the highest min(Q1, Q2) of
        the target critics acts
    :param n_random_candidates: number of uniformly random actions that compete with these
    :param n_refinement_candidates: number of variations of the best of all these whose values are compared with its own, in
        each of two rounds with standard deviations of 0.1 and 0.03 of the scaled parameters; in deterministic predictions only
    :param uniform_fraction: share of the drawn candidates whose discrete action is uniformly random
    :raises ValueError: if ``whitening`` comes with another features extractor than :class:`FlattenExtractor`
    """

    fixed_latent_noise: th.Tensor
    fixed_parameter_noise: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: HybridBox,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.SiLU,
        features_extractor_class: type[BaseFeaturesExtractor] = FlattenExtractor,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        share_features_extractor: bool = False,
        whitening: bool = False,
        layer_norm: bool = False,
        parameter_degree: int = 1,
        bilinear: bool = False,
        n_diffusion_steps: int = 15,
        n_action_candidates: int = 16,
        n_random_candidates: int = 0,
        n_refinement_candidates: int = 0,
        uniform_fraction: float = 0.25,
    ):
        if optimizer_kwargs is None:
            optimizer_kwargs = default_optimizer_kwargs(optimizer_class)
        if whitening and features_extractor_class is not FlattenExtractor:
            raise ValueError(
                "whitening=True is for flat observations, with features_extractor_class=FlattenExtractor, "
                f"got {features_extractor_class.__name__}"
            )
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class,
            features_extractor_kwargs,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            normalize_images=normalize_images,
            squash_output=True,
        )
        self.net_arch = {"pi": [128, 128], "qf": [256, 256]} if net_arch is None else net_arch
        self.activation_fn = activation_fn
        self.share_features_extractor = share_features_extractor
        self.whitening = whitening
        self.layer_norm = layer_norm
        self.parameter_degree = parameter_degree
        self.bilinear = bilinear
        self.n_diffusion_steps = n_diffusion_steps
        self.n_action_candidates = n_action_candidates
        self.n_random_candidates = n_random_candidates
        self.n_refinement_candidates = n_refinement_candidates
        self.uniform_fraction = uniform_fraction
        self._build(lr_schedule)

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        if self.whitening:
            return WhiteningExtractor(self.observation_space, **self.features_extractor_kwargs)
        return super().make_features_extractor()

    def _build(self, lr_schedule: Schedule) -> None:
        spec: HybridActionSpec = self.action_space.spec
        latent_dim = self.action_space.latent_dim
        actor_arch, critic_arch = get_actor_critic_arch(self.net_arch)

        critic_extractor = self.make_features_extractor()
        features_dim = critic_extractor.features_dim
        self.critic = HybridCritic(
            self.observation_space,
            latent_dim,
            spec.max_parameters,
            critic_arch,
            critic_extractor,
            features_dim,
            self.activation_fn,
            self.normalize_images,
            self.layer_norm,
            self.parameter_degree,
            self.bilinear,
        )
        codebook = self._make_codebook(spec.n_discrete_actions, latent_dim)
        self.actor = CooperativeActor(
            self.observation_space,
            self.action_space,
            critic_extractor if self.share_features_extractor else self.make_features_extractor(),
            codebook,
            self._make_model(latent_dim, features_dim, actor_arch),
            self._make_model(spec.max_parameters, features_dim + latent_dim, actor_arch),
            self.normalize_images,
        )
        # Copied together: a shared features extractor stays shared among the targets
        self.actor_target, self.critic_target = deepcopy((self.actor, self.critic))
        for target in (self.actor_target, self.critic_target):
            target.requires_grad_(False)
            target.set_training_mode(False)

        discrete_parameters = list(self.actor.discrete_policy.parameters())
        if not self.share_features_extractor:
            discrete_parameters += list(self.actor.features_extractor.parameters())
        self.discrete_optimizer = self._make_optimizer(discrete_parameters, lr_schedule)
        self.continuous_optimizer = self._make_optimizer(list(self.actor.continuous_policy.parameters()), lr_schedule)
        self.critic.optimizer = self._make_optimizer(list(self.critic.parameters()), lr_schedule)
        self.codebook_optimizer = self._make_optimizer(list(codebook.parameters()), lr_schedule)

        # Noise of deterministic predictions, the same for every model
        generator = th.Generator().manual_seed(0)
        for name, model in (("latent", self.actor.discrete_policy), ("parameter", self.actor.continuous_policy)):
            noise = th.randn((model.n_steps, FIXED_NOISE_CHAINS, model.dim), generator=generator)
            self.register_buffer(f"fixed_{name}_noise", noise, persistent=False)

    def _make_codebook(self, n_discrete_actions: int, latent_dim: int) -> Codebook:
        return Codebook(n_discrete_actions, latent_dim)

    def _make_model(self, dim: int, condition_dim: int, net_arch: list[int]) -> DiffusionModel:
        return DiffusionModel(dim, condition_dim, self.n_diffusion_steps, net_arch, self.activation_fn)

    def _make_optimizer(self, parameters: list[nn.Parameter], lr_schedule: Schedule) -> th.optim.Optimizer:
        return self.optimizer_class(parameters, lr=lr_schedule(1), **self.optimizer_kwargs)  # type: ignore[call-arg]

    def actor_features(self, obs: PyTorchObs) -> th.Tensor:
        """:return: (B, features_dim) features of both agents, without gradient if the critic owns the extractor"""
        features = self.actor.features(obs)
        return features.detach() if self.share_features_extractor else features

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._predict(obs, deterministic)

    def best_candidate(
        self,
        actor: CooperativeActor,
        features: th.Tensor,
        critic_features: th.Tensor,
        n_candidates: int,
        n_random: int = 0,
        n_refinement: int = 0,
        hashes: th.Tensor | None = None,
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor]:
        """
        Draw actions and keep the one of highest min(Q1, Q2) of the target critics.

        :param actor: the policies
        :param features: (B, features_dim) features for the policies
        :param critic_features: (B, features_dim) features for the target critics
        :param n_candidates: number of actions that the policies draw per row, see :func:`policy_candidates`
        :param n_random: number of uniformly random actions per row that compete with those
        :param n_refinement: number of variations of the best one that compete with it, in each of two rounds
        :param hashes: (B,) numbers that decide all that is random; None: draw
        :return: latents (B, latent_dim), discrete actions (B,), parameters (B, Pmax) and their min(Q1, Q2) (B, 1)
        """
        noise = (self.fixed_latent_noise, self.fixed_parameter_noise)
        candidates = policy_candidates(actor, features, n_candidates, self.uniform_fraction, hashes, noise)
        if n_random > 0:
            candidates = candidates.join(random_candidates(actor, len(features), n_random, repeatable=hashes is not None))
        best = candidates.best(self.critic_target, critic_features)
        for spread in REFINEMENT_SPREADS if n_refinement > 0 else ():
            candidates = varied_candidates(actor, *best[:3], n_refinement, spread)
            best = candidates.best(self.critic_target, critic_features)
        return best

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """
        Draw ``n_action_candidates`` actions per observation and keep the one of highest target min(Q1, Q2), or one of
        ``n_random_candidates`` uniformly random actions if its value is higher.

        Deterministic predictions take their noise from a fixed store, at a place that depends on the observation: one and
        the same noise in all states would repeat a policy's mistakes where sampling gets away from them. They use the
        target policies, averages of the policies over the last updates, which do not waver as those do, and refine what
        they chose, see ``n_refinement_candidates``; in rollouts that did no good on Hard Goal.

        :return: (B, 1 + Pmax + latent_dim) rows
        """
        actor = self.actor_target if deterministic else self.actor
        features, critic_features = actor.features(observation), self.critic_target.features(observation)
        hashes = hash_observations(observation) if deterministic else None
        latents, k, parameters, _ = self.best_candidate(
            actor,
            features,
            critic_features,
            self.n_action_candidates,
            self.n_random_candidates,
            self.n_refinement_candidates if deterministic else 0,
            hashes,
        )
        return self.action_space.columns.pack(discrete_actions=k.float(), parameters=parameters, latents=latents)

    def random_rows(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """Uniformly random actions; their latents scatter around the codewords and decode to the actions."""
        rows, columns = super().random_rows(rng, n), self.action_space.columns
        k = th.as_tensor(columns.discrete_actions(rows), device=self.device)
        codebook = self.actor.codebook
        centres = codebook.representative_latents(k)
        latents = centres.clone()
        undecided = th.arange(n, device=self.device)
        spread = RANDOM_LATENT_NOISE
        for _ in range(5):
            noise = th.as_tensor(rng.normal(0, spread, (len(undecided), centres.shape[1])), dtype=th.float32)
            candidates = (centres[undecided] + noise.to(self.device)).clamp(-1, 1)
            fits = codebook.quantize(candidates) == k[undecided]
            latents[undecided[fits]] = candidates[fits]
            undecided = undecided[~fits]
            if len(undecided) == 0:
                break
            spread /= 2
        columns.view(rows, "latents")[:] = latents.cpu().numpy()
        return rows

    def set_training_mode(self, mode: bool) -> None:
        """
        Put the online networks in either training or evaluation mode; the targets stay in evaluation mode.

        :param mode: if true, set to training mode, else set to evaluation mode
        """
        self.actor.set_training_mode(mode)
        self.critic.set_training_mode(mode)
        self.training = mode

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            dict(
                net_arch=self.net_arch,
                activation_fn=self.activation_fn,
                features_extractor_class=self.features_extractor_class,
                features_extractor_kwargs=self.features_extractor_kwargs,
                optimizer_class=self.optimizer_class,
                optimizer_kwargs=self.optimizer_kwargs,
                share_features_extractor=self.share_features_extractor,
                whitening=self.whitening,
                layer_norm=self.layer_norm,
                parameter_degree=self.parameter_degree,
                bilinear=self.bilinear,
                n_diffusion_steps=self.n_diffusion_steps,
                n_action_candidates=self.n_action_candidates,
                n_random_candidates=self.n_random_candidates,
                n_refinement_candidates=self.n_refinement_candidates,
                uniform_fraction=self.uniform_fraction,
                lr_schedule=self._dummy_schedule,  # dummy lr schedule, not needed for loading policy alone
            )
        )
        return data


MlpPolicy = CHDPPolicy


class CnnPolicy(CnnFeatures, CHDPPolicy):
    """:class:`CHDPPolicy` for images."""


class MultiInputPolicy(CombinedFeatures, CHDPPolicy):
    """:class:`CHDPPolicy` for dict observations."""
