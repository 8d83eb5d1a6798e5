"""Policies of HPPO: SB3's actor-critic policy with a hybrid distribution."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from sb3_contrib.common.maskable.distributions import MaybeMasks
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule

from sb3_chdp.common.hybrid_box import ConcatenatedBox
from sb3_chdp.common.policies import CnnFeatures, CombinedFeatures, HybridPolicy
from sb3_chdp.hppo.distributions import HybridDistribution


class HPPOPolicy(HybridPolicy, ActorCriticPolicy):
    """
    Policy class for HPPO (has both policy and value prediction).

    The arguments are those of :class:`stable_baselines3.common.policies.ActorCriticPolicy`, without those of gSDE.
    ``log_std_init`` is -0.5 by default.
    """

    action_space: ConcatenatedBox
    action_dist: HybridDistribution
    # What allows actions in rollouts, where SB3 hands no masks on
    rollout_masks: Callable[[], np.ndarray | None] | None = None

    def __init__(self, *args: Any, **kwargs: Any):
        net_arch = kwargs.get("net_arch")
        if isinstance(net_arch, dict) and not net_arch.keys() <= {"pi", "vf"}:
            # The network that is not named would have no hidden layer
            raise ValueError(f"net_arch must have no keys but 'pi' and 'vf', got {net_arch}")
        super().__init__(*args, **{"log_std_init": -0.5, **kwargs})

    def _build(self, lr_schedule: Schedule) -> None:
        # In place of the Gaussian that SB3 takes for a Box
        self.action_dist = HybridDistribution(self.action_space)
        super()._build(lr_schedule)

    def forward(
        self, obs: PyTorchObs, deterministic: bool = False, action_masks: MaybeMasks = None
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """
        :param obs: observations
        :param deterministic: whether to take the most probable discrete actions and their mean parameters
        :param action_masks: (n, K) False for discrete actions that may not be taken
        :return: (n, columns) rows, (n, 1) values, (n, 2) log-probabilities of both parts of the actions
        """
        features = self.extract_features(obs)
        pi_features, vf_features = (features, features) if isinstance(features, th.Tensor) else features
        values = self.value_net(self.mlp_extractor.forward_critic(vf_features))
        distribution = self._get_action_dist_from_latent(self.mlp_extractor.forward_actor(pi_features))
        assert isinstance(distribution, HybridDistribution)
        distribution.apply_masking(action_masks if self.rollout_masks is None else self.rollout_masks())
        rows = distribution.get_actions(deterministic=deterministic)
        return rows, values, distribution.log_prob(rows)

    def get_distribution(self, obs: PyTorchObs, action_masks: MaybeMasks = None) -> HybridDistribution:
        """
        :param obs: observations
        :param action_masks: (n, K) False for discrete actions that may not be taken
        :return: the distribution of their actions
        """
        distribution = super().get_distribution(obs)
        assert isinstance(distribution, HybridDistribution)
        distribution.apply_masking(action_masks)
        return distribution

    def _predict(self, observation: PyTorchObs, deterministic: bool = False, action_masks: MaybeMasks = None) -> th.Tensor:
        """:return: (n, columns) rows"""
        if deterministic and action_masks is None:
            features = BasePolicy.extract_features(self, observation, self.pi_features_extractor)
            return self.action_dist.most_probable(self.action_net(self.mlp_extractor.forward_actor(features)))
        return self.get_distribution(observation, action_masks).get_actions(deterministic=deterministic)


MlpPolicy = HPPOPolicy


class CnnPolicy(CnnFeatures, HPPOPolicy):
    """:class:`HPPOPolicy` for images."""


class MultiInputPolicy(CombinedFeatures, HPPOPolicy):
    """:class:`HPPOPolicy` for dict observations."""
