"""HyAR's representation of hybrid actions: an embedding table and a conditional VAE. Nothing here knows an environment."""

from typing import NamedTuple

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_chdp.common.product_table import ProductTable
from sb3_chdp.common.utils import nearest_row

# Weights of the reconstruction of the parameters and of the KL term, relative to the prediction of the state's change
RECONSTRUCTION_WEIGHT = 2.0
KL_WEIGHT = 0.5
# Bounds of the encoder's log standard deviation
LOG_STD_RANGE = (-4.0, 4.0)
# The latent space spans the central 96 % of the codes of a sample, and at least this half width
BOUND_QUANTILE = 0.02
MIN_HALF_RANGE = 1e-3
# A stored latent is kept while its prediction error is below this multiple of the usual one
SHIFT_TOLERANCE = 5.0
# Noise of replaced embeddings
EMBEDDING_NOISE, EMBEDDING_NOISE_CLIP = 0.1, 0.5


class ActionBatch(NamedTuple):
    """
    Actions and what they did, for the representation to learn from.

    Shapes: features (B, features_dim), discrete_actions (B,) int64 or (B, L), parameters (B, Pmax) in [-1, 1] with padding 0,
    changes (B, features_dim), the difference between the next features and these.
    """

    features: th.Tensor
    discrete_actions: th.Tensor
    parameters: th.Tensor
    changes: th.Tensor


class ActionRepresentation(nn.Module):
    """
    Embedding e_k of discrete actions and latents z of parameters, learnt by reconstruction and by prediction of the
    change of the state (Li et al., 2022, section 4).

    A policy acts in [-1, 1]^(embedding_dim + parameter_latent_dim): its first part stands for the k of the nearest
    embedding, its second part is z scaled to the latent bounds.

    :param features_dim: width of the state features
    :param parameter_mask: (K, Pmax) which parameters an action has
    :param embedding_dim: width of an embedding (d1)
    :param parameter_latent_dim: width of z (d2)
    :param hidden_dim: units of the hidden layers
    """

    parameter_mask: th.Tensor
    latent_low: th.Tensor
    latent_high: th.Tensor
    usual_error: th.Tensor

    def __init__(
        self,
        features_dim: int,
        parameter_mask: th.Tensor,
        embedding_dim: int,
        parameter_latent_dim: int,
        hidden_dim: int = 256,
    ):
        super().__init__()
        n_actions, max_parameters = parameter_mask.shape
        self.embedding_dim, self.parameter_latent_dim = embedding_dim, parameter_latent_dim
        self.table = nn.Parameter(th.empty(n_actions, embedding_dim).uniform_(-1, 1))

        def trunk() -> nn.Sequential:
            return nn.Sequential(nn.Linear(hidden_dim, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, hidden_dim), nn.ReLU())

        condition_dim = features_dim + embedding_dim
        self.encoder_condition = nn.Linear(condition_dim, hidden_dim)
        self.encoder_input = nn.Linear(max_parameters, hidden_dim)
        self.encoder = nn.Sequential(*trunk(), nn.Linear(hidden_dim, 2 * parameter_latent_dim))
        self.decoder_condition = nn.Linear(condition_dim, hidden_dim)
        self.decoder_input = nn.Linear(parameter_latent_dim, hidden_dim)
        self.decoder = trunk()
        self.parameter_head = nn.Sequential(nn.Linear(hidden_dim, max_parameters), nn.Tanh())
        self.dynamics_head = nn.Sequential(
            nn.Linear(hidden_dim, hidden_dim), nn.ReLU(), nn.Linear(hidden_dim, features_dim), nn.Tanh()
        )
        self.register_buffer("parameter_mask", parameter_mask.float(), persistent=False)
        # Found by update_bounds()
        self.register_buffer("latent_low", -th.ones(parameter_latent_dim))
        self.register_buffer("latent_high", th.ones(parameter_latent_dim))
        self.register_buffer("usual_error", th.tensor(0.0))

    def embed(self, k: th.Tensor) -> th.Tensor:
        """:return: (B, d1) embeddings e_k = tanh(table row) of (B,) discrete actions"""
        return th.tanh(self.table[k])

    def nearest_action(self, embeddings: th.Tensor, masks: th.Tensor | None = None) -> th.Tensor:
        """:return: (B,) discrete actions whose embeddings are nearest to (B, d1) points, of those that (B, K) masks allow"""
        return nearest_row(embeddings, th.tanh(self.table), masks)

    def mask_of(self, k: th.Tensor) -> th.Tensor:
        """:return: (B, Pmax) 1 for the parameters that discrete actions have"""
        return self.parameter_mask[k]

    def per_column(self, per_action: th.Tensor) -> th.Tensor:
        """:return: (B, d1) or (B, 1) what (B,) booleans say of the columns of embeddings"""
        return per_action[:, None]

    @th.no_grad()
    def to_allowed(self, embeddings: th.Tensor, masks: th.Tensor) -> th.Tensor:
        """
        :param embeddings: (B, d1) points
        :param masks: (B, K) False for discrete actions that may not be taken
        :return: (B, d1) the same, with the nearest allowed embedding in place of one that stands for a forbidden action
        """
        allowed = self.nearest_action(embeddings, masks)
        keep = self.nearest_action(embeddings) == allowed
        return th.where(self.per_column(keep), embeddings, self.embed(allowed))

    def _bounds(self) -> tuple[th.Tensor, th.Tensor]:
        """:return: centre and half width of the latent bounds"""
        centre, half_range = (self.latent_high + self.latent_low) / 2, (self.latent_high - self.latent_low) / 2
        return centre, half_range.clamp(min=MIN_HALF_RANGE)

    def scale(self, z: th.Tensor) -> th.Tensor:
        """:return: z with the latent bounds mapped to [-1, 1], clipped"""
        centre, half_range = self._bounds()
        return ((z - centre) / half_range).clamp(-1, 1)

    def unscale(self, scaled_z: th.Tensor) -> th.Tensor:
        """Inverse of :meth:`scale` inside the bounds."""
        centre, half_range = self._bounds()
        return scaled_z * half_range + centre

    def encode(self, batch: ActionBatch) -> tuple[th.Tensor, th.Tensor]:
        """:return: mean and log standard deviation of z, (B, d2) each"""
        condition = th.cat([batch.features, self.embed(batch.discrete_actions)], dim=1)
        hidden = F.relu(self.encoder_condition(condition)) * F.relu(self.encoder_input(batch.parameters))
        mean, log_std = self.encoder(hidden).chunk(2, dim=1)
        return mean, log_std.clamp(*LOG_STD_RANGE)

    def decode(self, features: th.Tensor, k: th.Tensor, z: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param features: (B, features_dim)
        :param k: (B,) discrete actions
        :param z: (B, d2), not scaled
        :return: (B, Pmax) parameters with padding 0, (B, features_dim) predicted change of the features
        """
        condition = th.cat([features, self.embed(k)], dim=1)
        hidden = self.decoder(F.relu(self.decoder_condition(condition)) * F.relu(self.decoder_input(z)))
        return self.parameter_head(hidden) * self.mask_of(k), self.dynamics_head(hidden)

    def loss(self, batch: ActionBatch) -> th.Tensor:
        """
        Reconstruction of the parameters, KL divergence to N(0, I) and prediction of the change of the state.

        :param batch: a batch of actions
        :return: the weighted sum
        """
        mean, log_std = self.encode(batch)
        z = mean + log_std.exp() * th.randn_like(mean)
        parameters, changes = self.decode(batch.features, batch.discrete_actions, z)
        mask = self.mask_of(batch.discrete_actions)
        # Padding does not count
        reconstruction = ((parameters - batch.parameters).square() * mask).sum() / mask.sum().clamp(min=1)
        kl_divergence = 0.5 * (mean.square() + (2 * log_std).exp() - 1 - 2 * log_std).mean()
        dynamics = F.mse_loss(changes, batch.changes)
        return dynamics + RECONSTRUCTION_WEIGHT * reconstruction + KL_WEIGHT * kl_divergence

    @th.no_grad()
    def update_bounds(self, batch: ActionBatch) -> None:
        """
        Fit the latent bounds to the central 96 % of the codes of a sample, per dimension, and note the usual error of the
        predicted change.

        :param batch: a large sample of actions
        """
        mean, log_std = self.encode(batch)
        z = mean + log_std.exp() * th.randn_like(mean)
        self.latent_low.copy_(th.quantile(z, BOUND_QUANTILE, dim=0))
        self.latent_high.copy_(th.quantile(z, 1 - BOUND_QUANTILE, dim=0))
        _, changes = self.decode(batch.features, batch.discrete_actions, mean)
        self.usual_error.copy_(F.mse_loss(changes, batch.changes))

    @th.no_grad()
    def relabel(self, batch: ActionBatch, latents: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Latents that stand for the actions of a batch under the present representation (representation shift correction).

        An embedding that is no longer nearest to its action's gives way to that one, with noise; a z that no longer
        predicts the change of the state gives way to the encoder's mean.

        :param batch: a batch of actions
        :param latents: (B, d1 + d2) embeddings and z (not scaled) at the time of acting; NaN where there was none
        :return: (B, d1 + d2) latents in [-1, 1], and (B, 2) which embeddings and which z were kept
        """
        k = batch.discrete_actions
        embeddings, z = latents.split([self.embedding_dim, self.parameter_latent_dim], dim=1)
        known = th.isfinite(latents).all(dim=1)
        embeddings, z = th.nan_to_num(embeddings), th.nan_to_num(z)

        keep_embedding = self.per_column(self.nearest_action(embeddings) == k) & known[:, None]
        noise = (th.randn_like(embeddings) * EMBEDDING_NOISE).clamp(-EMBEDDING_NOISE_CLIP, EMBEDDING_NOISE_CLIP)
        embeddings = th.where(keep_embedding, embeddings, self.embed(k) + noise)

        _, changes = self.decode(batch.features, k, z)
        errors = (changes - batch.changes).square().mean(dim=1)
        keep_z = known & (errors < SHIFT_TOLERANCE * self.usual_error)
        z = th.where(keep_z[:, None], z, self.encode(batch)[0])
        latents = th.cat([embeddings.clamp(-1, 1), self.scale(z)], dim=1)
        return latents, th.stack([keep_embedding.all(dim=1), keep_z], dim=1)


class EmbeddingTable(ProductTable):
    """Embeddings of the values of L choices, tanh of the table."""

    def vectors(self) -> list[th.Tensor]:
        return [th.tanh(table) for table in self.tables]


class FactoredActionRepresentation(ActionRepresentation):
    """
    :class:`ActionRepresentation` of actions that are made of L choices, each with embeddings of its own: a policy's first part
    is their concatenation, and each block stands for the value of the nearest embedding.

    :param features_dim: width of the state features
    :param radices: numbers of values of the choices
    :param n_parameters: number of parameters, which all actions share
    :param embedding_dim: width of an embedding at most, see :func:`block_widths`
    :param parameter_latent_dim: width of z (d2)
    :param hidden_dim: units of the hidden layers
    """

    def __init__(
        self,
        features_dim: int,
        radices: tuple[int, ...],
        n_parameters: int,
        embedding_dim: int,
        parameter_latent_dim: int,
        hidden_dim: int = 256,
    ):
        tables = EmbeddingTable(radices, embedding_dim)
        super().__init__(features_dim, th.ones(1, n_parameters), tables.width, parameter_latent_dim, hidden_dim)
        # In place of the one of a single choice
        del self.table
        self.tables = tables

    def embed(self, k: th.Tensor) -> th.Tensor:
        """:return: (B, d1) embeddings of (B, L) values, one after the other"""
        return self.tables(k)

    def nearest_action(self, embeddings: th.Tensor, masks: th.Tensor | None = None) -> th.Tensor:
        """:return: (B, L) values whose embeddings are nearest to the blocks of (B, d1) points, of those that masks allow"""
        return self.tables.nearest(embeddings, masks)

    def mask_of(self, k: th.Tensor) -> th.Tensor:
        return self.parameter_mask.expand(k.shape[0], -1)

    def per_column(self, per_action: th.Tensor) -> th.Tensor:
        return per_action[:, self.tables.choice_of_column]
