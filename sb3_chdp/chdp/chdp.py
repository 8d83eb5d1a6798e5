"""Cooperative Hybrid Diffusion Policies."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import update_learning_rate

from sb3_chdp.chdp.actor import CooperativeActor
from sb3_chdp.chdp.codebook import codebook_usage
from sb3_chdp.chdp.critic import HybridCritic
from sb3_chdp.chdp.exploration import vary_parts
from sb3_chdp.chdp.losses import (
    IMPROVEMENT_PARAMETERS,
    IMPROVEMENT_QS,
    continuous_policy_loss,
    critic_loss,
    discrete_policy_loss,
    relabel_latents,
)
from sb3_chdp.chdp.policies import CHDPPolicy, CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_chdp.common.buffers import PrioritizedDictReplayBuffer, PrioritizedReplayBuffer
from sb3_chdp.common.checks import check_at_least, check_fraction, check_one_of
from sb3_chdp.common.hybrid_box import HybridBox
from sb3_chdp.common.off_policy_algorithm import HybridOffPolicyAlgorithm
from sb3_chdp.common.utils import TargetUpdate, gradient_step


class CHDP(HybridOffPolicyAlgorithm):
    """
    Cooperative Hybrid Diffusion Policies (CHDP)

    A discrete and a continuous diffusion policy act in turn: the first draws a latent that a codebook decodes to the
    discrete action, the second draws the parameters given that action's codeword. They are improved in turn as well, by
    back-propagation of a twin critic through their denoising chains.

    Paper: Liu et al., "CHDP: Cooperative Hybrid Diffusion Policies for Reinforcement Learning in Parameterized Action
    Space", AAAI 2026. No reference code is published.

    Differences from the paper:
        1. the action of highest Q among ``n_action_candidates`` draws acts (1: the paper), see also ``n_random_candidates``
           and ``n_refinement_candidates``;
        2. random actions with a decreasing probability, see ``exploration_initial_eps`` (0: the paper) and ``explore_parts``;
        3. the discrete policy is improved with the parameters that the continuous policy draws for its latents, not with the
           stored ones, see ``improvement_parameters`` ("stored": the paper);
        4. the continuous policy is improved for uniformly random discrete actions too, some of which are among the
           candidates, see ``uniform_fraction`` (0: the paper);
        5. latents from the buffer that no longer decode to the action taken are replaced, see ``relabel_latents``;
        6. gradient norms are clipped, see ``max_grad_norm``;
        7. the critics' loss can train the codebook, which makes many discrete actions learnable, see
           ``critics_train_codebook`` (False: the paper);
        8. transitions of large TD error can be replayed more often, see ``prioritized_replay`` (False: the paper);
        9. codewords are kept in [-1, 1], where the latents are (not an argument: without it they drift away, and latents
           can no longer reach them).

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: The environment to learn from (if registered in Gym, can be str), with a hybrid action space
    :param learning_rate: learning rate of all networks; it can be a function of the current progress remaining (from 1 to 0)
    :param buffer_size: size of the replay buffer
    :param learning_starts: how many steps of the model to collect transitions for before learning starts
    :param batch_size: Minibatch size for each gradient update
    :param tau: the soft update coefficient ("Polyak update", between 0 and 1)
    :param gamma: the discount factor
    :param train_freq: Update the model every ``train_freq`` steps, or a tuple like ``(5, "step")`` or ``(2, "episode")``
    :param gradient_steps: How many gradient steps to do after each rollout; ``-1``: as many as steps done in the environment
    :param action_noise: noise on the scaled parameters, of size Pmax (None by default: the policies are stochastic)
    :param replay_buffer_class: Replay buffer class to use. If ``None``, it will be automatically selected.
    :param replay_buffer_kwargs: Keyword arguments to pass to the replay buffer on creation.
    :param optimize_memory_usage: Enable a memory efficient variant of the replay buffer at a cost of more complexity.
    :param n_steps: When n_step > 1, uses n-step return (with the NStepReplayBuffer) when updating the critics.
    :param latent_dim: width d_e of the latent and of a codeword
    :param n_diffusion_steps: number N of denoising steps of both policies
    :param beta_schedule: noise schedule, "vp", "linear" or "cosine"
    :param variance_type: variance of a denoising step, "fixed_large" (the paper) or "fixed_small" (DDPM's posterior)
    :param eta: weight of the policy improvement terms relative to the diffusion losses
    :param improvement_q: which Q the policies ascend: "q1", "min" or "mean" of the two
    :param improvement_parameters: parameters that value the discrete policy's latents: "stored", those of the action once
        taken, or "policy", those that the continuous policy draws for the latents
    :param uniform_fraction: share of uniformly random discrete actions for which the continuous policy is improved, and of
        those among the candidates
    :param n_action_candidates: number of actions drawn per observation to act; that of highest target min(Q1, Q2) is taken
    :param n_random_candidates: number of uniformly random actions that compete with these: a search for what the critics value
        and the policies have not found; best with ``layer_norm`` of :class:`CHDPPolicy` (0: the paper)
    :param n_refinement_candidates: number of variations of the best of these that compete with it in deterministic
        predictions, in each of two rounds, see :class:`CHDPPolicy`: for parameters that have to be exact (0: the paper)
    :param n_target_candidates: number of next actions drawn per transition for the target of the critics, chosen from in
        the same way (1: the paper)
    :param prioritized_replay: whether transitions of large TD error are replayed more often, see
        :class:`PrioritizedReplayBuffer`, whose arguments ``replay_buffer_kwargs`` can hold (False: the paper)
    :param relabel_latents: whether stored latents that no longer decode to their action give way to its present codeword
    :param codebook_lr_factor: learning rate of the codebook relative to that of the networks; the faster it moves, the
        more stored latents decode to other actions (``train/latent_drift``)
    :param critics_train_codebook: whether the critics' loss trains the codebook too, so that actions of similar effect get
        similar codewords; best with ``codebook_lr_factor=1`` (no effect without a codebook)
    :param max_grad_norm: bound on the gradient norm of every network, None for none
    :param policy_delay: policies and targets are updated once every ``policy_delay`` critic updates
    :param diffusion: False replaces both diffusion policies by deterministic MLPs (ablation)
    :param codebook: False replaces the codebook by argmax over a latent of width K and one-hot vectors (ablation)
    :param sequential_update: False updates the continuous policy on the stored latents and actions instead of those of
        the updated discrete policy (ablation)
    :param exploration_noise: standard deviation of the exploration noise if ``diffusion`` is False
    :param action_layout: how to read an ambiguous action space, "auto", "per_action" or "shared",
        see :class:`HybridActionSpec`
    :param explore_parts: whether exploration also varies the discrete action or the parameters alone, see
        :func:`vary_parts`; otherwise all exploratory actions are uniformly random
    :param exploration_fraction: fraction of the training over which the rate of uniformly random actions is reduced
    :param exploration_initial_eps: initial probability of a uniformly random action
    :param exploration_final_eps: final probability of a uniformly random action
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
    policy: CHDPPolicy
    actor: CooperativeActor
    actor_target: CooperativeActor
    critic: HybridCritic
    critic_target: HybridCritic

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
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        latent_dim: int = 8,
        n_diffusion_steps: int = 15,
        beta_schedule: str = "vp",
        variance_type: str = "fixed_large",
        eta: float = 10.0,
        improvement_q: str = "q1",
        improvement_parameters: str = "policy",
        uniform_fraction: float = 0.25,
        n_action_candidates: int = 16,
        n_random_candidates: int = 0,
        n_refinement_candidates: int = 0,
        n_target_candidates: int = 1,
        prioritized_replay: bool = False,
        relabel_latents: bool = True,
        codebook_lr_factor: float = 0.1,
        critics_train_codebook: bool = False,
        max_grad_norm: float | None = 1.0,
        policy_delay: int = 1,
        diffusion: bool = True,
        codebook: bool = True,
        sequential_update: bool = True,
        exploration_noise: float = 0.1,
        action_layout: str = "auto",
        explore_parts: bool = False,
        exploration_fraction: float = 0.2,
        exploration_initial_eps: float = 1.0,
        exploration_final_eps: float = 0.05,
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
            exploration_fraction=exploration_fraction,
            exploration_initial_eps=exploration_initial_eps,
            exploration_final_eps=exploration_final_eps,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
        )
        check_one_of(IMPROVEMENT_QS, improvement_q=improvement_q)
        check_one_of(IMPROVEMENT_PARAMETERS, improvement_parameters=improvement_parameters)
        check_fraction(uniform_fraction=uniform_fraction)
        check_at_least(1, latent_dim=latent_dim, policy_delay=policy_delay)
        check_at_least(1, n_action_candidates=n_action_candidates, n_target_candidates=n_target_candidates)
        check_at_least(0, n_random_candidates=n_random_candidates, n_refinement_candidates=n_refinement_candidates)
        if prioritized_replay and (n_steps > 1 or replay_buffer_class is not None):
            raise ValueError(
                f"prioritized_replay=True needs n_steps=1 and no replay_buffer_class, got {n_steps} and {replay_buffer_class}"
            )
        self.latent_dim = latent_dim
        self.n_diffusion_steps = n_diffusion_steps
        self.beta_schedule = beta_schedule
        self.variance_type = variance_type
        self.eta = eta
        self.improvement_q = improvement_q
        self.improvement_parameters = improvement_parameters
        self.uniform_fraction = uniform_fraction
        self.n_action_candidates = n_action_candidates
        self.n_random_candidates = n_random_candidates
        self.n_refinement_candidates = n_refinement_candidates
        self.n_target_candidates = n_target_candidates
        self.prioritized_replay = prioritized_replay
        self.relabel_latents = relabel_latents
        self.codebook_lr_factor = codebook_lr_factor
        self.critics_train_codebook = critics_train_codebook
        self.max_grad_norm = max_grad_norm
        self.policy_delay = policy_delay
        self.diffusion = diffusion
        self.codebook = codebook
        self.sequential_update = sequential_update
        self.exploration_noise = exploration_noise
        self.explore_parts = explore_parts

        if _init_setup_model:
            self._setup_model()

    def _network_kwargs(self) -> dict[str, Any]:
        return dict(
            diffusion=self.diffusion,
            codebook=self.codebook,
            n_diffusion_steps=self.n_diffusion_steps,
            beta_schedule=self.beta_schedule,
            variance_type=self.variance_type,
            n_action_candidates=self.n_action_candidates,
            n_random_candidates=self.n_random_candidates,
            n_refinement_candidates=self.n_refinement_candidates,
            uniform_fraction=self.uniform_fraction,
            exploration_noise=self.exploration_noise,
        )

    def _make_hybrid_space(self) -> HybridBox:
        box = super()._make_hybrid_space()
        latent_dim = self.latent_dim if self.codebook else box.spec.n_discrete_actions
        return HybridBox(self.action_space, self.action_layout, latent_dim)

    def _setup_model(self) -> None:
        if self.prioritized_replay:
            with_dict = isinstance(self.observation_space, spaces.Dict)
            self.replay_buffer_class = PrioritizedDictReplayBuffer if with_dict else PrioritizedReplayBuffer
        super()._setup_model()
        self._create_aliases()
        self.update_targets = TargetUpdate([self.actor, self.critic], [self.actor_target, self.critic_target])

    def _create_aliases(self) -> None:
        self.actor = self.policy.actor
        self.actor_target = self.policy.actor_target
        self.critic = self.policy.critic
        self.critic_target = self.policy.critic_target

    def train(self, gradient_steps: int, batch_size: int = 128) -> None:
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        policy = self.policy
        self._update_learning_rates()
        codebook_optimizer = [] if policy.codebook_optimizer is None else [policy.codebook_optimizer]

        logs: dict[str, list[th.Tensor]] = {}
        for _ in range(gradient_steps):
            self._n_updates += 1
            replay_data, drift = relabel_latents(policy, self._sample_batch(batch_size), self.relabel_latents)

            # Step 0: critics, and the codebook if they train it
            loss, q_values, errors = critic_loss(policy, replay_data, self.n_target_candidates)
            if isinstance(self.replay_buffer, PrioritizedReplayBuffer):
                self.replay_buffer.update_priorities(errors)
            also = codebook_optimizer if self.critics_train_codebook else []
            gradient_step(loss, [policy.critic.optimizer, *also], self.max_grad_norm)
            self.actor.codebook.project()
            losses = {"critic_loss": loss, "q_mean": q_values.mean(), "latent_drift": drift}

            if self._n_updates % self.policy_delay == 0:
                # alpha of eq. dql_q_loss
                alpha = self.eta / q_values.abs().mean().clamp(min=1e-6)
                actor_features = policy.actor_features(replay_data.observations)
                with th.no_grad():
                    critic_features = self.critic.features(replay_data.observations)
                features = (actor_features, critic_features)

                # Step 1: discrete policy
                diffusion_loss, q_loss = discrete_policy_loss(
                    policy, replay_data, *features, self.improvement_q, self.improvement_parameters
                )
                loss = diffusion_loss + alpha * q_loss
                gradient_step(loss, [policy.discrete_optimizer], self.max_grad_norm)
                losses |= {"discrete_loss": loss, "diffusion_loss_discrete": diffusion_loss}

                # Step 2: continuous policy and codebook, given the updated discrete policy
                diffusion_loss, q_loss, k = continuous_policy_loss(
                    policy, replay_data, *features, self.improvement_q, self.sequential_update, self.uniform_fraction
                )
                loss = diffusion_loss + alpha * q_loss
                gradient_step(loss, [policy.continuous_optimizer, *codebook_optimizer], self.max_grad_norm)
                self.actor.codebook.project()
                losses |= {"continuous_loss": loss, "diffusion_loss_continuous": diffusion_loss}

                self.update_targets(self.tau)
            for name, value in losses.items():
                logs.setdefault(name, []).append(value.detach())

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, values in logs.items():
            self.logger.record(f"train/{name}", th.stack(values).mean().item())
        if "continuous_loss" in logs:
            usage, perplexity = codebook_usage(k, self.hybrid_space.spec.n_discrete_actions)
            self.logger.record("train/codebook_usage", usage)
            self.logger.record("train/codebook_perplexity", perplexity)

    def _exploratory_rows(self, rows: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        if not self.explore_parts:
            return super()._exploratory_rows(rows, rng)
        assert self._last_obs is not None, "self._last_obs was not set"
        return vary_parts(self.policy, self._last_obs, rows, rng)  # type: ignore[arg-type]

    def _update_learning_rates(self) -> None:
        """Set the learning rates of all optimizers according to their schedules."""
        policy = self.policy
        self._update_learning_rate([policy.critic.optimizer, policy.discrete_optimizer, policy.continuous_optimizer])
        if policy.codebook_optimizer is not None:
            rate = self.codebook_lr_factor * self.lr_schedule(self._current_progress_remaining)
            update_learning_rate(policy.codebook_optimizer, rate)
            self.logger.record("train/codebook_learning_rate", rate)

    def _excluded_save_params(self) -> list[str]:
        parts_of_policy = ["actor", "critic", "actor_target", "critic_target", "update_targets"]
        return [*super()._excluded_save_params(), *parts_of_policy]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts = ["policy", "critic.optimizer", "policy.discrete_optimizer", "policy.continuous_optimizer"]
        if self.codebook:
            state_dicts.append("policy.codebook_optimizer")
        return state_dicts, []
