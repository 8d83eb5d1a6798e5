"""What the baselines share that are SB3's TD3 on scores and parameters, answering in native actions."""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, Schedule
from stable_baselines3.td3 import TD3
from stable_baselines3.td3.policies import Actor, TD3Policy
from torch import nn

from sb3_chdp.common.hybrid_box import HybridBox, ScoreBox
from sb3_chdp.common.off_policy_algorithm import HybridOffPolicyAlgorithm
from sb3_chdp.common.policies import HybridPolicy
from sb3_chdp.common.utils import default_optimizer_kwargs


class _InvertGradient(th.autograd.Function):
    @staticmethod
    def forward(ctx: Any, actions: th.Tensor) -> th.Tensor:
        ctx.save_for_backward(actions)
        return actions.clamp(-1, 1)

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> th.Tensor:  # type: ignore[override]
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
        return _InvertGradient.apply(actions)


class HybridTD3Policy(HybridPolicy, TD3Policy):
    """
    SB3's TD3 policy on the rows of a hybrid action space.

    Arguments not listed here are those of :class:`stable_baselines3.td3.policies.TD3Policy`; ``optimizer_kwargs`` are
    ``fused=True`` for Adam if None.

    :param inverting_gradients: whether to invert the gradients at the actor's output
    """

    def __init__(self, *args: Any, inverting_gradients: bool = False, **kwargs: Any):
        self.inverting_gradients = inverting_gradients
        if kwargs.get("optimizer_kwargs") is None:
            kwargs["optimizer_kwargs"] = default_optimizer_kwargs(kwargs.get("optimizer_class", th.optim.Adam))
        super().__init__(*args, **kwargs)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Actor:
        actor = super().make_actor(features_extractor)
        if self.inverting_gradients:
            actor.mu = nn.Sequential(*actor.mu, InvertingGradients())
        return actor

    @property
    def noise_dim(self) -> int:
        return self.action_space.shape[0]

    def noisy_rows(self, observation: np.ndarray | dict[str, np.ndarray], noise: np.ndarray) -> np.ndarray:
        self.set_training_mode(False)
        obs_tensor, _ = self.obs_to_tensor(observation)
        with th.no_grad():
            # One environment: the noise has no batch dimension
            noise_tensor = th.as_tensor(noise, dtype=th.float32, device=self.device).view(-1, self.noise_dim)
            return self._noisy_rows(obs_tensor, noise_tensor).cpu().numpy()

    def _noisy_rows(self, obs: PyTorchObs, noise: th.Tensor) -> th.Tensor:
        """:return: rows of the actor with (n, noise_dim) noise on its output"""
        return (self.actor(obs) + noise).clamp(-1, 1)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "inverting_gradients": self.inverting_gradients}


class HybridTD3(HybridOffPolicyAlgorithm, TD3):
    """
    Base class: SB3's TD3 on hybrid actions, by default on the space of K scores and P parameters.

    Parameters not listed here are those of :class:`stable_baselines3.TD3`.

    :param target_policy_noise: standard deviation of the noise on the target actor's output (smoothing); 0: none
    :param policy_delay: actor and targets are updated once every ``policy_delay`` critic updates
    :param action_noise: noise on the actor's output, in place of the Gaussian one
    :param action_layout: how to read an ambiguous action space, see :class:`HybridActionSpec`
    :param exploration_fraction: fraction of the training over which the rate of uniformly random actions is reduced
    :param exploration_initial_eps: initial probability of a uniformly random action
    :param exploration_final_eps: final probability of a uniformly random action
    :param exploration_noise: standard deviation of the Gaussian noise on the actor's output (scores and parameters,
        parameters, or latents), if no ``action_noise`` is given
    :param exploration_initial_noise: initial standard deviation, which falls linearly to ``exploration_noise`` over
        ``exploration_fraction``; None: constant
    :param inverting_gradients: whether the gradients at the actor's output are inverted
    """

    policy: HybridTD3Policy  # type: ignore[assignment]

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
        exploration_noise: float = 0.1,
        exploration_initial_noise: float | None = None,
        inverting_gradients: bool = False,
        action_layout: str = "auto",
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
        self.policy_delay = policy_delay
        self.target_noise_clip = target_noise_clip
        self.target_policy_noise = target_policy_noise
        self.exploration_noise = exploration_noise
        self.exploration_initial_noise = exploration_initial_noise
        self.inverting_gradients = inverting_gradients

        if _init_setup_model:
            self._setup_model()

    def _make_hybrid_space(self) -> HybridBox:
        return ScoreBox(self.action_space, self.action_layout)

    def _network_kwargs(self) -> dict[str, Any]:
        return {"inverting_gradients": self.inverting_gradients}

    def _setup_model(self) -> None:
        initial = self.exploration_noise if self.exploration_initial_noise is None else self.exploration_initial_noise
        self.exploration_noise_schedule = self._exploration_schedule(initial, self.exploration_noise)
        super()._setup_model()
