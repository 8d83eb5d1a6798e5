"""How well a network fits a function, for tests of what networks see."""

from collections.abc import Callable

import numpy as np
import torch as th


def unexplained(network: th.nn.Module, batch: Callable[[], tuple[th.Tensor, th.Tensor]], n_steps: int) -> float:
    """
    Train by least squares.

    :param network: its parameters are trained
    :param batch: draws a batch, and returns what the network makes of it and what it should
    :param n_steps: number of gradient steps
    :return: share of the variance that is left, in the mean over the last 50 steps
    """
    optimizer = th.optim.Adam(network.parameters(), lr=1e-3)
    shares = []
    for _ in range(n_steps):
        prediction, target = batch()
        loss = (prediction - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        shares.append(loss.item() / target.var().item())
    return np.mean(shares[-50:]).item()
