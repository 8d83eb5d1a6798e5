"""What SB3's on-policy algorithms need to collect rollouts with the user's own hybrid action space."""

from collections.abc import Callable
from typing import Any

import numpy as np
from sb3_contrib.common.maskable.utils import get_action_masks
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer
from stable_baselines3.common.type_aliases import DictRolloutBufferSamples, RolloutBufferSamples
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_chdp.common.checks import check_finite
from sb3_chdp.common.hybrid_box import HybridBox


class NativeActionVecEnv(VecEnvWrapper):
    """
    Environment as ``collect_rollouts`` sees it: it takes rows, which the wrapped one gets as native actions.

    :param venv: the vectorised environment
    :param action_space: space of the rows
    :param set_action_masks: called with the (n_envs, K) action masks of the environment now and after every step; None
        if the environment has none
    :raises ValueError: for masks of another shape; from ``step`` if an observation or a reward is not finite, before
        anything is stored
    """

    def __init__(self, venv: VecEnv, action_space: HybridBox, set_action_masks: Callable[[np.ndarray], None] | None = None):
        super().__init__(venv)
        self.rows = action_space
        self.set_action_masks = set_action_masks
        self._update_masks()

    def _update_masks(self) -> None:
        if self.set_action_masks is not None:
            masks = get_action_masks(self.venv)
            expected = (self.num_envs, self.rows.spec.n_discrete_actions)
            if masks.shape != expected:
                raise ValueError(f"action_masks() must give (n_envs, K) = {expected} booleans, got shape {masks.shape}")
            self.set_action_masks(masks)

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        self.venv.step_async(self.rows.to_native(actions))  # type: ignore[arg-type]  # a list of native actions

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        check_finite("The observation", obs)  # type: ignore[arg-type]
        check_finite("The reward", rewards)
        self._update_masks()
        return obs, rewards, dones, infos


class HybridRolloutBuffer(RolloutBuffer):
    """
    Rollout buffer with two log-probabilities per action, (B, 2) in the samples, and advantages (B, 1) that go with both.
    """

    def reset(self) -> None:
        super().reset()
        self.log_probs = np.zeros((self.buffer_size, self.n_envs, 2), dtype=np.float32)

    def _get_samples(self, *args: Any, **kwargs: Any) -> RolloutBufferSamples:
        samples = super()._get_samples(*args, **kwargs)
        return samples._replace(old_log_prob=samples.old_log_prob.view(-1, 2), advantages=samples.advantages[:, None])


class HybridDictRolloutBuffer(DictRolloutBuffer):
    """:class:`HybridRolloutBuffer` for dict observations."""

    def reset(self) -> None:
        super().reset()
        self.log_probs = np.zeros((self.buffer_size, self.n_envs, 2), dtype=np.float32)

    def _get_samples(self, *args: Any, **kwargs: Any) -> DictRolloutBufferSamples:  # type: ignore[override]
        samples = super()._get_samples(*args, **kwargs)
        return samples._replace(old_log_prob=samples.old_log_prob.view(-1, 2), advantages=samples.advantages[:, None])
