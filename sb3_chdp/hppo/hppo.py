"""Hybrid proximal policy optimization."""

import math
import warnings
from collections.abc import Sequence
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.vec_env import VecEnv
from torch.autograd.graph import register_multi_grad_hook

from sb3_chdp.common.arguments import (
    A_DICT,
    FRACTION,
    NOT_NEGATIVE,
    POSITIVE,
    SWITCH,
    Accepted,
    check_device,
    is_class_of,
    optional,
    scheduled,
    whole,
)
from sb3_chdp.common.base_class import HYBRID_SPACES, HybridAlgorithm
from sb3_chdp.common.hybrid_box import ConcatenatedBox, HybridBox
from sb3_chdp.common.utils import LARGEST_NORM, NonFiniteLossError, floats
from sb3_chdp.hppo.policies import CnnPolicy, HPPOPolicy, MlpPolicy, MultiInputPolicy
from sb3_chdp.hppo.rollout_buffers import HybridDictRolloutBuffer, HybridRolloutBuffer

SelfHPPO = TypeVar("SelfHPPO", bound="HPPO")


def check_gradients(gradients: Sequence[th.Tensor | None]) -> None:
    """
    :param gradients: those of one loss
    :raises NonFiniteLossError: if their common norm is not finite: clipped to a norm, they would be 0
    """
    norm = math.hypot(*floats(th._foreach_norm([gradient for gradient in gradients if gradient is not None])))
    if not norm <= LARGEST_NORM:
        raise NonFiniteLossError("loss", norm)


class HPPO(HybridAlgorithm, PPO):
    """
    Hybrid Proximal Policy Optimization (HPPO)

    A categorical policy chooses the discrete action, a Gaussian policy the parameters; each has its own clipped ratio.

    Paper: Fan et al. (2019), https://arxiv.org/abs/1903.01344. Reference scripts: HyAR repository.

    Differences from the reference scripts:
        1. the log-probability of the action taken (there: the highest probability of all actions);
        2. only the parameters of the executed action enter the density (there: those of all actions);
        3. unclipped samples are stored, and clipped for the environment only (there: before the density is computed);
        4. PPO's advantages and returns: a terminal state is worth 0, a time limit bootstraps (there: the last reward is
           counted twice, and advantages run on into the next episode);
        5. evaluation with the most probable action and its mean parameters (there: sampled);
        6. one optimizer, entropy bonus for the discrete action, minibatches and their number as in PPO;
        7. linear means (there tanh), one log standard deviation per parameter (there the sum of ten);
        8. the mean over both heads of the clipped loss (there: the sum), which is the sum with ``ent_coef`` and
           ``vf_coef`` twice as large;
        9. a mask of the discrete actions, if the environment has ``action_masks()``.

    :param policy: The policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: The environment to learn from (if registered in Gym, can be str), with a hybrid action space
    :param learning_rate: The learning rate, it can be a function
        of the current progress remaining (from 1 to 0)
    :param n_steps: The number of steps to run for each environment per update
        (i.e. rollout buffer size is n_steps * n_envs where n_envs is number of environment copies running in parallel)
    :param batch_size: Minibatch size, at least 2
    :param n_epochs: Number of epoch when optimizing the surrogate loss
    :param gamma: Discount factor
    :param gae_lambda: Factor for trade-off of bias vs variance for Generalized Advantage Estimator
    :param clip_range: Clipping parameter of both heads, it can be a function of the current progress
        remaining (from 1 to 0).
    :param clip_range_vf: Clipping parameter for the value function, see :class:`stable_baselines3.PPO`
    :param normalize_advantage: Whether to normalize or not the advantage
    :param ent_coef: Entropy coefficient of the discrete action for the loss calculation
    :param vf_coef: Value function coefficient for the loss calculation
    :param max_grad_norm: The maximum value for the gradient clipping
    :param rollout_buffer_class: Rollout buffer class to use, a :class:`HybridRolloutBuffer` or
        :class:`HybridDictRolloutBuffer`. If ``None``, it will be automatically selected.
    :param rollout_buffer_kwargs: Keyword arguments to pass to the rollout buffer on creation
    :param target_kl: Limit the KL divergence between updates, the mean over both heads
    :param action_layout: how to read an ambiguous action space, see :class:`HybridActionSpec`
    :param use_masking: whether to ask the environment for ``action_masks()`` and to take no discrete action that they forbid,
        see :func:`sb3_chdp.common.masks.read_masks`; None: if it has such a method
    :param stats_window_size: Window size for the rollout logging, specifying the number of episodes to average
        the reported success rate, mean episode length, and mean reward over
    :param tensorboard_log: the log location for tensorboard (if None, no logging)
    :param policy_kwargs: additional arguments to be passed to the policy on creation, see :class:`HPPOPolicy`
    :param verbose: Verbosity level: 0 for no output, 1 for info messages (such as device or wrappers used), 2 for
        debug messages
    :param seed: Seed for the pseudo random generators
    :param device: Device (cpu, cuda, ...) on which the code should be run.
        Setting it to auto, the code will be run on the GPU if possible.
    :param _init_setup_model: Whether or not to build the network at the creation of the instance
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    accepted_arguments: ClassVar[dict[str, Accepted]] = {
        # Advantages are normalised over a minibatch
        "batch_size": whole(2),
        "n_epochs": whole(1),
        "gae_lambda": FRACTION,
        "clip_range": scheduled(POSITIVE),
        "clip_range_vf": optional(scheduled(POSITIVE)),
        "normalize_advantage": SWITCH,
        "ent_coef": NOT_NEGATIVE,
        "vf_coef": NOT_NEGATIVE,
        "max_grad_norm": POSITIVE,
        "target_kl": optional(POSITIVE),
        "rollout_buffer_kwargs": optional(A_DICT),
    }
    policy: HPPOPolicy

    def __init__(
        self,
        policy: str | type[HPPOPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        n_steps: int = 2048,
        batch_size: int = 64,
        n_epochs: int = 10,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        clip_range: float | Schedule = 0.2,
        clip_range_vf: float | Schedule | None = None,
        normalize_advantage: bool = True,
        ent_coef: float = 0.01,
        vf_coef: float = 0.5,
        max_grad_norm: float = 0.5,
        rollout_buffer_class: type[RolloutBuffer] | None = None,
        rollout_buffer_kwargs: dict[str, Any] | None = None,
        target_kl: float | None = None,
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
        check_device(device)
        # Not PPO's constructor, which accepts no hybrid action spaces and hands on no other list of spaces
        OnPolicyAlgorithm.__init__(
            self,
            policy,
            env,
            learning_rate=learning_rate,
            n_steps=n_steps,
            gamma=gamma,
            gae_lambda=gae_lambda,
            ent_coef=ent_coef,
            vf_coef=vf_coef,
            max_grad_norm=max_grad_norm,
            use_sde=False,
            sde_sample_freq=-1,
            rollout_buffer_class=rollout_buffer_class,
            rollout_buffer_kwargs=rollout_buffer_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            device=device,
            seed=seed,
            _init_setup_model=False,
            supported_action_spaces=HYBRID_SPACES,
        )
        self.batch_size = batch_size
        self.n_epochs = n_epochs
        self.clip_range = clip_range
        self.clip_range_vf = clip_range_vf
        self.normalize_advantage = normalize_advantage
        self.target_kl = target_kl
        self.action_layout = action_layout
        self.use_masking = use_masking

        if _init_setup_model:
            self._setup_model()

    def _make_hybrid_space(self, action_layout: str) -> HybridBox:
        return ConcatenatedBox(self.action_space, action_layout, ("masks",) if self.use_masking else ())

    def _setup_model(self) -> None:
        self._settle_arguments()
        hybrid_class = HybridDictRolloutBuffer if isinstance(self.observation_space, spaces.Dict) else HybridRolloutBuffer
        self.rollout_buffer_class = self.rollout_buffer_class or hybrid_class
        if not is_class_of(self.rollout_buffer_class, hybrid_class):
            raise ValueError(f"rollout_buffer_class must be a {hybrid_class.__name__}, got {self.rollout_buffer_class}")
        super()._setup_model()
        buffer_size = self.n_steps * self.n_envs
        if buffer_size % self.batch_size > 0:
            warnings.warn(
                f"The last minibatch of an epoch has only {buffer_size % self.batch_size} transitions: n_steps * n_envs = "
                f"{buffer_size} is no multiple of batch_size={self.batch_size}"
            )

    def collect_rollouts(self, env: VecEnv, *args: Any, **kwargs: Any) -> bool:
        """SB3's ``collect_rollouts``, with masks for the policy and rows that the environment gets as native actions."""
        self.policy.rollout_masks = self._action_masks
        try:
            goes_on = super().collect_rollouts(self.row_env(env), *args, **kwargs)
        finally:
            self.policy.rollout_masks = None
        if not goes_on:
            self._last_obs = None  # the last step is not stored: learning begins with a reset again
        return goes_on

    def train(self) -> None:
        """PPO's: log-probabilities have two columns, so the discrete action and its parameters have a ratio each."""
        # One bad return lies in one minibatch: those before would move the policy
        returns = self.rollout_buffer.returns
        sum_of_squares = float(np.vdot(returns, returns))
        if not np.isfinite(sum_of_squares):
            raise NonFiniteLossError("value_loss", sum_of_squares)
        hook = register_multi_grad_hook([p for p in self.policy.parameters() if p.requires_grad], check_gradients)
        try:
            super().train()
        finally:
            hook.remove()

    def dump_logs(self, iteration: int = 0) -> None:
        if iteration > 0:
            # A resumed run goes on counting, learn() begins at 1
            iteration = (self.num_timesteps - self._num_timesteps_at_start) // (self.n_steps * self.n_envs)
        super().dump_logs(iteration)

    def learn(
        self: SelfHPPO,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "HPPO",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfHPPO:
        return super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )
