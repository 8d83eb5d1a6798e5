"""The units of the critics: values of zero mean and unit size, whatever the rewards."""

import torch as th
from torch import nn

# Weight of a batch in the statistics; more at first, when they are plain averages
MIN_UPDATE_WEIGHT = 0.005
# Rewards of endless tasks without discount have no mean value
MIN_TERMINATION = 1e-3
MIN_SCALE = 1e-8


class ValueScale(nn.Module):
    """
    Values are ``center + scale * output`` of the critics: mean and standard deviation of the targets so far. When these
    change, the critics' last layers do as well, so that values stay (PopArt, van Hasselt et al., 2016).

    At first the center is the value of earning the mean reward of the warm-up for ever, so that the critics need not climb
    there target by target.
    """

    center: th.Tensor
    variance: th.Tensor
    n_batches: th.Tensor

    def __init__(self) -> None:
        super().__init__()
        for name in ("center", "variance", "n_batches"):
            self.register_buffer(name, th.zeros((), dtype=th.float64))
        self.variance += 1

    @property
    def scale(self) -> th.Tensor:
        """:return: () difference of values for a difference of 1 in the output"""
        return self.variance.sqrt().clamp(min=MIN_SCALE)

    def values(self, outputs: th.Tensor) -> th.Tensor:
        """:return: values in the units of the rewards"""
        return (self.center + self.scale * outputs.double()).float()

    def outputs(self, values: th.Tensor) -> th.Tensor:
        """:return: what critics put out for the values"""
        return ((values.double() - self.center) / self.scale).float()

    @th.no_grad()
    def start(self, rewards: th.Tensor, discounts: th.Tensor) -> None:
        """
        :param rewards: (B, 1) rewards of the warm-up
        :param discounts: (B, 1) discounts of the next values, 0 where there are none
        """
        self.center.copy_(rewards.double().mean() / (1 - discounts.double().mean()).clamp(min=MIN_TERMINATION))

    @th.no_grad()
    def update(self, targets: th.Tensor) -> tuple[float, float]:
        """
        :param targets: (B, 1) targets of the critics, in the units of the rewards
        :return: factor and summand for the critics' outputs, so that the values stay what they were
        """
        center, scale, first = self.center.clone(), self.scale, self.n_batches == 0
        self.n_batches += 1
        weight = (1 / self.n_batches).clamp(min=MIN_UPDATE_WEIGHT)
        shift = targets.double().mean() - center
        variance = targets.double().var(correction=0)
        self.variance.lerp_(variance + (1 - weight) * shift.square(), weight)
        if first:
            return 1.0, 0.0
        self.center += weight * shift
        return float(scale / self.scale), float((center - self.center) / self.scale)
