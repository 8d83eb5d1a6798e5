"""The units of the critics: values of zero mean and unit size, whatever the rewards."""

import torch as th
from torch import nn

# Weight of a batch in the statistics; more at first, when they are plain averages
MIN_UPDATE_WEIGHT = 0.005
MIN_SCALE = 1e-8
# Transitions that say what values are at first
N_FIRST_SAMPLES = 1000


class ValueScale(nn.Module):
    """
    What networks of values and rewards put out stands for ``center + scale * output``: the mean of their targets so far, and
    the standard deviation of the values. When these change, the networks' last layers do as well, so that values stay (PopArt,
    van Hasselt et al., 2016). At first all values are the same, see :meth:`start`, whatever the critics put out.

    :param adapts: False: values are what the critics put out, for ever
    """

    center: th.Tensor
    variance: th.Tensor
    n_batches: th.Tensor

    def __init__(self, adapts: bool = True) -> None:
        super().__init__()
        self.adapts = adapts
        for name, shape in (("center", (2,)), ("variance", ()), ("n_batches", ())):
            self.register_buffer(name, th.zeros(shape, dtype=th.float64))
        self.variance += not adapts

    @property
    def scale(self) -> th.Tensor:
        """:return: () difference of values for a difference of 1 in the output"""
        return self.variance.sqrt().clamp(min=MIN_SCALE)

    def values(self, outputs: th.Tensor) -> th.Tensor:
        """
        :param outputs: (B, 1) what critics put out
        :return: (B, 1) values in the units of the rewards, in double precision: small differences of large values count
        """
        return self.center[0] + self.scale * outputs.double()

    def outputs(self, targets: th.Tensor) -> th.Tensor:
        """
        :param targets: (B, 2) values and rewards, in the units of the rewards
        :return: (B, 2) what the networks put out for them; of a batch that the statistics have seen, values of at most
            (B / ``MIN_UPDATE_WEIGHT``)^(1/2) from 0
        """
        return ((targets.double() - self.center) / self.scale).float()

    @th.no_grad()
    def start(self, rewards: th.Tensor, discounts: th.Tensor) -> None:
        """
        Let all values be V = mean(r) + mean(discount) V, that of a state in which everything is average for ever.

        From 0, bootstrapping takes some 1 / (1 - gamma) sweeps to get there. Till then actions differ by little beside how
        much all values rise or fall.

        :param rewards: (n, 1) rewards
        :param discounts: (n, 1) discounts of the values of the next states, 0 where episodes end
        """
        lost = (1 - discounts.double().mean()).clamp(min=1 / len(rewards))
        value = rewards.double().mean() / lost
        if th.isfinite(value):
            self.center[0] = value

    @th.no_grad()
    def update(self, targets: th.Tensor) -> tuple[th.Tensor, th.Tensor] | None:
        """
        :param targets: (B, 2) values and rewards, in the units of the rewards
        :return: () factor and (2,) summands for the networks' outputs, so that the values stay what they were, None if nothing
            is to change
        """
        center, scale = self.center.clone(), self.scale
        if not th.isfinite(targets).all():
            return None  # the loss will be refused, and nothing is to have changed
        self.n_batches += 1
        weight = (1 / self.n_batches).clamp(min=MIN_UPDATE_WEIGHT)
        shift = targets.double().mean(dim=0) - center
        variance = targets[:, 0].double().var(correction=0)
        self.variance.lerp_(variance + (1 - weight) * shift[0].square(), weight)
        self.center += weight * shift
        if scale <= MIN_SCALE:
            return None
        return (scale / self.scale).float(), ((center - self.center) / self.scale).float()
