"""The units of the critics: values of zero mean and unit size, whatever the rewards."""

import torch as th
from torch import nn

# Weight of a batch in the statistics; more at first, when they are plain averages
MIN_UPDATE_WEIGHT = 0.005
MIN_SCALE = 1e-8
# A first reward after none may lie far beyond the scale so far
MAX_OUTPUT = 20.0


class ValueScale(nn.Module):
    """
    Values are ``center + scale * output`` of the critics: mean and standard deviation of the targets so far. When these
    change, the critics' last layers do as well, so that values stay (PopArt, van Hasselt et al., 2016). At first all values
    are 0, whatever the critics put out.

    :param adapts: False: values are what the critics put out, for ever
    """

    center: th.Tensor
    variance: th.Tensor
    n_batches: th.Tensor

    def __init__(self, adapts: bool = True) -> None:
        super().__init__()
        self.adapts = adapts
        for name in ("center", "variance", "n_batches"):
            self.register_buffer(name, th.zeros((), dtype=th.float64))
        self.variance += not adapts

    @property
    def scale(self) -> th.Tensor:
        """:return: () difference of values for a difference of 1 in the output"""
        return self.variance.sqrt().clamp(min=MIN_SCALE)

    def values(self, outputs: th.Tensor) -> th.Tensor:
        """:return: values in the units of the rewards"""
        return (self.center + self.scale * outputs.double()).float()

    def outputs(self, values: th.Tensor) -> th.Tensor:
        """:return: what critics put out for the values, at most ``MAX_OUTPUT`` from 0 if the scale adapts"""
        outputs = ((values.double() - self.center) / self.scale).float()
        return outputs.clamp(-MAX_OUTPUT, MAX_OUTPUT) if self.adapts else outputs

    @th.no_grad()
    def update(self, targets: th.Tensor) -> tuple[float, float]:
        """
        :param targets: (B, 1) targets of the critics, in the units of the rewards
        :return: factor and summand for the critics' outputs, so that the values stay what they were
        """
        center, scale = self.center.clone(), self.scale
        if not th.isfinite(targets).all():
            return 1.0, 0.0  # the loss will be refused, and nothing is to have changed
        self.n_batches += 1
        weight = (1 / self.n_batches).clamp(min=MIN_UPDATE_WEIGHT)
        shift = targets.double().mean() - center
        variance = targets.double().var(correction=0)
        self.variance.lerp_(variance + (1 - weight) * shift.square(), weight)
        self.center += weight * shift
        if scale <= MIN_SCALE:
            return 1.0, 0.0
        return float(scale / self.scale), float((center - self.center) / self.scale)
