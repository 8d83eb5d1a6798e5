"""The units of the critics: values of unit size, whatever the rewards."""

import numpy as np
import torch as th
from torch import nn

# Weights in the running means of a batch, and of a transition that comes in; more at first, when they are plain averages
MIN_BATCH_WEIGHT, MIN_TRANSITION_WEIGHT = 0.005, 1e-4
# Rewards of endless tasks without discount have no mean value
MIN_TERMINATION = 1e-3
MIN_SCALE = 1e-8


class ValueScale(nn.Module):
    """
    Values are ``center + scale * output`` of the critics.

    The center is the value of a policy that earns the mean reward for ever, E[r] / (1 - gamma (1 - E[termination])), of the
    transitions as they come in: it depends neither on the critics, whose errors it would take up and feed back, nor on what
    the replay prefers. The scale is the root mean square of the targets' distance from it (as in PopArt, van Hasselt et al.,
    2016); when it changes, the critics' last layers do as well, so that values stay.
    """

    mean_reward: th.Tensor
    mean_termination: th.Tensor
    n_transitions: th.Tensor
    center: th.Tensor
    mean_square: th.Tensor
    n_batches: th.Tensor

    def __init__(self) -> None:
        super().__init__()
        for name in ("mean_reward", "mean_termination", "n_transitions", "center", "n_batches"):
            self.register_buffer(name, th.zeros((), dtype=th.float64))
        self.register_buffer("mean_square", th.ones((), dtype=th.float64))

    @property
    def scale(self) -> th.Tensor:
        """:return: () difference of values for a difference of 1 in the output"""
        return self.mean_square.sqrt().clamp(min=MIN_SCALE)

    def values(self, outputs: th.Tensor) -> th.Tensor:
        """:return: values in the units of the rewards"""
        return self.center.float() + self.scale.float() * outputs

    def outputs(self, values: th.Tensor) -> th.Tensor:
        """:return: what critics put out for the values"""
        return (values - self.center.float()) / self.scale.float()

    def count_transitions(self, rewards: np.ndarray, terminations: np.ndarray, gamma: float) -> None:
        """
        :param rewards: (n,) rewards of transitions that come in
        :param terminations: (n,) whether they end an episode, other than by a time limit
        :param gamma: discount factor
        """
        if self.n_transitions == 0:
            # Until there are targets, values are the center: what untrained critics put out has no units
            self.mean_square.zero_()
        self.n_transitions += len(rewards)
        weight = (len(rewards) / self.n_transitions).clamp(min=min(len(rewards) * MIN_TRANSITION_WEIGHT, 1.0))
        for mean, value in ((self.mean_reward, rewards.mean()), (self.mean_termination, terminations.mean())):
            mean += weight * (float(value) - mean)
        self.center.copy_(self.mean_reward / (1 - gamma * (1 - self.mean_termination)).clamp(min=MIN_TERMINATION))

    @th.no_grad()
    def count_targets(self, targets: th.Tensor) -> float:
        """
        :param targets: (B, 1) targets of the critics, in the units of the rewards
        :return: factor by which the critics' outputs have to be multiplied, so that the values stay what they were; 1 if there
            was no scale yet
        """
        before = self.scale
        self.n_batches += 1
        weight = (1 / self.n_batches).clamp(min=MIN_BATCH_WEIGHT)
        self.mean_square.lerp_((targets - self.center).double().square().mean(), weight)
        return 1.0 if before <= MIN_SCALE else float(before / self.scale)
