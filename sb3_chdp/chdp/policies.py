"""Networks of CHDP: a discrete and a continuous diffusion policy, their codebook, the critics and all targets."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, get_actor_critic_arch
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_chdp.chdp.actor import CooperativeActor
from sb3_chdp.chdp.candidates import FixedDraws, Selection
from sb3_chdp.chdp.codebook import Codebook
from sb3_chdp.chdp.critic import AttentionReads, HybridCritic, QNetwork, ReturnNetwork
from sb3_chdp.chdp.diffusion import DiffusionModel
from sb3_chdp.chdp.product_codebook import ProductCodebook
from sb3_chdp.chdp.repeatable_noise import repeatable_noise
from sb3_chdp.chdp.value_scale import ValueScale
from sb3_chdp.common.encoding import RunningRanges
from sb3_chdp.common.hybrid_box import HybridBox
from sb3_chdp.common.normalization import NormalizedCombinedExtractor, NormalizedExtractor
from sb3_chdp.common.policies import CnnFeatures, HybridPolicy
from sb3_chdp.common.spaces import HybridActionSpec
from sb3_chdp.common.utils import default_optimizer_kwargs

# Discrete actions that compete beside those drawn, all of them if there are no more; in a factored space changes of one choice
MAX_ALTERNATIVES = 64
# Uniformly random actions that compete
N_RANDOM_CANDIDATES = 64
# Variations towards which deterministic predictions move the best action's parameters
N_REFINEMENT_CANDIDATES = 16
# Actions of which the best is the next one in targets, as the best of several acts, too. Fewer discrete actions all compete,
# of more only two beside those drawn: rarely taken ones may win by errors of their values
N_NEXT_ACTIONS = 4


class CHDPPolicy(HybridPolicy):
    """
    Policy class (with both agents, their codebook and the critics) for CHDP.

    All networks see the features of one extractor, which learns from the critics' loss.

    :param observation_space: observation space
    :param action_space: space of the action rows
    :param lr_schedule: learning rate schedule
    :param net_arch: hidden layers, one list for all networks or ``dict(pi=..., qf=...)`` for the noise predictors and
        the critics, that of the reward included; by default ``dict(pi=[128, 128], qf=[256, 256])``
    :param activation_fn: activation function
    :param features_extractor_class: features extractor to use; the default normalises observations
    :param features_extractor_kwargs: its keyword arguments
    :param normalize_images: whether to divide images by 255
    :param optimizer_class: optimizer of all networks
    :param optimizer_kwargs: its keyword arguments, without the learning rate; ``fused=True`` for Adam if None
    :param latent_dim: width of a codeword of one choice at most if the space is factored, that of :class:`CHDP`
    :param n_diffusion_steps: number N of denoising steps, that of :class:`CHDP`
    :param n_action_candidates: number of actions drawn per observation, that of :class:`CHDP`
    """

    fixed_discrete_actions: th.Tensor
    fixed_parameters: th.Tensor
    actor_class: ClassVar[type[CooperativeActor]] = CooperativeActor
    # Whether the units of the critics follow the rewards, see ValueScale
    adapts_values: ClassVar[bool] = True
    # Weight of a random action in the values of next states. Where only the best action avoids a failure, values jump, and
    # critics, which are smooth, overshoot: policies would go there
    random_share: ClassVar[float] = 0.1
    # What critics and continuous policy read of the features, see AttentionReads; none of features that are learnt
    n_reads: int = 8

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: HybridBox,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: type[nn.Module] = nn.SiLU,
        features_extractor_class: type[BaseFeaturesExtractor] = NormalizedExtractor,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        latent_dim: int = 32,
        n_diffusion_steps: int = 5,
        n_action_candidates: int = 8,
    ):
        if optimizer_kwargs is None:
            optimizer_kwargs = default_optimizer_kwargs(optimizer_class)
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
        self.latent_dim = latent_dim
        self.n_diffusion_steps = n_diffusion_steps
        self.n_action_candidates = n_action_candidates
        self._build(lr_schedule)

    def _build(self, lr_schedule: Schedule) -> None:
        extractor, codebook = self.make_features_extractor(), self._make_codebook()
        self.learns_features = any(True for _ in extractor.parameters())
        if self.learns_features:
            self.n_reads = 0
        self.critic = self._make_critic(extractor, codebook)
        self.actor = self._make_actor(extractor.features_dim, codebook)
        self.actor_target, self.critic_target = deepcopy(self.actor), deepcopy(self.critic)
        for target in (self.actor_target, self.critic_target):
            target.requires_grad_(False)
            target.train(False)
        self.value_scale = ValueScale(self.adapts_values)
        self.select, self.select_deterministic, self.select_target = self._make_selections()

        actor = self.actor
        self.discrete_optimizer = self._make_optimizer(actor.discrete_policy, lr_schedule)
        continuous = nn.ModuleList([actor.continuous_policy, *([] if actor.reads is None else [actor.reads])])
        self.continuous_optimizer = self._make_optimizer(continuous, lr_schedule)
        value_networks = nn.ModuleList([self.critic.features_extractor, self.critic.q_networks])
        self.critic.optimizer = self._make_optimizer(value_networks, lr_schedule)
        # One for both networks beside the critics
        beside = [net for net in (self.critic.reward_network, self.critic.return_network) if net is not None]
        self.reward_optimizer = self._make_optimizer(nn.ModuleList(beside), lr_schedule) if beside else None
        self.codebook_optimizer = self._make_optimizer(actor.codebook, lr_schedule)

        # Random actions of deterministic predictions, the same for every model
        n_random, generator = self.select_deterministic.n_random, th.Generator().manual_seed(0)
        _, k, parameters = actor.random_actions(n_random, generator=generator)
        self.register_buffer("fixed_discrete_actions", k, persistent=False)
        self.register_buffer("fixed_parameters", parameters, persistent=False)

    def _make_critic(self, extractor: BaseFeaturesExtractor, codebook: Codebook | ProductCodebook) -> HybridCritic:
        n_parameters = self.action_space.spec.max_parameters
        critic_arch = get_actor_critic_arch(self.net_arch)[1]
        ranges = RunningRanges(self.observation_space)
        sizes = extractor.features_dim, ranges.n, codebook.latent_widths(), n_parameters
        arguments = *sizes, critic_arch, self.activation_fn, self.n_reads
        q1, q2, rewards = (QNetwork(*arguments) for _ in range(3))
        return HybridCritic(
            self.observation_space,
            self.action_space,
            extractor,
            [q1, q2],
            rewards,
            ReturnNetwork(*arguments) if "returns" in self.action_space.columns else None,
            ranges if ranges.n else None,
            self.normalize_images,
        )

    def _make_actor(self, features_dim: int, codebook: Codebook | ProductCodebook) -> CooperativeActor:
        latent_dim, n_parameters = codebook.latent_dim, self.action_space.spec.max_parameters
        return self.actor_class(
            self.action_space,
            features_dim,
            codebook,
            self._make_model(latent_dim, features_dim),
            self._make_model(n_parameters, features_dim + latent_dim + self.n_reads),
            AttentionReads(features_dim, latent_dim, self.n_reads) if self.n_reads else None,
        )

    def _make_codebook(self) -> Codebook | ProductCodebook:
        spec: HybridActionSpec = self.action_space.spec
        if spec.is_factored:
            return ProductCodebook(spec.radices, self.latent_dim)
        return Codebook(spec.n_discrete_actions, self.latent_dim)

    def _make_model(self, dim: int, condition_dim: int) -> DiffusionModel:
        actor_arch = get_actor_critic_arch(self.net_arch)[0]
        return DiffusionModel(dim, condition_dim, self.n_diffusion_steps, actor_arch, self.activation_fn)

    def _make_selections(self) -> tuple[Selection, Selection, Selection]:
        """:return: rules for acting, for deterministic predictions and for next actions"""
        spec = self.action_space.spec
        n_values = sum(spec.radices)

        def alternatives(n_most: int) -> dict[str, Any]:
            return {"n_changed" if spec.is_factored else "n_alternatives": min(n_values, n_most)}

        acting = Selection(self.n_action_candidates, n_random=N_RANDOM_CANDIDATES, **alternatives(MAX_ALTERNATIVES))
        n_others = n_values if n_values < N_NEXT_ACTIONS else N_NEXT_ACTIONS // 2
        target = Selection(N_NEXT_ACTIONS - n_others, **alternatives(n_others))
        return replace(acting, sampled=True), replace(acting, n_refined=N_REFINEMENT_CANDIDATES), target

    def _make_optimizer(self, network: nn.Module, lr_schedule: Schedule) -> th.optim.Optimizer:
        make: Callable[..., th.optim.Optimizer] = self.optimizer_class
        return make(list(network.parameters()), lr=lr_schedule(1), **self.optimizer_kwargs)

    # Acting and next actions have the target critics' features. Where features are learnt, the online networks know others:
    # the targets act and choose
    @property
    def acting_actor(self) -> CooperativeActor:
        """The policies that act while training."""
        return self.actor_target if self.learns_features else self.actor

    @property
    def choosing_critic(self) -> HybridCritic:
        """The critics that choose next actions."""
        return self.critic_target if self.learns_features else self.critic

    def forward(self, obs: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._predict(obs, deterministic)

    def _predict(
        self, observation: PyTorchObs, deterministic: bool = False, action_masks: th.Tensor | None = None
    ) -> th.Tensor:
        """
        Draw actions and keep the one that the target critics value most, see :class:`Selection`; if not deterministic, values
        are draws between those of both critics.

        The noise of deterministic predictions is a function of the observation: one and the same noise in all states would
        repeat a policy's mistakes where sampling gets away from them. They use the target policies, averages of the policies
        over the last updates, which do not waver as those do, and refine what they chose.

        :return: (B, columns) rows
        """
        features = self.critic_target.features(observation)
        if deterministic:
            select, actor, fixed = self.select_deterministic, self.actor_target, self._fixed_draws(observation)
        else:
            select, actor, fixed = self.select, self.acting_actor, None
        latents, k, parameters = select(actor, self.critic_target, features, fixed, action_masks)
        stored_latents = latents[:, : self.action_space.stored_latent_dim]
        return self.action_space.columns.pack(discrete_actions=k.float(), parameters=parameters, latents=stored_latents)

    def _fixed_draws(self, observation: PyTorchObs) -> FixedDraws:
        """:return: what deterministic predictions take for all that is random, the same for every model"""
        n_drawn, n_alternatives = self.select_deterministic.n_drawn, self.select_deterministic.n_alternatives
        latent_noise, parameter_noise = (
            repeatable_noise(observation, n, model.n_steps, model.dim, seed=seed).flatten(0, 1).transpose(0, 1)
            for n, model, seed in (
                (n_drawn, self.actor_target.discrete_policy, 1),
                (n_drawn + n_alternatives, self.actor_target.continuous_policy, 2),
            )
        )
        return FixedDraws(latent_noise, parameter_noise, self.fixed_discrete_actions, self.fixed_parameters)

    def in_units_of_critics(self, targets: th.Tensor) -> th.Tensor:
        """
        Adapt the units of the critics to new targets; values stay what they were.

        :param targets: (B, 2) values and rewards, in the units of the rewards
        :return: (B, 2) what the networks ought to put out
        """
        if self.value_scale.adapts and (change := self.value_scale.update(targets)) is not None:
            for critic in (self.critic, self.critic_target):
                critic.rescale(*change)
        return self.value_scale.outputs(targets)

    def set_foresight(self, weight: float) -> None:
        """
        :param weight: weight in [0, 1] of what follows a reward in the choice of actions, see :class:`ForesightSums`
        """
        for critic in (self.critic, self.critic_target):
            critic.foresight = weight

    def set_training_mode(self, mode: bool) -> None:
        """
        Put the online networks in either training or evaluation mode; the targets stay in evaluation mode.

        :param mode: if true, set to training mode, else set to evaluation mode
        """
        # To visit all of their parts takes a while, and predictions ask for it every time
        for network in (self.actor, self.critic):
            if network.training != mode:
                network.train(mode)
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
                latent_dim=self.latent_dim,
                n_diffusion_steps=self.n_diffusion_steps,
                n_action_candidates=self.n_action_candidates,
                lr_schedule=self._dummy_schedule,  # dummy lr schedule, not needed for loading policy alone
            )
        )
        return data


MlpPolicy = CHDPPolicy


class CnnPolicy(CnnFeatures, CHDPPolicy):
    """:class:`CHDPPolicy` for images."""


class MultiInputPolicy(CHDPPolicy):
    """:class:`CHDPPolicy` for dict observations, whose vectors are normalised."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{"features_extractor_class": NormalizedCombinedExtractor, **kwargs})
