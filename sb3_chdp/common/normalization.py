"""Features extractors that normalise what they see, so that the units of observations do not matter."""

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor
from torch import nn

# Every batch counts in the statistics at first, then one of so many, as neighbouring ones are much alike
FIRST_BATCHES, BATCHES_PER_UPDATE = 100, 4
# Weight of a batch in the statistics; more at first, when they are plain averages
MIN_UPDATE_WEIGHT = 0.001
# Updates of the covariance per computation of the whitening matrix, the eigenvalues of which take time
UPDATES_PER_WHITENING = 16
# Vectors of more entries are not whitened
MAX_WHITENED = 256
# Added to the variances in all directions: what varies far less stays small, noise above all
SHRINKAGE = 0.01
# Largest normalised and whitened values
MAX_NORMALIZED, MAX_WHITENED_VALUE = 10.0, 5.0
# Of the whitened values: small differences are of use, but must not drown the rest
WHITENED_GAIN = 0.3
# What float32 resolves of a large number, and the least variance
RESOLUTION, MIN_VARIANCE = 3e-7, 1e-12


class RunningNormalization(nn.Module):
    """
    Vectors twice: centered and divided by one number, and whitened.

    The first copy keeps what entries of the same unit have in common: the place of a thing can be compared to that of another.
    It shows little of an entry in a small unit. The second copy does: entries are divided by their standard deviations and
    multiplied by W, after which they are nearly uncorrelated as well. What decides is often a small difference of two entries,
    as the place of a ball relative to the player that runs with it, and networks learn little of directions in which their
    inputs hardly vary. W is (correlation + ``SHRINKAGE``)^(-1/2): among all whitening matrices the one that keeps entries
    closest to the original ones (ZCA, Kessy et al., 2018), so that it changes little when the statistics do.

    Statistics are averages over training batches, in buffers whose names begin with ``running_``, as in batch normalisation:
    targets take over a copy.

    :param n: number of entries; beyond ``MAX_WHITENED``, W is left out
    """

    running_batches: th.Tensor
    running_mean: th.Tensor
    running_var: th.Tensor
    running_correlation: th.Tensor
    running_transform: th.Tensor

    def __init__(self, n: int):
        super().__init__()
        self.whitens = 1 < n <= MAX_WHITENED
        self.features_dim = 2 * n if n > 1 else n
        self.register_buffer("running_batches", th.zeros((), dtype=th.int64))
        self.register_buffer("running_mean", th.zeros(n))
        self.register_buffer("running_var", th.ones(n))
        if self.whitens:
            self.register_buffer("running_correlation", th.eye(n))
            self.register_buffer("running_transform", th.eye(n))

    @th.no_grad()
    def _update(self, x: th.Tensor) -> None:
        batch = int(self.running_batches)
        self.running_batches += 1
        late = max(batch - FIRST_BATCHES, 0)
        if late % BATCHES_PER_UPDATE:
            return
        n_updates = batch - late + late // BATCHES_PER_UPDATE
        weight = max(1 / (n_updates + 1), MIN_UPDATE_WEIGHT)
        shift = x.mean(dim=0) - self.running_mean
        var = x.var(dim=0, unbiased=False)
        # Variance of the mixture of what was seen before and of the batch
        self.running_var.copy_((1 - weight) * self.running_var + weight * var + weight * (1 - weight) * shift.square())
        self.running_mean += weight * shift
        if not self.whitens:
            return
        z = self._standardize(x - self.running_mean)
        self.running_correlation.lerp_(z.T @ z / len(z), weight)
        if n_updates < UPDATES_PER_WHITENING or n_updates % UPDATES_PER_WHITENING == 0:
            # In double precision, on the processor
            eigenvalues, eigenvectors = th.linalg.eigh(self.running_correlation.cpu().double())
            scales = (eigenvalues.clamp(min=0) + SHRINKAGE).rsqrt()
            self.running_transform.copy_(eigenvectors * scales @ eigenvectors.T)

    def _variances(self) -> th.Tensor:
        return self.running_var + MIN_VARIANCE + (RESOLUTION * self.running_mean).square()

    def _standardize(self, deviations: th.Tensor) -> th.Tensor:
        return (deviations * self._variances().rsqrt()).clamp(-MAX_NORMALIZED, MAX_NORMALIZED)

    def forward(self, x: th.Tensor) -> th.Tensor:
        """
        :param x: (B, n), which the statistics count in training mode
        :return: (B, features_dim)
        """
        if self.training:
            self._update(x)
        deviations = x - self.running_mean
        scaled = (deviations * self._variances().mean().rsqrt()).clamp(-MAX_NORMALIZED, MAX_NORMALIZED)
        if x.shape[1] == 1:
            return scaled
        z = self._standardize(deviations)
        if self.whitens:
            z = (z @ self.running_transform).clamp(-MAX_WHITENED_VALUE, MAX_WHITENED_VALUE)
        return th.cat([scaled, WHITENED_GAIN * z], dim=1)


class NormalizedExtractor(FlattenExtractor):
    """
    Flat observations, normalised by :class:`RunningNormalization`.

    :param observation_space: space of n numbers when flat
    """

    def __init__(self, observation_space: spaces.Space[Any]):
        super().__init__(observation_space)
        self.normalization = RunningNormalization(self._features_dim)
        self._features_dim = self.normalization.features_dim

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """:return: (B, features_dim)"""
        return self.normalization(super().forward(observations))


class NormalizedCombinedExtractor(CombinedExtractor):
    """
    SB3's extractor of dict observations, whose vectors are normalised by :class:`RunningNormalization`.

    :param observation_space: the space of the observations
    :param cnn_output_dim: number of features of each image
    :param normalized_image: whether images are normalised already, see SB3's ``NatureCNN``
    """

    def __init__(self, observation_space: spaces.Dict, cnn_output_dim: int = 256, normalized_image: bool = False):
        super().__init__(observation_space, cnn_output_dim, normalized_image)
        for key, subspace in observation_space.spaces.items():
            if isinstance(self.extractors[key], nn.Flatten):
                n = spaces.utils.flatdim(subspace)
                normalization = RunningNormalization(n)
                self.extractors[key] = nn.Sequential(nn.Flatten(), normalization)
                self._features_dim += normalization.features_dim - n
