"""
The reverse chain of a diffusion model with its backward pass written out.

Autograd keeps inputs and outputs of every operation of all N steps, in fresh memory. Here only what goes into the
activations is kept, and the rest is computed again on the way back, in memory that every step uses again.
"""

from typing import Any, NamedTuple

import torch as th
from torch import nn
from torch.autograd.function import once_differentiable

from sb3_chdp.chdp.activations import activate, activate_with_derivative


class StepConstants(NamedTuple):
    """
    Constants of one denoising step: x_start = clip(recip x - recipm1 noise), next x = coef_start x_start + coef_x x + sigma z.
    """

    recip: float
    recipm1: float
    coef_start: float
    coef_x: float
    sigma: float


class DenoisingChain(th.autograd.Function):
    """
    x_0 of a chain of N steps that an MLP with one or more hidden layers denoises.

    Inputs: the constants of the N steps; the activation; noise (N, B, dim), the start x_N and what steps 1 to N - 1 inject;
    mask (B, dim) of the entries that exist, or None; context (B, H), what the condition adds to the first layer; times
    (N, H), what time and bias add; the first layer's weight for x (H, dim); weight and bias of every further layer.
    """

    @staticmethod
    def forward(
        ctx: Any,
        steps: list[StepConstants],
        activation: nn.Module,
        noise: th.Tensor,
        mask: th.Tensor | None,
        context: th.Tensor,
        times: th.Tensor,
        x_weight: th.Tensor,
        *layers: th.Tensor,
    ) -> th.Tensor:
        weights, biases = (x_weight, *layers[0::2]), layers[1::2]
        values = [context.new_empty(len(context), weight.shape[1]) for weight in weights[1:]]
        # Of every step: x_i, the inputs of the activations, and where x_start is not clipped
        tape: list[tuple[th.Tensor, list[th.Tensor], th.Tensor]] = []
        x = noise[0]
        for i in reversed(range(len(steps))):
            step = steps[i]
            if mask is not None:
                x = x * mask
            hidden = [th.add(context, times[i]).addmm_(x, x_weight.t())]
            for weight, bias, value in zip(weights[1:], biases, values, strict=True):
                hidden.append(th.addmm(bias, activate(activation, hidden[-1], value), weight.t()))
            x_start = th.mul(x, step.recip).sub_(hidden.pop(), alpha=step.recipm1)
            clipped = x_start.clamp(-1, 1)
            tape.append((x, hidden, x_start == clipped))
            x = clipped.mul_(step.coef_start).add_(x, alpha=step.coef_x)
            if i > 0:
                x.add_(noise[i], alpha=step.sigma)
        ctx.steps, ctx.activation, ctx.tape, ctx.mask = steps, activation, tape, mask
        ctx.save_for_backward(*weights)
        return x

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:  # type: ignore[override]
        weights = ctx.saved_tensors
        weight_gradients = [th.zeros_like(weight) for weight in weights]
        bias_gradients = [weight.new_zeros(len(weight)) for weight in weights[1:]]
        times_gradient = weights[0].new_zeros(len(ctx.steps), len(weights[0]))
        context_gradient = gradient.new_zeros(len(gradient), len(weights[0]))
        value, derivative, delta_ = ([th.empty_like(h) for h in ctx.tape[0][1]] for _ in range(3))
        for i, (step, (x, hidden, inside)) in enumerate(zip(ctx.steps, reversed(ctx.tape), strict=True)):
            start_gradient = th.mul(gradient, step.coef_start).mul_(inside)
            # Gradient at the output of a layer, from the last to the first
            delta = start_gradient * -step.recipm1
            for layer in range(len(weights) - 1, 0, -1):
                below = layer - 1
                activate_with_derivative(ctx.activation, hidden[below], value[below], derivative[below])
                weight_gradients[layer].addmm_(delta.t(), value[below])
                bias_gradients[below].add_(delta.sum(dim=0))
                delta = th.mm(delta, weights[layer], out=delta_[below]).mul_(derivative[below])
            weight_gradients[0].addmm_(delta.t(), x)
            times_gradient[i] = delta.sum(dim=0)
            context_gradient.add_(delta)
            gradient = th.mul(gradient, step.coef_x).add_(start_gradient, alpha=step.recip).addmm_(delta, weights[0])
            if ctx.mask is not None:
                gradient.mul_(ctx.mask)
        layers = [g for pair in zip(weight_gradients[1:], bias_gradients, strict=True) for g in pair]
        return None, None, None, None, context_gradient, times_gradient, weight_gradients[0], *layers
