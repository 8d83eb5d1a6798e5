"""Twin delayed deterministic policy gradients for hybrid actions: what the TD3 baselines share."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, Schedule
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule
from stable_baselines3.td3.policies import Actor, TD3Policy
from torch import nn
from torch.nn import functional as F

from sb3_chdp.common.arguments import FRACTION, NOT_NEGATIVE, RATE, SWITCH, Accepted, is_class_of, of_networks, optional
from sb3_chdp.common.buffers import PrioritizedReplayBuffer
from sb3_chdp.common.hybrid_box import HybridBox, ScoreBox
from sb3_chdp.common.off_policy_algorithm import HybridOffPolicyAlgorithm
from sb3_chdp.common.policies import HybridPolicy
from sb3_chdp.common.samples import HybridReplaySamples
from sb3_chdp.common.utils import default_optimizer_kwargs, gradient_step
from sb3_chdp.common.watkins_buffer import WatkinsReplayBuffer


class _InvertGradient(th.autograd.Function):
    @staticmethod
    def forward(ctx: Any, actions: th.Tensor) -> th.Tensor:
        ctx.save_for_backward(actions)
        return actions.clamp(-1, 1)

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> th.Tensor:
        (actions,) = ctx.saved_tensors
        # The loss falls along -gradient: where that leads up, what counts is the way left to 1, else to -1
        room = th.where(gradient < 0, 1 - actions, 1 + actions) / 2
        return gradient * room


class InvertingGradients(nn.Module):
    """
    Clamp to [-1, 1] whose gradient shrinks as an action approaches the bound that it is pushed to, and turns back beyond
    it (Hausknecht and Stone, 2016).
    """

    def forward(self, actions: th.Tensor) -> th.Tensor:
        return _InvertGradient.apply(actions)  # type: ignore[no-untyped-call]


class HybridTD3Policy(HybridPolicy, TD3Policy):
    """
    SB3's TD3 policy with an actor whose output stands for hybrid actions: the rows of a :class:`ScoreBox`. Subclasses can
    let it stand for others: by ``_predict`` and ``_noisy_rows``, which return rows, and ``actor_outputs`` and
    ``mask_outputs``, which keep to masks.

    Arguments not listed here are those of :class:`stable_baselines3.td3.policies.TD3Policy`; ``optimizer_kwargs`` are
    ``fused=True`` for Adam if None.

    :param inverting_gradients: whether to invert the gradients at the actor's output
    """

    def __init__(self, *args: Any, inverting_gradients: bool = False, **kwargs: Any):
        self.inverting_gradients = inverting_gradients
        if kwargs.get("optimizer_kwargs") is None:
            kwargs["optimizer_kwargs"] = default_optimizer_kwargs(kwargs.get("optimizer_class", th.optim.Adam))
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        # Masks are no outputs of actors and no inputs to critics
        if isinstance(self.action_space, ScoreBox) and "masks" in self.action_space.columns:
            bare = type(self.action_space)(self.action_space.native, self.action_space.spec.layout)
            self.actor_kwargs["action_space"] = self.critic_kwargs["action_space"] = bare
        super()._build(lr_schedule)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        actor = super().make_actor(features_extractor)
        if self.inverting_gradients:
            actor.mu = nn.Sequential(*actor.mu, InvertingGradients())
        return actor

    @property
    def noise_dim(self) -> int:
        return get_action_dim(self.actor.action_space)

    def noisy_rows(
        self, observation: np.ndarray | dict[str, np.ndarray], noise: np.ndarray, action_masks: np.ndarray | None = None
    ) -> np.ndarray:
        self.set_training_mode(False)
        obs_tensor, _ = self.obs_to_tensor(observation)
        with th.no_grad():
            # One environment: the noise has no batch dimension
            noise_tensor = th.as_tensor(noise, dtype=th.float32, device=self.device).view(-1, self.noise_dim)
            return self._noisy_rows(obs_tensor, noise_tensor, self.mask_tensor(action_masks)).cpu().numpy()

    def _predict(
        self, observation: PyTorchObs, deterministic: bool = False, action_masks: th.Tensor | None = None
    ) -> th.Tensor:
        """:return: (n, columns) rows"""
        return self._complete(self.actor_outputs(self.actor, observation, action_masks))

    def _noisy_rows(self, obs: PyTorchObs, noise: th.Tensor, action_masks: th.Tensor | None) -> th.Tensor:
        """:return: (n, columns) rows for (n, noise_dim) noise on the actor's output"""
        return self._complete(self.mask_outputs((self.actor(obs) + noise).clamp(-1, 1), action_masks))

    def _complete(self, outputs: th.Tensor) -> th.Tensor:
        """:return: (n, columns) rows of what the actor puts out; their masks are filled in later"""
        return nn.functional.pad(outputs, (0, self.action_space.columns.width - outputs.shape[1]))

    def actor_outputs(self, actor: Actor, obs: PyTorchObs, action_masks: th.Tensor | None) -> th.Tensor:
        """
        :param actor: the actor or its target
        :param obs: observations
        :param action_masks: (B, K) False for discrete actions that may not be taken
        :return: (B, actor's outputs) that stand for allowed actions
        """
        return self.mask_outputs(actor(obs), action_masks)

    def mask_outputs(self, outputs: th.Tensor, action_masks: th.Tensor | None) -> th.Tensor:
        """
        :param outputs: (B, actor's outputs)
        :param action_masks: (B, K) False for discrete actions that may not be taken
        :return: the same, moved to where they stand for allowed actions; with a gradient
        """
        if action_masks is None:
            return outputs
        assert isinstance(self.action_space, ScoreBox)
        return self.action_space.mask_scores(outputs, action_masks)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "inverting_gradients": self.inverting_gradients}


class HybridTD3(HybridOffPolicyAlgorithm):
    """
    Base class of the TD3 baselines: SB3's TD3 on scores of all discrete actions and their parameters, in parts that
    subclasses replace.

    Parameters not listed here are those of :class:`stable_baselines3.TD3`.

    :param target_policy_noise: standard deviation of the noise on the target actor's output (smoothing); 0: none
    :param policy_delay: actor and targets are updated once every ``policy_delay`` critic updates
    :param action_noise: noise on the actor's output, in place of the Gaussian one
    :param action_layout: how to read an ambiguous action space, see :class:`HybridActionSpec`
    :param exploration_fraction: fraction of the training over which the rate of uniformly random actions is reduced
    :param exploration_initial_eps: initial probability of a uniformly random action
    :param exploration_final_eps: final probability of a uniformly random action
    :param exploration_noise: standard deviation of the Gaussian noise on the actor's output (scores and parameters,
        parameters, or latents), if no ``action_noise`` is given; it can be a function of the current progress remaining
        (from 1 to 0)
    :param inverting_gradients: whether the gradients at the actor's output are inverted
    """

    accepted_arguments: ClassVar[dict[str, Accepted]] = {
        "replay_buffer_class": optional(
            Accepted(
                "a class of replay buffers without priorities or costs, which only CHDP sets",
                lambda kind: is_class_of(kind, ReplayBuffer)
                and not issubclass(kind, (PrioritizedReplayBuffer, WatkinsReplayBuffer)),
            )
        ),
        "target_policy_noise": NOT_NEGATIVE,
        "target_noise_clip": NOT_NEGATIVE,
        "exploration_fraction": FRACTION,
        "exploration_initial_eps": FRACTION,
        "exploration_final_eps": FRACTION,
        "exploration_noise": RATE,
        "inverting_gradients": of_networks(SWITCH),
    }
    policy: HybridTD3Policy
    actor: Actor
    actor_target: Actor
    # Twin networks, whose inputs are up to the subclasses
    critic: Any
    critic_target: Any

    def __init__(
        self,
        policy: str | type[HybridTD3Policy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        buffer_size: int = 100_000,
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
        policy_delay: int = 2,
        target_policy_noise: float = 0.2,
        target_noise_clip: float = 0.5,
        exploration_noise: float | Schedule = 0.1,
        inverting_gradients: bool = False,
        exploration_fraction: float = 0.2,
        exploration_initial_eps: float = 1.0,
        exploration_final_eps: float = 0.05,
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
        self.policy_delay = policy_delay
        self.target_noise_clip = target_noise_clip
        self.target_policy_noise = target_policy_noise
        self.exploration_noise = exploration_noise
        self.inverting_gradients = inverting_gradients
        self.exploration_fraction = exploration_fraction
        self.exploration_initial_eps = exploration_initial_eps
        self.exploration_final_eps = exploration_final_eps

        if _init_setup_model:
            self._setup_model()

    def _make_hybrid_space(self, action_layout: str) -> HybridBox:
        return ScoreBox(self.action_space, action_layout, self._state_parts())

    def _network_kwargs(self) -> dict[str, Any]:
        return {"inverting_gradients": self.inverting_gradients}

    def _setup_model(self) -> None:
        super()._setup_model()
        fraction = max(self.exploration_fraction, 1e-9)  # a schedule divides by it
        self.exploration_schedule = LinearSchedule(self.exploration_initial_eps, self.exploration_final_eps, fraction)
        self.exploration_noise_schedule = FloatSchedule(self.exploration_noise)

    def _exploration_rate(self) -> float:
        return self.exploration_schedule(self._current_progress_remaining)

    def _draw_noise(self, n_envs: int) -> np.ndarray | None:
        std = self.exploration_noise_schedule(self._current_progress_remaining)
        return self.action_space.np_random.normal(0.0, std, (n_envs, self.policy.noise_dim))

    def train(self, gradient_steps: int, batch_size: int = 128) -> None:
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        self._update_learning_rates()

        critic_losses, actor_losses = [], []
        for _ in range(gradient_steps):
            self._n_updates += 1
            replay_data = self._sample_batch(batch_size)

            critic_loss = self._critic_loss(replay_data)
            critic_losses.append(critic_loss.detach())
            gradient_step(critic_loss, [self.critic.optimizer], name="critic_loss")

            # Delayed policy updates
            if self._n_updates % self.policy_delay == 0:
                actor_loss = self._actor_loss(replay_data)
                actor_losses.append(actor_loss.detach())
                gradient_step(actor_loss, [self.actor.optimizer], name="actor_loss")
                self.update_targets(self.tau)

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/critic_loss", th.stack(critic_losses).mean().item())
        if actor_losses:
            self.logger.record("train/actor_loss", th.stack(actor_losses).mean().item())

    def _update_learning_rates(self) -> None:
        """Set the learning rates of all optimizers according to their schedules."""
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])

    def _smoothed_target_actions(self, next_obs: PyTorchObs, next_masks: th.Tensor | None) -> th.Tensor:
        """:return: (B, actor's outputs) what the target actor puts out, with clipped noise"""
        next_actions = self.policy.actor_outputs(self.actor_target, next_obs, next_masks)
        noise = th.empty_like(next_actions).normal_(0, self.target_policy_noise)
        next_actions = (next_actions + noise.clamp(-self.target_noise_clip, self.target_noise_clip)).clamp(-1, 1)
        return self.policy.mask_outputs(next_actions, next_masks)

    def _next_q_values(self, next_obs: PyTorchObs, next_masks: th.Tensor | None) -> th.Tensor:
        """:return: (B, 1) min_i Q_i(s', pi(s') + noise) of the targets"""
        q_values = self.critic_target(next_obs, self._smoothed_target_actions(next_obs, next_masks))
        return th.cat(q_values, dim=1).min(dim=1, keepdim=True).values

    def _current_q_values(self, replay_data: HybridReplaySamples) -> tuple[th.Tensor, ...]:
        """:return: (B, 1) Q_i(s, a) of every critic"""
        return self.critic(replay_data.observations, replay_data.actions)

    def _critic_loss(self, replay_data: HybridReplaySamples) -> th.Tensor:
        """:return: mean squared Bellman errors, summed over the critics"""
        with th.no_grad():
            next_q_values = self._next_q_values(replay_data.next_observations, replay_data.next_masks)
            target_q_values = replay_data.rewards + (1 - replay_data.dones) * replay_data.discounts * next_q_values
        return th.stack([F.mse_loss(q, target_q_values) for q in self._current_q_values(replay_data)]).sum()

    def _actor_loss(self, replay_data: HybridReplaySamples) -> th.Tensor:
        """:return: the negative mean of Q1(s, pi(s))"""
        obs = replay_data.observations
        return -self.critic.q1_forward(obs, self.policy.actor_outputs(self.actor, obs, replay_data.masks)).mean()

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "actor.optimizer", "critic.optimizer"], []
