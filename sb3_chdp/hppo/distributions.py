"""The distribution of hybrid actions: a categorical choice and a Gaussian over the parameters of all actions."""

import math
from copy import copy
from typing import TypeVar

import torch as th
from sb3_contrib.common.maskable.distributions import (
    MaskableCategoricalDistribution,
    MaskableMultiCategoricalDistribution,
    MaybeMasks,
)
from stable_baselines3.common.distributions import DiagGaussianDistribution
from torch import nn

from sb3_chdp.common.hybrid_box import ConcatenatedBox
from sb3_chdp.common.rows import best_values, pack_bits

SelfHybridDistribution = TypeVar("SelfHybridDistribution", bound="HybridDistribution")


class HybridDistribution(DiagGaussianDistribution):
    """
    A categorical distribution of k, or one of each choice of a factored space, beside a diagonal Gaussian of the P parameters
    of all actions.

    Only the parameters of the chosen action enter the density: the others are not executed. Actions are rows
    ``[k | scaled parameters of all actions | masks]``; the masks are there if the space has the columns.

    Unlike SB3's, it keeps no state: :meth:`proba_distribution` returns a new one, so that threads can share a policy.

    :param action_space: space of the action rows
    """

    def __init__(self, action_space: ConcatenatedBox):
        spec = action_space.spec
        super().__init__(spec.n_parameters)
        self.n_logits = sum(spec.radices)
        self.options_of = spec.options_of
        self.columns = action_space.columns
        self.categorical = self._make_categorical()
        self._masks: MaybeMasks = None
        self._parameter_index = th.tensor(spec.parameter_index)
        self._parameter_mask = th.tensor(spec.parameter_mask, dtype=th.float32)

    def _make_categorical(self) -> MaskableCategoricalDistribution | MaskableMultiCategoricalDistribution:
        radices = self.columns.radices
        if len(radices) == 1:
            return MaskableCategoricalDistribution(radices[0])
        return MaskableMultiCategoricalDistribution(list(radices))

    def proba_distribution_net(self, latent_dim: int, log_std_init: float = 0.0) -> tuple[nn.Module, nn.Parameter]:
        """
        :param latent_dim: dimension of the last layer of the policy
        :param log_std_init: initial value of the log standard deviation
        :return: layer of the K logits and P means, (P,) log standard deviation
        """
        _, log_std = super().proba_distribution_net(latent_dim, log_std_init)
        return nn.Linear(latent_dim, self.n_logits + self.action_dim), log_std

    def proba_distribution(
        self: SelfHybridDistribution, mean_actions: th.Tensor, log_std: th.Tensor
    ) -> SelfHybridDistribution:
        """
        :param mean_actions: (B, K + P) logits and means
        :param log_std: (P,) log standard deviation
        :return: the distribution with these parameters
        """
        logits, means = mean_actions.split([self.n_logits, self.action_dim], dim=1)
        distribution = copy(self)
        distribution.categorical, distribution._masks = self._make_categorical(), None
        distribution.categorical.proba_distribution(logits)
        return DiagGaussianDistribution.proba_distribution(distribution, means, log_std)

    def apply_masking(self, masks: MaybeMasks) -> None:
        """
        :param masks: (B, K) False for discrete actions that may not be taken, (B, sum of the radices) of a factored space;
            None removes a former mask
        :raises ValueError: for another number of masks
        """
        shape = (len(self.distribution.mean), self.n_logits)
        if masks is not None:
            masks = th.as_tensor(masks, dtype=th.bool, device=self.distribution.mean.device)
            if masks.numel() != math.prod(shape):
                raise ValueError(f"action_masks must have shape (n, K) = {shape}, got {tuple(masks.shape)}")
            masks = masks.view(shape)
        self._masks = masks
        self.categorical.apply_masking(masks)

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """
        :param actions: (B, columns) rows; their masks, if they have the columns, are applied
        :return: (B, 2) log-probability of k, log-density of the parameters of k (0 if it has none)
        """
        k, parameters = self.columns.discrete_actions(actions), self.columns.view(actions, "parameters")
        if "masks" in self.columns:
            self.apply_masking(self.columns.masks(actions))
        options = self.options_of(k)
        index = self._parameter_index.to(k.device)[options]
        log_densities = self.distribution.log_prob(parameters).gather(1, index)
        own = self._parameter_mask.to(k.device)[options]
        return th.stack([self.categorical.log_prob(k), (log_densities * own).sum(dim=1)], dim=1)

    def entropy(self) -> th.Tensor:
        """:return: (B,) entropy of the categorical distributions; the Gaussian's is not part of HPPO's objective"""
        return self.categorical.entropy()

    def sample(self) -> th.Tensor:
        """:return: (B, columns) rows"""
        return self._rows(self.categorical.sample(), super().sample())

    def mode(self) -> th.Tensor:
        """:return: (B, columns) rows of the most probable k and the means"""
        return self._rows(self.categorical.mode(), super().mode())

    def actions_from_params(self, mean_actions: th.Tensor, log_std: th.Tensor, deterministic: bool = False) -> th.Tensor:
        """:return: (B, columns) rows for the arguments of :meth:`proba_distribution`"""
        return self.proba_distribution(mean_actions, log_std).get_actions(deterministic)

    def log_prob_from_params(self, mean_actions: th.Tensor, log_std: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """:return: (B, columns) rows for the arguments of :meth:`proba_distribution`, (B, 2) their :meth:`log_prob`"""
        distribution = self.proba_distribution(mean_actions, log_std)
        rows = distribution.sample()
        return rows, distribution.log_prob(rows)

    def most_probable(self, outputs: th.Tensor) -> th.Tensor:
        """
        :param outputs: (B, K + P) logits and means
        :return: (B, columns) rows like :meth:`mode`, without masks and without the checks of a distribution, which no runtime
            but Python knows
        """
        logits, means = outputs.split([self.n_logits, self.action_dim], dim=1)
        return self._rows(best_values(logits, self.columns.radices), means)

    def _rows(self, k: th.Tensor, parameters: th.Tensor) -> th.Tensor:
        parts = {"discrete_actions": k, "parameters": parameters}
        if "masks" in self.columns:
            free = th.ones(k.shape[0], self.n_logits, dtype=th.bool, device=k.device)
            parts["masks"] = pack_bits(free if self._masks is None else th.as_tensor(self._masks))
        return self.columns.pack(**parts)
