"""The distribution of hybrid actions: a categorical choice and a Gaussian over the parameters of all actions."""

import math
from copy import copy
from typing import TypeVar

import numpy as np
import torch as th
from sb3_contrib.common.maskable.distributions import MaskableCategoricalDistribution, MaybeMasks
from stable_baselines3.common.distributions import DiagGaussianDistribution
from torch import nn

from sb3_chdp.common.hybrid_box import ConcatenatedBox

SelfHybridDistribution = TypeVar("SelfHybridDistribution", bound="HybridDistribution")


class HybridDistribution(DiagGaussianDistribution):
    """
    A categorical distribution of k beside a diagonal Gaussian of the P parameters of all actions.

    Only the parameters of the chosen action enter the density: the others are not executed. Actions are rows
    ``[k | scaled parameters of all actions | masks]``; the masks are there if the space has the columns.

    Unlike SB3's, it keeps no state: :meth:`proba_distribution` returns a new one, so that threads can share a policy.

    :param action_space: space of the action rows
    """

    def __init__(self, action_space: ConcatenatedBox):
        spec = action_space.spec
        super().__init__(spec.n_parameters)
        self.n_discrete_actions = spec.n_discrete_actions
        self.columns = action_space.columns
        self.categorical = MaskableCategoricalDistribution(spec.n_discrete_actions)
        self._parameter_index = th.tensor(spec.parameter_index)
        self._parameter_mask = th.tensor(spec.mask, dtype=th.float32)

    def proba_distribution_net(self, latent_dim: int, log_std_init: float = 0.0) -> tuple[nn.Module, nn.Parameter]:
        """
        :param latent_dim: dimension of the last layer of the policy
        :param log_std_init: initial value of the log standard deviation
        :return: layer of the K logits and P means, (P,) log standard deviation
        """
        _, log_std = super().proba_distribution_net(latent_dim, log_std_init)
        return nn.Linear(latent_dim, self.n_discrete_actions + self.action_dim), log_std

    def proba_distribution(
        self: SelfHybridDistribution, mean_actions: th.Tensor, log_std: th.Tensor
    ) -> SelfHybridDistribution:
        """
        :param mean_actions: (B, K + P) logits and means
        :param log_std: (P,) log standard deviation
        :return: the distribution with these parameters
        """
        logits, means = mean_actions.split([self.n_discrete_actions, self.action_dim], dim=1)
        distribution = copy(self)
        distribution.categorical = MaskableCategoricalDistribution(self.n_discrete_actions)
        distribution.categorical.proba_distribution(logits)
        return DiagGaussianDistribution.proba_distribution(distribution, means, log_std)

    def apply_masking(self, masks: MaybeMasks) -> None:
        """
        :param masks: (B, K) False for discrete actions that may not be taken; None removes a former mask
        :raises ValueError: for another number of masks
        """
        shape = self.categorical.distribution.logits.shape
        if masks is not None and math.prod(np.shape(masks)) != math.prod(shape):
            raise ValueError(f"action_masks must have shape (n, K) = {tuple(shape)}, got {tuple(np.shape(masks))}")
        self.categorical.apply_masking(masks)

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: (B, columns) rows; their masks, if they have the columns, are applied
        :return: (B, 2) log-probability of k, log-density of the parameters of k (0 if it has none)
        """
        k, parameters = self.columns.discrete_actions(actions), self.columns.view(actions, "parameters")
        if "masks" in self.columns:
            self.apply_masking(self.columns.view(actions, "masks"))
        index = self._parameter_index.to(k.device)[k]
        log_densities = self.distribution.log_prob(parameters).gather(1, index)
        own = self._parameter_mask.to(k.device)[k]
        return th.stack([self.categorical.log_prob(k), (log_densities * own).sum(dim=1)], dim=1)

    def entropy(self) -> th.Tensor:
        """:return: (B,) entropy of the categorical distribution; the Gaussian's is not part of HPPO's objective"""
        return self.categorical.entropy()

    def sample(self) -> th.Tensor:
        """:return: (B, columns) rows"""
        return self._rows(self.categorical.sample(), super().sample(), self.categorical.distribution.masks)

    def mode(self) -> th.Tensor:
        """:return: (B, columns) rows of the most probable k and the means"""
        return self._rows(self.categorical.mode(), super().mode(), self.categorical.distribution.masks)

    def most_probable(self, outputs: th.Tensor) -> th.Tensor:
        """
        :param outputs: (B, K + P) logits and means
        :return: (B, columns) rows like :meth:`mode`, without masks and without the checks of a distribution, which no runtime
            but Python knows
        """
        logits, means = outputs.split([self.n_discrete_actions, self.action_dim], dim=1)
        return self._rows(logits.argmax(dim=1), means, None)

    def _rows(self, k: th.Tensor, parameters: th.Tensor, masks: th.Tensor | None) -> th.Tensor:
        parts = {"discrete_actions": k, "parameters": parameters}
        if "masks" in self.columns:
            parts["masks"] = th.ones(k.shape[0], self.n_discrete_actions, device=k.device) if masks is None else masks
        return self.columns.pack(**parts)
