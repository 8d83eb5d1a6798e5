"""What SB3's OffPolicyAlgorithm needs to work with the user's own hybrid action space."""

import io
import pathlib
import warnings
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.her import HerReplayBuffer

from sb3_chdp.common.arguments import (
    A_DICT,
    FRACTION,
    SWITCH,
    TRAIN_FREQ,
    Accepted,
    check,
    check_device,
    is_class_of,
    optional,
    whole,
)
from sb3_chdp.common.base_class import HYBRID_SPACES, HybridAlgorithm
from sb3_chdp.common.buffer_file import check_buffer, load_buffer, save_buffer
from sb3_chdp.common.checks import check_numbers, check_replayed_observations, warn_of_memory
from sb3_chdp.common.hybrid_box import HybridBox
from sb3_chdp.common.masks import last_masks
from sb3_chdp.common.n_step_buffer import TELLS_LAST, n_step_settings
from sb3_chdp.common.policies import HybridPolicy
from sb3_chdp.common.row_env import with_original_ends
from sb3_chdp.common.rows import MASK_PARTS, pack_bits
from sb3_chdp.common.safe_zip import refuse
from sb3_chdp.common.samples import HybridReplaySamples, name_columns
from sb3_chdp.common.trajectories import end_trajectories
from sb3_chdp.common.utils import TargetUpdate

SelfHybridOffPolicyAlgorithm = TypeVar("SelfHybridOffPolicyAlgorithm", bound="HybridOffPolicyAlgorithm")


class HybridOffPolicyAlgorithm(HybridAlgorithm, OffPolicyAlgorithm):
    """
    Base class of off-policy algorithms for hybrid action spaces.

    :param args: SB3's, see :class:`OffPolicyAlgorithm`
    :param action_layout: how to read an ambiguous action space, see :class:`HybridActionSpec`
    :param use_masking: whether to ask the environment for ``action_masks()`` and to take no discrete action that they forbid,
        see :func:`sb3_chdp.common.masks.read_masks`; None: if it has such a method
    :param device: Device (cpu, cuda, ...) on which the code should be run; auto: the GPU if possible
    :param kwargs: SB3's
    """

    accepted_arguments: ClassVar[dict[str, Accepted]] = {
        "buffer_size": whole(1),
        "learning_starts": whole(0),
        "tau": FRACTION,
        "train_freq": TRAIN_FREQ,
        "gradient_steps": whole(-1),
        "optimize_memory_usage": SWITCH,
        "policy_delay": whole(1),
        "action_noise": optional(Accepted("an ActionNoise of SB3's", lambda value: isinstance(value, ActionNoise))),
        "replay_buffer_class": optional(Accepted("a class of replay buffers", lambda value: is_class_of(value, ReplayBuffer))),
        "replay_buffer_kwargs": optional(A_DICT),
    }
    # Replay buffers where the user names none, that of dict observations second; None or to save memory: SB3's
    default_buffer_classes: ClassVar[tuple[type[ReplayBuffer], type[ReplayBuffer]] | None] = None
    policy: HybridPolicy
    # Those of the policy
    actor: Any
    actor_target: Any
    critic: Any
    critic_target: Any

    def __init__(
        self,
        *args: Any,
        action_layout: str = "auto",
        use_masking: bool | None = None,
        device: th.device | str = "auto",
        **kwargs: Any,
    ):
        check_device(device)
        kwargs |= dict(device=device, sde_support=False, supported_action_spaces=HYBRID_SPACES, support_multi_env=True)
        super().__init__(*args, **kwargs)
        self.action_layout = action_layout
        self.use_masking = use_masking

    def _setup_model(self) -> None:
        self._settle_arguments()
        given = self.replay_buffer_class, self.replay_buffer_kwargs
        try:
            with warnings.catch_warnings():
                has_dicts = isinstance(self.observation_space, spaces.Dict)
                defaults = None if self.optimize_memory_usage else self.default_buffer_classes
                default = defaults and defaults[has_dicts]
                settings = n_step_settings(given[0], given[1] or {}, self.n_steps, self.gamma, has_dicts, default)
                self.replay_buffer_class, self.replay_buffer_kwargs = settings
                if is_class_of(self.replay_buffer_class, NStepReplayBuffer):
                    warnings.filterwarnings("ignore", message="`n_steps=")  # that it does not count
                if self._state_parts():
                    check(TELLS_LAST, replay_buffer_class=self.replay_buffer_class)
                super()._setup_model()
        except MemoryError as error:
            raise ValueError(
                f"buffer_size must be such that the replay buffer fits into the memory, got {self.buffer_size}: {error}. "
                "With replay_buffer_kwargs=dict(handle_timeout_termination=False), optimize_memory_usage=True halves what "
                "observations need"
            ) from error
        finally:
            # What follows from other arguments is chosen anew when the model is loaded with other ones
            self.replay_buffer_class, self.replay_buffer_kwargs = given
        assert self.replay_buffer is not None
        warn_of_memory(self.replay_buffer)
        self._create_aliases()

    def _create_aliases(self) -> None:
        """Name the parts of the policy; to be overridden where it has others than an actor, critics and their targets."""
        self.actor, self.actor_target = self.policy.actor, self.policy.actor_target
        self.critic, self.critic_target = self.policy.critic, self.policy.critic_target
        self.update_targets = TargetUpdate([self.actor, self.critic], [self.actor_target, self.critic_target])

    def learn(
        self: SelfHybridOffPolicyAlgorithm,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfHybridOffPolicyAlgorithm:
        """SB3's ``learn``; the name of the tensorboard log is by default that of the class."""
        super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name or type(self).__name__,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )
        if self._n_updates == 0:
            is_early = self.num_timesteps <= self.learning_starts
            reason = f"the first learning_starts={self.learning_starts} steps are random" if is_early else "no update was due"
            warnings.warn(f"Nothing is learnt yet: {reason}, and training ended after {self.num_timesteps}")
        return self

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """
        Save the replay buffer as JSON and arrays. A custom one is pickled, as SB3 does it, and needs
        ``load_replay_buffer(..., trusted=True)``.

        :param path: the file; SB3's suffix ``.pkl`` is appended if there is none
        """
        assert self.replay_buffer is not None, "The replay buffer is not defined"
        if not save_buffer(self.replay_buffer, path):
            super().save_replay_buffer(path)

    def load_replay_buffer(
        self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True, trusted: bool = False
    ) -> None:
        """
        Load a replay buffer. No code of the file's runs unless it is ``trusted``.

        :param path: the file
        :param truncate_last_traj: for ``HerReplayBuffer``: whether the last trajectory in the buffer counts as finished
        :param trusted: whether a pickled file may be read, which runs whatever code the file's author put there
        :raises ValueError: if the file is of a version that does not fit, if it is pickled and not trusted, or if the buffer
            is of another class, for other spaces or another number of environments than the model's
        """
        buffer = load_buffer(path)
        if buffer is None and not trusted:
            raise refuse(path, "holds a replay buffer in pickled form")
        own = self.replay_buffer
        try:
            if buffer is None:
                super().load_replay_buffer(path, truncate_last_traj)
                buffer = self.replay_buffer
            elif isinstance(buffer, HerReplayBuffer):
                assert self.env is not None, "You must pass an environment at load time when using `HerReplayBuffer`"
                buffer.set_env(self.env)
                if truncate_last_traj:
                    buffer.truncate_last_trajectory()
            assert buffer is not None
            check_buffer(path, buffer, own)
        except BaseException:
            self.replay_buffer = own
            raise
        self.replay_buffer, self.buffer_size = buffer, buffer.buffer_size * self.n_envs
        buffer.device = self.device

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        super().set_env(env, force_reset)
        if isinstance(self.replay_buffer, HerReplayBuffer):
            self.replay_buffer.env = self.env  # which it asks for the rewards of other goals

    def collect_rollouts(self, env: VecEnv, *args: Any, **kwargs: Any) -> RolloutReturn:
        """SB3's ``collect_rollouts``, in which actions are rows."""
        rollout = super().collect_rollouts(self.row_env(env), *args, **kwargs)
        if not rollout.continue_training:
            self._last_obs = None  # the last step was not stored: learning begins with a reset again
        return rollout

    def _setup_learn(
        self, total_timesteps: int, callback: MaybeCallback = None, reset_num_timesteps: bool = True, *args: Any, **kwargs: Any
    ) -> tuple[int, BaseCallback]:
        check_replayed_observations(self.env)
        if isinstance(self.action_noise, VectorizedActionNoise) and self.action_noise.n_envs != self.n_envs:
            self.action_noise = self.action_noise.base_noise  # which SB3 takes as many times as there are environments now
        if self.replay_buffer is not None and (reset_num_timesteps or self._last_obs is None):
            end_trajectories(self.replay_buffer)  # the environment is reset
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **kwargs)

    def _sample_action(
        self,
        learning_starts: int,
        action_noise: ActionNoise | None = None,
        n_envs: int = 1,
    ) -> tuple[np.ndarray, np.ndarray]:
        """
        :param learning_starts: number of steps with uniformly random actions only
        :param action_noise: noise that is added to what the policy puts out
        :param n_envs: number of environments
        :return: (n_envs, columns) rows, the same for the environment and for the replay buffer
        """
        rng = self.action_space.np_random
        masks = self._action_masks()
        rows = self._choose_rows(learning_starts, action_noise, n_envs, rng, masks)
        if masks is not None:
            self.hybrid_space.columns.view(rows, "masks")[:] = pack_bits(masks)
        return rows, rows

    def _choose_rows(
        self,
        learning_starts: int,
        action_noise: ActionNoise | None,
        n_envs: int,
        rng: np.random.Generator,
        masks: np.ndarray | None,
    ) -> np.ndarray:
        if self.num_timesteps < learning_starts:
            return self.policy.random_rows(rng, n_envs, masks)
        explores = rng.random(n_envs) < self._exploration_rate()
        noise = self._draw_noise(n_envs) if action_noise is None else action_noise()
        obs = self._last_obs
        assert obs is not None, "self._last_obs was not set"
        if noise is None:
            rows = self.policy.predict_rows(obs, action_masks=masks)
        else:
            if np.size(noise) != n_envs * self.policy.noise_dim:
                raise ValueError(
                    f"action_noise must have size {self.policy.noise_dim} per environment, got shape {np.shape(noise)} "
                    f"for {n_envs} environment(s)"
                )
            check_numbers("action_noise", np.reshape(noise, (n_envs, -1)))
            rows = self.policy.noisy_rows(obs, noise, masks)
        if explores.any():
            rows[explores] = self._exploratory_rows(rows, np.flatnonzero(explores), rng, masks)
        return rows

    def _exploration_rate(self) -> float:
        """:return: probability that exploration takes the place of the policy"""
        return 0.0

    def _exploratory_rows(
        self, rows: np.ndarray, envs: np.ndarray, rng: np.random.Generator, masks: np.ndarray | None
    ) -> np.ndarray:
        """
        :param rows: (n_envs, columns) what the policy would do
        :param envs: (n,) indices of the environments that explore
        :param rng: random generator
        :param masks: (n_envs, K) False for discrete actions that may not be taken, None if all may
        :return: (n, columns) what they do instead: uniformly random actions
        """
        return self.policy.random_rows(rng, len(rows), masks)[envs]

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: Any,
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """SB3's, with the masks of the next states, and last observations that ``VecNormalize`` has not rounded."""
        masks = self._action_masks()
        if masks is not None:
            columns = self.hybrid_space.columns
            next_masks = last_masks(self.hybrid_space.spec, columns.masks(buffer_action), masks, dones, infos)
            columns.view(buffer_action, "next_masks")[:] = pack_bits(next_masks)
        normalize = self._vec_normalize_env
        if normalize is None:
            super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
            return
        # SB3 would write normalised last observations of episodes into an array of whole numbers, if originals are such
        original_obs, infos = normalize.get_original_obs(), with_original_ends(normalize, infos)
        self._last_obs, self._vec_normalize_env = self._last_original_obs, None
        try:
            rewards = normalize.get_original_reward()
            super()._store_transition(replay_buffer, buffer_action, original_obs, rewards, dones, infos)
        finally:
            self._vec_normalize_env = normalize
        self._last_obs, self._last_original_obs = new_obs, original_obs

    def _draw_noise(self, n_envs: int) -> np.ndarray | None:
        """:return: (n_envs, noise_dim) noise on what the policy puts out if there is no ``action_noise``; None: no noise"""
        return None

    def _on_step(self) -> None:
        super()._on_step()
        self.logger.record("rollout/exploration_rate", self._exploration_rate())

    def _excluded_save_params(self) -> list[str]:
        parts_of_policy = ["actor", "critic", "actor_target", "critic_target", "update_targets"]
        return [*super()._excluded_save_params(), *parts_of_policy]

    def _make_hybrid_space(self, action_layout: str) -> HybridBox:
        return HybridBox(self.action_space, action_layout, state_parts=self._state_parts())

    def _state_parts(self) -> tuple[str, ...]:
        """:return: what rows hold about the states before and after an action"""
        return MASK_PARTS if self.use_masking else ()

    def _sample_batch(self, batch_size: int) -> HybridReplaySamples:
        assert self.replay_buffer is not None
        replay_data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
        return name_columns(replay_data, self.hybrid_space, self.gamma)
