"""Cooperative Hybrid Diffusion Policies as published."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor, create_mlp, get_actor_critic_arch
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from torch import nn

from sb3_chdp.chdp.actor import CooperativeActor
from sb3_chdp.chdp.candidates import Selection
from sb3_chdp.chdp.chdp import CHDP
from sb3_chdp.chdp.codebook import Codebook
from sb3_chdp.chdp.critic import HybridCritic
from sb3_chdp.chdp.policies import CHDPPolicy
from sb3_chdp.chdp.product_codebook import ProductCodebook
from sb3_chdp.common.hybrid_box import HybridBox
from sb3_chdp.common.policies import CnnFeatures, CombinedFeatures
from sb3_chdp.common.product_table import block_widths
from sb3_chdp.common.samples import HybridReplaySamples
from sb3_chdp.common.spaces import HybridActionSpec

# Spread of the latents around a codeword in random actions
RANDOM_LATENT_NOISE = 0.1


class PaperQNetwork(nn.Module):
    """
    MLP Q(s, e, a).

    :param n_inputs: number of features, latent entries and parameters
    :param net_arch: hidden layers
    :param activation_fn: activation function
    """

    def __init__(self, n_inputs: int, net_arch: list[int], activation_fn: type[nn.Module]):
        super().__init__()
        self.mlp = nn.Sequential(*create_mlp(n_inputs, 1, net_arch, activation_fn))

    def forward(self, features: th.Tensor, latents: th.Tensor, parameters: th.Tensor) -> th.Tensor:
        """:return: (B, 1) values"""
        return self.mlp(th.cat([features, latents, parameters], dim=1))


class PaperActor(CooperativeActor):
    """
    :class:`CooperativeActor` whose latents are those that were drawn.

    :param args: those of :class:`CooperativeActor`
    :param kwargs: those of :class:`CooperativeActor`
    """

    def sample_latents(
        self, features: th.Tensor, noise: th.Tensor | None = None, masks: th.Tensor | None = None
    ) -> tuple[th.Tensor, th.Tensor]:
        drawn, k = self.draw_latents(features, noise, masks)
        if masks is None:
            return drawn, k
        # Those of forbidden actions give way to the nearest allowed codeword
        return th.where(self.strayed(drawn, k), self.codebook.representative_latents(k) + (drawn - drawn.detach()), drawn), k

    def strayed(self, latents: th.Tensor, k: th.Tensor) -> th.Tensor:
        """
        :param latents: (B, latent_dim)
        :param k: (B,) discrete actions
        :return: (B, 1) which latents do not decode to k
        """
        return (self.codebook.quantize(latents) != k).view(len(k), -1).any(dim=1, keepdim=True)


class PaperPolicy(CHDPPolicy):
    """
    :class:`CHDPPolicy` with plain networks, observations as they are, and one draw per action.

    :param args: those of :class:`CHDPPolicy`
    :param kwargs: those of :class:`CHDPPolicy`
    """

    actor_class: ClassVar[type[CooperativeActor]] = PaperActor
    adapts_values: ClassVar[bool] = False
    random_share: ClassVar[float] = 0.0
    n_reads = 0

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{"features_extractor_class": FlattenExtractor, **kwargs})

    def _make_critic(self, extractor: BaseFeaturesExtractor, codebook: Codebook | ProductCodebook) -> HybridCritic:
        n_inputs = extractor.features_dim + codebook.latent_dim + self.action_space.spec.max_parameters
        critic_arch = get_actor_critic_arch(self.net_arch)[1]
        q_networks: list[nn.Module] = [PaperQNetwork(n_inputs, critic_arch, self.activation_fn) for _ in range(2)]
        return HybridCritic(
            self.observation_space, self.action_space, extractor, q_networks, normalize_images=self.normalize_images
        )

    def _make_selections(self) -> tuple[Selection, Selection, Selection]:
        one = Selection(n_drawn=1)
        return one, one, one

    def random_rows(self, rng: np.random.Generator, n: int, masks: np.ndarray | None = None) -> np.ndarray:
        """Uniformly random actions; their latents scatter around the codewords and decode to the actions."""
        rows, columns = super().random_rows(rng, n, masks), self.action_space.columns
        k = th.as_tensor(columns.discrete_actions(rows), device=self.device)
        assert isinstance(self.actor, PaperActor)
        centres = self.actor.codebook.representative_latents(k)
        latents = centres.clone()
        undecided = th.arange(n, device=self.device)
        spread = RANDOM_LATENT_NOISE
        for _ in range(5):
            noise = th.as_tensor(rng.normal(0, spread, (len(undecided), centres.shape[1])), dtype=th.float32)
            candidates = (centres[undecided] + noise.to(self.device)).clamp(-1, 1)
            fits = ~self.actor.strayed(candidates, k[undecided])[:, 0]
            latents[undecided[fits]] = candidates[fits]
            undecided = undecided[~fits]
            if len(undecided) == 0:
                break
            spread /= 2
        columns.view(rows, "latents")[:] = latents.cpu().numpy()
        return rows


class PaperCnnPolicy(CnnFeatures, PaperPolicy):
    """:class:`PaperPolicy` for images."""


class PaperMultiInputPolicy(CombinedFeatures, PaperPolicy):
    """:class:`PaperPolicy` for dict observations."""


class PaperCHDP(CHDP):
    """
    Cooperative Hybrid Diffusion Policies (CHDP) as in the paper, for those who compare with it.

    One draw of the policies acts, random actions are for the warm-up alone, and the target takes one draw as well. The
    discrete policy is improved with the stored parameters, the continuous policy for the latents of the discrete one, and
    the codebook learns through the continuous chain only. Stored latents stay as they are.

    Paper: Liu et al., "CHDP: Cooperative Hybrid Diffusion Policies for Reinforcement Learning in Parameterized Action
    Space", AAAI 2026. What it leaves open is as in :class:`CHDP`: the noise schedule, a bound of 1 on gradient norms,
    codewords kept in [-1, 1].

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: The environment to learn from (if registered in Gym, can be str), with a hybrid action space
    :param learning_rate: learning rate of all networks but the codebook's
    :param buffer_size: size of the replay buffer
    :param learning_starts: how many steps of the model to collect random transitions for before learning starts
    :param batch_size: Minibatch size for each gradient update
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: the discount factor
    :param train_freq: Update the model every ``train_freq`` steps
    :param gradient_steps: How many gradient steps to do after each rollout
    :param replay_buffer_class: Replay buffer class to use. If ``None``, it will be automatically selected.
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation.
    :param latent_dim: width d_e of the latent and of a codeword, at most that of one choice of a factored space
    :param n_diffusion_steps: number N of denoising steps of both policies
    :param eta: weight of the policy improvement terms relative to the diffusion losses
    :param codebook_lr_factor: learning rate of the codebook relative to that of the networks
    :param action_layout: how to read an ambiguous action space, see :class:`HybridActionSpec`
    :param use_masking: whether to obey ``action_masks()`` of the environment; None: if it has such a method
    :param stats_window_size: number of episodes over which the logged success rate, length and reward are averaged
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation, see :class:`CHDPPolicy`
    :param verbose: Verbosity level: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run; auto: the GPU if possible
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": PaperPolicy,
        "CnnPolicy": PaperCnnPolicy,
        "MultiInputPolicy": PaperMultiInputPolicy,
    }
    uniform_fraction: ClassVar[float] = 0.0
    critics_train_codebook: ClassVar[bool] = False
    knows_returns: ClassVar[bool] = False
    default_buffer_classes: ClassVar[tuple[type[ReplayBuffer], type[ReplayBuffer]] | None] = None

    def __init__(
        self,
        policy: str | type[CHDPPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-3,
        buffer_size: int = 1_000_000,  # 1e6
        learning_starts: int = 500,
        batch_size: int = 128,
        tau: float = 0.005,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        latent_dim: int = 8,
        n_diffusion_steps: int = 15,
        eta: float = 10.0,
        codebook_lr_factor: float = 0.1,
        action_layout: str = "auto",
        use_masking: bool | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ):
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            latent_dim=latent_dim,
            n_diffusion_steps=n_diffusion_steps,
            eta=eta,
            codebook_lr_factor=codebook_lr_factor,
            n_action_candidates=1,
            policy_delay=1,
            action_layout=action_layout,
            use_masking=use_masking,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
        )

    def _make_hybrid_space(self, action_layout: str) -> HybridBox:
        radices = HybridActionSpec(self.action_space, action_layout).radices
        width = sum(block_widths(radices, self.latent_dim))
        return HybridBox(self.action_space, action_layout, width, self._state_parts())

    def _latents(self, replay_data: HybridReplaySamples) -> th.Tensor:
        return replay_data.latents

    def _discrete_policy_loss(self, replay_data: HybridReplaySamples, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Eq. 7 as it stands: the value of the latents that were drawn, with the stored parameters."""
        latents, _ = self.actor.sample_latents(features, masks=replay_data.masks)
        diffusion_loss = self.actor.latent_loss(replay_data.latents, features)
        return diffusion_loss, -self.critic.score1(features, latents, replay_data.parameters).mean()

    def _exploration_rate(self) -> float:
        return 0.0
