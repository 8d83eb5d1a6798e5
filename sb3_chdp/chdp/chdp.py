"""Cooperative Hybrid Diffusion Policies."""

from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import LinearSchedule

from sb3_chdp.chdp.actor import CooperativeActor
from sb3_chdp.chdp.critic import HybridCritic
from sb3_chdp.chdp.exploring import ExploringAlgorithm
from sb3_chdp.chdp.losses import (
    continuous_policy_loss,
    critic_loss,
    discrete_policy_loss,
    losses_beside_critics,
    target_values,
)
from sb3_chdp.chdp.policies import CHDPPolicy, CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_chdp.chdp.value_scale import N_FIRST_SAMPLES
from sb3_chdp.common.arguments import NOT_NEGATIVE, Accepted, of_networks, warn_of_cost, whole
from sb3_chdp.common.buffers import PrioritizedReplayBuffer
from sb3_chdp.common.samples import HybridReplaySamples
from sb3_chdp.common.utils import gradient_step
from sb3_chdp.common.watkins_buffer import WatkinsDictReplayBuffer, WatkinsReplayBuffer

# High at first, and 0 in the end: what is learnt settles
LEARNING_RATE = LinearSchedule(1e-3, 0.0, 1.0)
# What actions on the way of an n-step return and a random one may cost, in the critics' units, with full foresight
LARGEST_COST = 0.2


class CHDP(ExploringAlgorithm):
    """
    Cooperative Hybrid Diffusion Policies (CHDP)

    A discrete and a continuous diffusion policy act in turn: the first draws a latent that a codebook decodes to the
    discrete action, the second draws the parameters given that action's codeword. They are improved in turn as well, by
    back-propagation of a twin critic through their denoising chains.

    Paper: Liu et al., "CHDP: Cooperative Hybrid Diffusion Policies for Reinforcement Learning in Parameterized Action
    Space", AAAI 2026. No reference code is published.

    Observations, rewards and parameters may have any units.

    :class:`PaperCHDP` is the algorithm as published. Differences from it:
        1. observations are normalised, see :class:`NormalizedExtractor`, and values, see :class:`ValueScale`;
        2. critics have layer normalisation, a state value of their own, which sees thresholds, and read parts of the
           state, see :class:`QNetwork`;
        3. the critics' loss trains the codebook too, so that actions of similar effect get similar codewords; these are what
           critics see of a discrete action, not the latents around them that decode to it, see :class:`CooperativeActor`;
        4. the values of next states depend on what the episode has returned so far, see :class:`ReturnNetwork`;
        5. of several actions the one that critics value most acts; while training, those that they disagree about are tried,
           see :class:`Selection`; in targets it is the next action, with a small share of a random one, :func:`next_values`;
        6. returns in targets have several steps where observations change slowly and actions cost little, see
           :class:`WatkinsReplayBuffer`;
        7. the discrete policy is improved by comparing a few discrete actions, each with the parameters that the continuous
           policy draws for it, see :func:`discrete_policy_loss`, and the continuous policy for uniformly random ones too;
        8. parts of actions are explored, at a rate that follows from the task, see :func:`exploration_rate`,
           :func:`informative_steps` and :func:`vary_parts`;
        9. a network learns rewards, and what follows a reward counts less in the choice of actions where
           exploratory actions have shown no influence on it, see :class:`ForesightSums`;
        10. the learning rate falls linearly to 0.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: The environment to learn from (if registered in Gym, can be str), with a hybrid action space
    :param learning_rate: learning rate, that of the codebook times ``codebook_lr_factor``; it can be a function of the current
        progress remaining (from 1 to 0) (by default it falls linearly from 1e-3 to 0)
    :param buffer_size: size of the replay buffer
    :param learning_starts: how many steps of the model to collect transitions for before learning starts
    :param batch_size: Minibatch size for each gradient update
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: the discount factor; 1 where only the end counts, less than the default where the next few steps do
    :param train_freq: Update the model every ``train_freq`` steps, or a tuple like ``(5, "step")`` or ``(2, "episode")``
    :param gradient_steps: How many gradient steps to do after each rollout; ``-1``: as many as steps done in the environment
    :param action_noise: noise on the scaled parameters, of size Pmax (None by default: the policies are stochastic)
    :param replay_buffer_class: Replay buffer class to use. If ``None``, it will be automatically selected.
        With :class:`PrioritizedReplayBuffer` transitions of large TD error are replayed more often
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation.
    :param optimize_memory_usage: Enable a memory efficient variant of the replay buffer at a cost of more complexity.
    :param n_steps: When n_step > 1, uses n-step return (with the NStepReplayBuffer) when updating the critics. By default n
        depends on the task, see :class:`WatkinsReplayBuffer`; it is 1 with ``replay_buffer_class=ReplayBuffer`` or
        ``optimize_memory_usage=True``
    :param latent_dim: width d_e of the latent and of a codeword, at most that of one choice of a factored space
    :param n_diffusion_steps: number N of denoising steps of both policies
    :param eta: weight of the policy improvement terms relative to the diffusion losses
    :param codebook_lr_factor: learning rate of the codebook relative to that of the networks
    :param n_action_candidates: number of actions that both policies draw per observation to act, beside others that compete
    :param policy_delay: policies and targets are updated once every ``policy_delay`` critic updates
    :param action_layout: how to read an ambiguous action space, see :class:`HybridActionSpec`
    :param use_masking: whether to ask the environment for ``action_masks()`` and to take no discrete action that they forbid;
        None: if it has such a method
    :param stats_window_size: number of episodes over which the logged success rate, length and reward are averaged
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation, see :class:`CHDPPolicy`
    :param verbose: Verbosity level: 0 for no output, 1 for info messages, 2 for debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run; auto: the GPU if possible
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    accepted_arguments: ClassVar[dict[str, Accepted]] = {
        "latent_dim": of_networks(whole(1)),
        "n_diffusion_steps": of_networks(whole(1)),
        "eta": NOT_NEGATIVE,
        "codebook_lr_factor": NOT_NEGATIVE,
        "n_action_candidates": whole(1),
    }
    # Share of uniformly random discrete actions for which the continuous policy is improved
    uniform_fraction: ClassVar[float] = 0.5
    # Whether the critics' loss trains the codebook
    critics_train_codebook: ClassVar[bool] = True
    # Bound on the gradient norm of an optimizer. Most batches of the critics reach it, and count alike: with a wider one they
    # forget now and then what they had learnt
    max_grad_norm: ClassVar[float] = 1.0
    default_buffer_classes: ClassVar[tuple[type[ReplayBuffer], type[ReplayBuffer]] | None] = (
        WatkinsReplayBuffer,
        WatkinsDictReplayBuffer,
    )

    policy: CHDPPolicy
    actor: CooperativeActor
    actor_target: CooperativeActor
    critic: HybridCritic
    critic_target: HybridCritic

    def __init__(
        self,
        policy: str | type[CHDPPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = LEARNING_RATE,
        buffer_size: int = 1_000_000,  # 1e6
        learning_starts: int = 500,
        batch_size: int = 128,
        tau: float = 0.005,
        gamma: float = 0.97,
        train_freq: int | tuple[int, str] = 1,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        latent_dim: int = 32,
        n_diffusion_steps: int = 5,
        eta: float = 10.0,
        codebook_lr_factor: float = 1.0,
        n_action_candidates: int = 8,
        policy_delay: int = 1,
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
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            optimize_memory_usage=optimize_memory_usage,
            n_steps=n_steps,
            action_layout=action_layout,
            use_masking=use_masking,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
        )
        self.latent_dim = latent_dim
        self.n_diffusion_steps = n_diffusion_steps
        self.eta = eta
        self.codebook_lr_factor = codebook_lr_factor
        self.n_action_candidates = n_action_candidates
        self.policy_delay = policy_delay

        if _init_setup_model:
            self._setup_model()

    def _network_kwargs(self) -> dict[str, Any]:
        return dict(
            latent_dim=self.latent_dim,
            n_diffusion_steps=self.n_diffusion_steps,
            n_action_candidates=self.n_action_candidates,
        )

    def _setup_model(self) -> None:
        super()._setup_model()
        warn_of_cost(CHDP, n_diffusion_steps=self.n_diffusion_steps, batch_size=self.batch_size)

    def train(self, gradient_steps: int, batch_size: int = 128) -> None:
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        policy = self.policy
        self._update_learning_rates()
        critic_optimizers = [policy.critic.optimizer]
        if self.critics_train_codebook:
            critic_optimizers.append(policy.codebook_optimizer)
        if isinstance(self.replay_buffer, WatkinsReplayBuffer):
            self.replay_buffer.tolerance = LARGEST_COST * self.foresight_sums.weight()
        if self._n_updates == 0 and policy.value_scale.adapts:
            self._start_values()

        logs: dict[str, list[th.Tensor]] = {}
        for _ in range(gradient_steps):
            self._n_updates += 1
            replay_data = self._sample_batch(batch_size)

            # Step 0: critics, eq. 10 and 11, and the codebook if they train it
            targets, costs = target_values(policy, replay_data)
            targets = policy.in_units_of_critics(targets)
            if isinstance(self.replay_buffer, WatkinsReplayBuffer):
                assert replay_data.next_indices is not None and costs is not None, "such a buffer says what follows"
                self.replay_buffer.update_costs(replay_data.next_indices, costs, replay_data.dones)
            features = policy.critic.features(replay_data.observations)
            self.update_targets.copy_statistics()
            loss, q1, errors = critic_loss(policy, replay_data, features, targets[:, :1])
            gradient_step(loss, critic_optimizers, self.max_grad_norm, "critic_loss")
            policy.actor.codebook.project()
            if isinstance(self.replay_buffer, PrioritizedReplayBuffer):
                assert replay_data.indices is not None, "a prioritised buffer says where its samples are"
                self.replay_buffer.update_priorities(replay_data.indices, errors)
            losses = {"critic_loss": loss, "q_mean": policy.value_scale.values(q1).mean()}
            features = features.detach()
            if policy.reward_optimizer is not None:  # PaperCHDP has no networks beside the critics
                beside = losses_beside_critics(policy, replay_data, features, targets, q1)
                loss = th.stack(list(beside.values())).sum()
                gradient_step(loss, [policy.reward_optimizer], self.max_grad_norm, "reward_loss")
                losses |= beside

            if self._n_updates % self.policy_delay == 0:
                with th.no_grad():
                    (scores,) = policy.critic.weigh((q1,), features, replay_data.latents, replay_data.parameters)
                alpha = self.eta / scores.abs().mean().clamp(min=1e-6)

                # Step 1: discrete policy, eq. 7
                diffusion_loss, q_loss = self._discrete_policy_loss(replay_data, features)
                loss = diffusion_loss + alpha * q_loss
                gradient_step(loss, [policy.discrete_optimizer], self.max_grad_norm, "discrete_loss")
                losses |= {"discrete_loss": loss, "diffusion_loss_discrete": diffusion_loss}

                # Step 2: continuous policy and codebook, eq. 8, given the updated discrete policy
                latents, k = self._actions_to_improve(replay_data, features)
                diffusion_loss, q_loss = continuous_policy_loss(policy, replay_data, features, latents, k)
                loss = diffusion_loss + alpha * q_loss
                optimizers = [policy.continuous_optimizer, policy.codebook_optimizer]
                gradient_step(loss, optimizers, self.max_grad_norm, "continuous_loss")
                policy.actor.codebook.project()
                losses |= {"continuous_loss": loss, "diffusion_loss_continuous": diffusion_loss}

                self.update_targets(self.tau)
            for name, value in losses.items():
                logs.setdefault(name, []).append(value.detach())

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, values in logs.items():
            self.logger.record(f"train/{name}", th.stack(values).mean().item())
        if "continuous_loss" in logs:
            self._log_usage(k)

    def _log_usage(self, k: th.Tensor) -> None:
        """
        Log how many discrete actions are in use, of a factored space the mean over its choices and that of every leaf.

        :param k: discrete actions of :meth:`_actions_to_improve`, of which those that the policy drew count
        """
        k = k[round(self.uniform_fraction * len(k)) :]
        leaves = self.hybrid_space.spec.choices_of_leaves
        for name, values in zip(("usage", "perplexity"), self.actor.codebook.usage(k), strict=True):
            self.logger.record(f"train/codebook_{name}", values.mean().item())
            for leaf, choices in leaves.items() if len(leaves) > 1 else ():
                # SB3 cuts long keys where it prints them, and refuses those that are then the same
                self.logger.record(f"train/codebook_{name}/{leaf}", values[choices].mean().item(), exclude="stdout")

    def _sample_batch(self, batch_size: int) -> HybridReplaySamples:
        replay_data = super()._sample_batch(batch_size)
        return replay_data._replace(latents=self._latents(replay_data))

    def _start_values(self) -> None:
        """Center and scale of the values, before the first update."""
        first = self._sample_batch(N_FIRST_SAMPLES)
        self.policy.value_scale.start(first.rewards, (1 - first.dones) * first.discounts)

    def _latents(self, replay_data: HybridReplaySamples) -> th.Tensor:
        """:return: (B, latent_dim) latents of the stored actions: their present codewords"""
        return self.actor.codebook.representative_latents(replay_data.discrete_actions)

    def _discrete_policy_loss(self, replay_data: HybridReplaySamples, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """:return: diffusion loss and policy improvement loss of the discrete policy"""
        return discrete_policy_loss(self.policy, replay_data, features)

    @th.no_grad()
    def _actions_to_improve(self, replay_data: HybridReplaySamples, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param replay_data: a batch
        :param features: (B, features_dim) features of the observations, without gradient
        :return: latents (B, latent_dim) and discrete actions (B,) whose parameters are improved, first a share of
            ``uniform_fraction`` random ones, then those of the discrete policy
        """
        n, codebook, masks = round(self.uniform_fraction * len(features)), self.actor.codebook, replay_data.masks
        masks_uniform, masks_drawn = (None, None) if masks is None else (masks[:n], masks[n:])
        drawn_latents, drawn_k = self.actor.sample_latents(features[n:], masks=masks_drawn)
        uniform_k = codebook.random(n, masks=masks_uniform)
        return th.cat([codebook.representative_latents(uniform_k), drawn_latents]), th.cat([uniform_k, drawn_k])

    def _update_learning_rates(self) -> None:
        """Set the learning rates of all optimizers according to their schedules."""
        policy = self.policy
        optimizers = [policy.critic.optimizer, policy.discrete_optimizer, policy.continuous_optimizer]
        self._update_learning_rate(optimizers + ([] if policy.reward_optimizer is None else [policy.reward_optimizer]))
        self._update_own_learning_rate(
            policy.codebook_optimizer, "codebook_learning_rate", lambda left: self.codebook_lr_factor * self.lr_schedule(left)
        )

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        optimizers = [
            "critic.optimizer",
            "policy.discrete_optimizer",
            "policy.continuous_optimizer",
            "policy.codebook_optimizer",
        ]
        if self.policy.reward_optimizer is not None:
            optimizers.append("policy.reward_optimizer")
        return ["policy", *optimizers], []
