"""The units of the critics: values of zero mean and unit size, whatever the rewards."""

import torch as th
from torch import nn

# Weight of a batch in the statistics; more at first, when they are plain averages
MIN_UPDATE_WEIGHT = 0.005
MIN_SCALE = 1e-8
# Transitions that say what values are at first
N_FIRST_SAMPLES = 1000
# A rare disaster is to hide no other differences: values are at most so many units below the center, and the unit is at most
# so many standard deviations of the values above it
LARGEST_LOSS, LARGEST_RATIO = 10.0, 2.0


def bounded_mean(x: th.Tensor) -> th.Tensor:
    """
    A mean that few numbers far below the others do not decide.

    :param x: (n, m) numbers
    :return: (m,) means, in which no number lies further below the median than ``LARGEST_LOSS`` times the standard deviation of
        those above it
    """
    differences = x - x.quantile(0.5, dim=0)
    spread = (2 * differences.clamp(min=0).square().mean(dim=0)).sqrt()
    bounds = th.where(spread > 0, -LARGEST_LOSS * spread, -th.inf)
    return (x - differences + differences.maximum(bounds)).mean(dim=0)


class ValueScale(nn.Module):
    """
    What networks of values and rewards put out stands for ``center + scale * output``: the mean of their targets so far, and
    the standard deviation of the values. When these change, the networks' last layers do as well, so that values stay (PopArt,
    van Hasselt et al., 2016). At first all values are the same, see :meth:`start`, whatever the critics put out.

    Where a few values are far worse than all others, neither follows them: the scale is at most ``LARGEST_RATIO`` times the
    standard deviation of the values above the center, and what lies more than ``LARGEST_LOSS`` scales below the center counts
    as so many.

    :param adapts: False: values are what the critics put out, for ever
    """

    center: th.Tensor
    variance: th.Tensor
    upper_variance: th.Tensor
    n_batches: th.Tensor

    def __init__(self, adapts: bool = True) -> None:
        super().__init__()
        self.adapts = adapts
        for name, shape in (("center", (2,)), ("variance", ()), ("upper_variance", ()), ("n_batches", ())):
            self.register_buffer(name, th.zeros(shape, dtype=th.float64))
        self.variance += not adapts
        self.upper_variance += not adapts

    @property
    def scale(self) -> th.Tensor:
        """:return: () difference of values for a difference of 1 in the output"""
        return th.minimum(self.variance.sqrt(), LARGEST_RATIO * self.upper_variance.sqrt()).clamp(min=MIN_SCALE)

    def values(self, outputs: th.Tensor) -> th.Tensor:
        """
        :param outputs: (B, 1) what critics put out
        :return: (B, 1) values in the units of the rewards, in double precision: small differences of large values count
        """
        return self.center[0] + self.scale * outputs.double()

    def outputs(self, targets: th.Tensor) -> th.Tensor:
        """
        :param targets: (B, 2) values and rewards, in the units of the rewards
        :return: (B, 2) what the networks put out for them, at least -``LARGEST_LOSS``; of a batch that the statistics have
            seen, values of at most (B / ``MIN_UPDATE_WEIGHT``)^(1/2)
        """
        outputs = (targets.double() - self.center) / self.scale
        return (outputs.clamp(min=-LARGEST_LOSS) if self.adapts else outputs).float()

    @th.no_grad()
    def start(self, rewards: th.Tensor, discounts: th.Tensor) -> None:
        """
        Let all values be V = mean(r) + mean(discount) V, that of a state in which everything is average for ever, with the
        mean of :func:`bounded_mean`.

        From 0, bootstrapping takes some 1 / (1 - gamma) sweeps to get there. Till then actions differ by little beside how
        much all values rise or fall.

        :param rewards: (n, 1) rewards
        :param discounts: (n, 1) discounts of the values of the next states, 0 where episodes end
        """
        lost = (1 - discounts.double().mean()).clamp(min=1 / len(rewards))
        value = bounded_mean(rewards.double())[0] / lost
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
        values, has_scale = targets[:, 0].double(), scale > MIN_SCALE
        shift = scale * self.outputs(targets).double().mean(dim=0) if has_scale else bounded_mean(targets.double()) - center
        above = (values - center[0] - shift[0]).clamp(min=0)
        drift = (1 - weight) * shift[0].square()
        self.variance.lerp_(values.var(correction=0) + drift, weight)
        self.upper_variance.lerp_(2 * above.square().mean() + drift, weight)
        self.center += weight * shift
        if not has_scale:
            return None
        return (scale / self.scale).float(), ((center - self.center) / self.scale).float()
