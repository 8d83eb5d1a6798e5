"""Policies of HHQN-TD3: an upper actor of K scores, and a lower actor of P parameters that sees the scores."""

from typing import Any

import torch as th
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.td3.policies import Actor
from torch import nn

from sb3_chdp.common.hybrid_box import ScoreBox
from sb3_chdp.common.policies import CnnFeatures, CombinedFeatures
from sb3_chdp.common.td3 import HybridTD3Policy, InvertingGradients


class HierarchicalActor(Actor):
    """
    Deterministic two-stage actor.

    The arguments are those of SB3's TD3 actor, and

    :param inverting_gradients: whether to invert the gradients at both outputs
    """

    action_space: ScoreBox

    def __init__(self, *args: Any, inverting_gradients: bool = False, **kwargs: Any):
        super().__init__(*args, **kwargs)
        spec = self.action_space.spec
        end = [InvertingGradients()] if inverting_gradients else []

        def mlp(input_dim: int, output_dim: int) -> nn.Sequential:
            layers = create_mlp(input_dim, output_dim, self.net_arch, self.activation_fn, squash_output=True)
            return nn.Sequential(*layers, *end)

        # In place of the one-stage actor
        n_scores = sum(spec.radices)
        self.mu = mlp(self.features_dim, n_scores)
        self.lower = mlp(self.features_dim + n_scores, spec.n_parameters)

    def forward(self, obs: PyTorchObs, noise: th.Tensor | None = None, action_masks: th.Tensor | None = None) -> th.Tensor:
        """
        :param obs: observations
        :param noise: (B, K + P) action noise; the lower actor sees the noisy scores, which decide what is executed
        :param action_masks: (B, K) False for discrete actions that may not be taken; the lower actor sees their scores of -1
        :return: (B, K + P) scores and parameters
        """
        features, columns = self.extract_features(obs, self.features_extractor), self.action_space.columns
        scores = self.mu(features)
        if noise is not None:
            scores = (scores + columns.view(noise, "scores")).clamp(-1, 1)
        if action_masks is not None:
            scores = self.action_space.mask_scores(scores, action_masks)
        parameters = self.lower(th.cat([features, scores], dim=1))
        if noise is not None:
            parameters = (parameters + columns.view(noise, "parameters")).clamp(-1, 1)
        return columns.pack(scores=scores, parameters=parameters)


class HHQNTD3Policy(HybridTD3Policy):
    """Policy class (with both actors and the critics) for HHQN-TD3, see :class:`HybridTD3Policy`."""

    actor: HierarchicalActor

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> HierarchicalActor:
        actor_kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return HierarchicalActor(**actor_kwargs, inverting_gradients=self.inverting_gradients).to(self.device)

    def actor_outputs(self, actor: Actor, obs: PyTorchObs, action_masks: th.Tensor | None) -> th.Tensor:
        return actor(obs, action_masks=action_masks)

    def _noisy_rows(self, obs: PyTorchObs, noise: th.Tensor, action_masks: th.Tensor | None) -> th.Tensor:
        return self._complete(self.actor(obs, noise, action_masks))


MlpPolicy = HHQNTD3Policy


class CnnPolicy(CnnFeatures, HHQNTD3Policy):
    """:class:`HHQNTD3Policy` for images."""


class MultiInputPolicy(CombinedFeatures, HHQNTD3Policy):
    """:class:`HHQNTD3Policy` for dict observations."""
