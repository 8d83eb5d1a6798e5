"""Policies of HPPO: SB3's actor-critic policy with a hybrid distribution."""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule

from sb3_chdp.common.distributions import HybridDistribution
from sb3_chdp.common.hybrid_box import ConcatenatedBox
from sb3_chdp.common.policies import CnnFeatures, CombinedFeatures, HybridPolicy


class HPPOPolicy(HybridPolicy, ActorCriticPolicy):
    """
    Policy class for HPPO (has both policy and value prediction).

    The arguments are those of :class:`stable_baselines3.common.policies.ActorCriticPolicy`, without those of gSDE.
    ``log_std_init`` is -0.5 by default.
    """

    action_space: ConcatenatedBox  # type: ignore[assignment]
    action_dist: HybridDistribution  # type: ignore[assignment]

    def __init__(self, *args: Any, **kwargs: Any):
        self.action_masks: np.ndarray | None = None
        super().__init__(*args, **{"log_std_init": -0.5, **kwargs})

    def _build(self, lr_schedule: Schedule) -> None:
        # In place of the Gaussian that SB3 takes for a Box
        self.action_dist = HybridDistribution(self.action_space)
        super()._build(lr_schedule)

    def set_action_masks(self, action_masks: np.ndarray | None) -> None:
        """
        :param action_masks: (n_envs, K) masks for the next actions, False for discrete actions that may not be taken;
            None for none
        """
        self.action_masks = action_masks

    def _get_action_dist_from_latent(self, latent_pi: th.Tensor) -> Distribution:
        distribution = super()._get_action_dist_from_latent(latent_pi)
        if self.action_masks is not None:
            self.action_dist.apply_masking(self.action_masks)
        return distribution

    def predict(  # type: ignore[override]
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        action_masks: np.ndarray | None = None,
    ) -> tuple[Any, tuple[np.ndarray, ...] | None]:
        """
        Get native actions from observations, see :meth:`HybridPolicy.predict`.

        :param action_masks: (K,) or (n, K) False for discrete actions that may not be taken
        """
        # A callback may predict while a rollout is being collected
        rollout_masks, self.action_masks = self.action_masks, action_masks
        try:
            return super().predict(observation, state, episode_start, deterministic)
        finally:
            self.action_masks = rollout_masks


MlpPolicy = HPPOPolicy


class CnnPolicy(CnnFeatures, HPPOPolicy):
    """:class:`HPPOPolicy` for images."""


class MultiInputPolicy(CombinedFeatures, HPPOPolicy):
    """:class:`HPPOPolicy` for dict observations."""
