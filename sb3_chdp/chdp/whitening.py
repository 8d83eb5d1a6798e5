"""The features extractor that lets CHDP's networks see small differences of observations."""

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor

# One training batch of so many counts in the statistics, as neighbouring ones are much alike, ...
BATCHES_PER_UPDATE = 16
# ... with this weight; more at first, when they are plain averages
MIN_UPDATE_WEIGHT = 0.004
# Added to the variances in all directions, as a share of their mean: what varies far less stays small, noise above all
SHRINKAGE = 0.01
# The least that is added: entries may all be constant
MIN_VARIANCE = 1e-8
MAX_DEVIATION = 5.0


class WhiteningExtractor(FlattenExtractor):
    """
    Flat observations s, and beside them whitened: W (s - mean), whose entries are nearly uncorrelated and of unit variance.

    What decides is often a small difference of two entries, as the place of the ball relative to the player that runs with
    it. Networks learn little of directions in which their inputs hardly vary; whitened, most vary alike. W is
    (covariance + ``SHRINKAGE`` * mean variance)^(-1/2): among all whitening matrices the one that keeps entries closest to the
    original ones (ZCA, Kessy et al., 2018), so that it changes little when the statistics do. These are averages over training
    batches, in buffers whose names begin with ``running_``, as in batch normalisation: targets take over a copy.

    Entries should have similar units, as after SB3's ``VecNormalize``: the mean variance is that of all.

    :param observation_space: space of n numbers when flat; the eigenvalues of (n, n) are computed, so not for images
    """

    running_mean: th.Tensor
    running_covariance: th.Tensor
    running_transform: th.Tensor
    running_count: th.Tensor

    def __init__(self, observation_space: spaces.Space[Any]):
        super().__init__(observation_space)
        n = self._features_dim
        self._features_dim = 2 * n
        self._n_batches = 0
        self.register_buffer("running_mean", th.zeros(n))
        self.register_buffer("running_covariance", th.eye(n))
        self.register_buffer("running_transform", th.eye(n))
        self.register_buffer("running_count", th.zeros(()))

    @th.no_grad()
    def _update(self, flat: th.Tensor) -> None:
        self.running_count += 1
        weight = (1 / self.running_count).clamp(min=MIN_UPDATE_WEIGHT)
        self.running_mean.lerp_(flat.mean(dim=0), weight)
        deviations = flat - self.running_mean
        self.running_covariance.lerp_(deviations.T @ deviations / len(flat), weight)
        # In double precision, which some accelerators lack
        eigenvalues, eigenvectors = th.linalg.eigh(self.running_covariance.cpu().double())
        floor = (SHRINKAGE * eigenvalues.mean()).clamp(min=MIN_VARIANCE)
        self.running_transform.copy_(eigenvectors * (eigenvalues.clamp(min=0) + floor).rsqrt() @ eigenvectors.T)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """:return: (B, 2 n) the observations, then the whitened ones, at most ``MAX_DEVIATION`` from 0"""
        flat = super().forward(observations)
        if self.training:
            if self._n_batches % BATCHES_PER_UPDATE == 0:
                self._update(flat)
            self._n_batches += 1
        whitened = (flat - self.running_mean) @ self.running_transform
        return th.cat([flat, whitened.clamp(-MAX_DEVIATION, MAX_DEVIATION)], dim=1)
