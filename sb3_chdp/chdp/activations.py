"""Activation functions and their derivatives, written to memory that is already there."""

import torch as th
from torch import nn


def activate(activation: nn.Module, x: th.Tensor, value: th.Tensor) -> th.Tensor:
    """
    :param activation: an element-wise activation function
    :param x: its input
    :param value: where to put its value, x itself if that is not needed any more
    :return: ``value``
    """
    if isinstance(activation, nn.SiLU):
        return th.ops.aten.silu.out(x, out=value)
    if isinstance(activation, nn.ReLU):
        return th.clamp(x, min=0, out=value)
    if isinstance(activation, nn.Tanh):
        return th.tanh(x, out=value)
    return value.copy_(activation(x))


def activate_with_derivative(activation: nn.Module, x: th.Tensor, value: th.Tensor, derivative: th.Tensor) -> None:
    """
    :param activation: an element-wise activation function
    :param x: its input
    :param value: where to put its value
    :param derivative: where to put its derivative
    """
    if isinstance(activation, nn.SiLU):
        th.sigmoid(x, out=derivative)
        th.mul(x, derivative, out=value)
        # sigmoid (1 + x (1 - sigmoid)) = value + sigmoid (1 - value)
        th.lerp(value, x.new_ones(()), derivative, out=derivative)
    elif isinstance(activation, nn.ReLU):
        th.clamp(x, min=0, out=value)
        derivative.copy_(x > 0)
    elif isinstance(activation, nn.Tanh):
        th.tanh(x, out=value)
        th.addcmul(x.new_ones(()), value, value, value=-1, out=derivative)
    else:
        with th.enable_grad():
            x = x.detach().requires_grad_()
            result = activation(x)
            (gradient,) = th.autograd.grad(result.sum(), x)
        value.copy_(result.detach())
        derivative.copy_(gradient)
