"""Piecewise linear encoding of observations, by which networks see thresholds."""

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

# Bins of an entry; fewer if all entries together would have more than MAX_BINS, none if each would have fewer than MIN_BINS
N_BINS, MAX_BINS, MIN_BINS = 16, 512, 4
# By how much a range shrinks per batch towards that of the batch: what was seen once is forgotten
SHRINKAGE = 0.001
# Least range, relative to the values: what float32 does not resolve is noise
RESOLUTION = 1e-5


def n_bins_of(n: int) -> int:
    """:return: number of bins of each of n entries"""
    n_bins = min(N_BINS, MAX_BINS // max(n, 1))
    return n_bins if n_bins >= MIN_BINS else 0


def ramps(positions: th.Tensor, n_bins: int) -> th.Tensor:
    """
    How far positions reach into each of ``n_bins`` bins of equal width, from 0 below the bin to 1 above (PLE of Gorishniy et
    al., 2022).

    Values often jump where an entry of the observation passes a threshold, at the end of an episode say. Networks learn such a
    step of the entry slowly. A weighted sum of ramps has it.

    :param positions: (B, n) in [0, 1]
    :return: (B, n_bins * n)
    """
    bins = th.arange(n_bins, dtype=positions.dtype, device=positions.device)[:, None]
    return (n_bins * positions[:, None] - bins).clamp(0, 1).flatten(1)


class RunningRanges(nn.Module):
    """
    Where the entries of observations lie between their least and their largest values, from 0 to 1.

    Entries are those of vectors in boxes, in dict observations too. Numbers of discrete spaces are not, nor are images.

    Ranges are those of training batches, in buffers whose names begin with ``running_``: targets take over a copy.

    :param observation_space: the space of the observations

    :ivar n: number of entries, 0 if there are none, or too many to be encoded: then there is nothing to call
    """

    running_low: th.Tensor
    running_high: th.Tensor

    def __init__(self, observation_space: spaces.Space[Any]):
        super().__init__()
        parts = observation_space.spaces if isinstance(observation_space, spaces.Dict) else {"": observation_space}
        self.keys = [key for key, part in parts.items() if isinstance(part, spaces.Box) and not is_image_space(part)]
        n = sum(spaces.utils.flatdim(parts[key]) for key in self.keys)
        self.n = n if n_bins_of(n) else 0
        # Before the first batch all positions are 0
        self.register_buffer("running_low", th.zeros(self.n))
        self.register_buffer("running_high", th.full((self.n,), th.inf))

    def _entries(self, obs: PyTorchObs) -> th.Tensor:
        parts = [(obs[key] if isinstance(obs, dict) else obs).flatten(1) for key in self.keys]
        return th.cat(parts, dim=1).float()

    @th.no_grad()
    def update(self, obs: PyTorchObs) -> None:
        """:param obs: (B, ...) observations of a training batch"""
        low, high = self._entries(obs).aminmax(dim=0)
        first = self.running_high.isinf()
        self.running_low.copy_(th.where(first, low, th.minimum(low, self.running_low.lerp(low, SHRINKAGE))))
        self.running_high.copy_(th.where(first, high, th.maximum(high, self.running_high.lerp(high, SHRINKAGE))))

    def forward(self, obs: PyTorchObs) -> th.Tensor:
        """
        :param obs: (B, ...) observations
        :return: (B, n) positions in [0, 1]
        """
        low, high = self.running_low, self.running_high
        widths = th.maximum(high - low, RESOLUTION * th.maximum(low.abs(), high.abs())).clamp(min=th.finfo(low.dtype).tiny)
        return ((self._entries(obs) - low) / widths).clamp(0, 1)
