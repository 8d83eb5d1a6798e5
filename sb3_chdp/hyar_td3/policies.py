"""Policies of HyAR-TD3: a TD3 policy in the latent space of an action representation."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule

from sb3_chdp.common.hybrid_box import HybridBox
from sb3_chdp.common.policies import CnnFeatures, CombinedFeatures
from sb3_chdp.common.product_table import block_widths
from sb3_chdp.common.td3 import HybridTD3Policy
from sb3_chdp.hyar_td3.representation import ActionRepresentation, FactoredActionRepresentation


class HyARTD3Policy(HybridTD3Policy):
    """
    Policy class (with actor, critic and action representation) for HyAR-TD3.

    Actor and critic work on latents in [-1, 1]. The representation sees the features of the target critic, which are the
    observation itself for vectors. The arguments are those of :class:`HybridTD3Policy`, and

    :param embedding_dim: width of the embedding of a discrete action, at most that of one choice of a factored space
    :param representation_hidden_dim: units of the hidden layers of the representation
    """

    action_space: HybridBox

    def __init__(self, *args: Any, embedding_dim: int = 6, representation_hidden_dim: int = 256, **kwargs: Any):
        self.embedding_dim = embedding_dim
        self.representation_hidden_dim = representation_hidden_dim
        super().__init__(*args, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        latent_dim = self.action_space.stored_latent_dim
        latent_space = spaces.Box(-1.0, 1.0, (latent_dim,), dtype=np.float32)
        self.actor_kwargs["action_space"] = self.critic_kwargs["action_space"] = latent_space
        super()._build(lr_schedule)
        spec, features_dim = self.action_space.spec, self.critic_target.features_extractor.features_dim
        #: width of the embeddings of all choices
        self.embedding_width = sum(block_widths(spec.radices, self.embedding_dim))
        latent_dims = (self.embedding_dim, latent_dim - self.embedding_width, self.representation_hidden_dim)
        self.representation: ActionRepresentation
        if spec.is_factored:
            self.representation = FactoredActionRepresentation(features_dim, spec.radices, spec.max_parameters, *latent_dims)
        else:
            self.representation = ActionRepresentation(features_dim, th.tensor(spec.parameter_mask), *latent_dims)
        make: Callable[..., th.optim.Optimizer] = self.optimizer_class
        # The learning rate is set before every update
        self.representation_optimizer = make(self.representation.parameters(), lr=lr_schedule(1), **self.optimizer_kwargs)

    def state_features(self, obs: PyTorchObs) -> th.Tensor:
        """:return: (B, features_dim) features for the representation, without gradient"""
        with th.no_grad():
            return self.critic_target.extract_features(obs, self.critic_target.features_extractor)

    def decode(self, obs: PyTorchObs, latents: th.Tensor, action_masks: th.Tensor | None = None) -> th.Tensor:
        """
        :param obs: observations
        :param latents: (B, latent_dim) in [-1, 1]
        :param action_masks: (B, K) False for discrete actions that may not be taken
        :return: (B, columns) rows, with z not scaled: bounds may change before it is used
        """
        latents = self.mask_outputs(latents, action_masks)
        embeddings, scaled_z = latents[:, : self.embedding_width], latents[:, self.embedding_width :]
        k = self.representation.nearest_action(embeddings, action_masks)
        z = self.representation.unscale(scaled_z)
        parameters, _ = self.representation.decode(self.state_features(obs), k, z)
        stored_latents = th.cat([embeddings, z], dim=1)
        return self.action_space.columns.pack(discrete_actions=k, parameters=parameters, latents=stored_latents)

    def mask_outputs(self, outputs: th.Tensor, action_masks: th.Tensor | None) -> th.Tensor:
        """
        :param outputs: (B, latent_dim) latents
        :param action_masks: (B, K) False for discrete actions that may not be taken
        :return: latents with the nearest allowed embedding in place of one that stands for a forbidden action; the gradient
            is that of the embedding that was put out
        """
        if action_masks is None:
            return outputs
        embeddings = outputs[:, : self.embedding_width]
        moves = self.representation.to_allowed(embeddings, action_masks) - embeddings.detach()
        return outputs + th.nn.functional.pad(moves, (0, outputs.shape[1] - self.embedding_width))

    def _predict(
        self, observation: PyTorchObs, deterministic: bool = False, action_masks: th.Tensor | None = None
    ) -> th.Tensor:
        return self.decode(observation, self.actor(observation), action_masks)

    def _noisy_rows(self, obs: PyTorchObs, noise: th.Tensor, action_masks: th.Tensor | None) -> th.Tensor:
        return self.decode(obs, (self.actor(obs) + noise).clamp(-1, 1), action_masks)

    def random_rows(self, rng: np.random.Generator, n: int, masks: np.ndarray | None = None) -> np.ndarray:
        """Uniformly random actions; their latents are unknown (NaN) until they are looked at by the representation."""
        rows = super().random_rows(rng, n, masks)
        self.action_space.columns.view(rows, "latents")[:] = np.nan
        return rows

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = dict(embedding_dim=self.embedding_dim, representation_hidden_dim=self.representation_hidden_dim)
        return {**super()._get_constructor_parameters(), **own}


MlpPolicy = HyARTD3Policy


class CnnPolicy(CnnFeatures, HyARTD3Policy):
    """:class:`HyARTD3Policy` for images."""


class MultiInputPolicy(CombinedFeatures, HyARTD3Policy):
    """:class:`HyARTD3Policy` for dict observations."""
