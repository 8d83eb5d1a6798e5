"""
The reverse chain of a diffusion model, in memory that every step uses again, with its backward pass written out.

Fresh memory costs more than what is computed in it. Autograd keeps inputs and outputs of every operation of all N steps;
here only what goes into the activations is kept, and the rest is computed again on the way back.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch as th
from torch import nn
from torch.autograd.function import once_differentiable

from sb3_chdp.chdp.activations import activate, activate_with_derivative


class StepConstants(NamedTuple):
    """
    Constants of one denoising step: x_start = clip(recip x - recipm1 noise), next x = coef_start x_start + coef_x x + sigma z.
    Factors are tensors () on the CPU: a product with a number makes one each time.
    """

    recip: th.Tensor
    recipm1: float
    coef_start: th.Tensor
    coef_x: float
    sigma: float


def denoise(
    steps: list[StepConstants],
    noise: th.Tensor,
    mask: th.Tensor | None,
    predict_noise: Callable[[th.Tensor, int], th.Tensor],
    tape: list[tuple[th.Tensor, th.Tensor]] | None = None,
) -> th.Tensor:
    """
    Run the reverse chain without gradient (eq. denoising_step of the paper, through x_start, so that it can be clipped).

    :param steps: constants of the N steps
    :param noise: (N, B, dim) the start x_N and what steps 1 to N - 1 inject
    :param mask: (B, dim) 1 for the entries that exist, None if all do
    :param predict_noise: noise (B, dim) in x_i (B, dim) at step i
    :param tape: list that takes x_i, and x_start before it is clipped, of every step
    :return: (B, dim) x_0
    """
    x, *injected = noise.unbind()
    for i in reversed(range(len(steps))):
        step = steps[i]
        if mask is not None:
            x = x * mask
        x_start = th.mul(x, step.recip).sub_(predict_noise(x, i), alpha=step.recipm1)
        clipped = x_start.clamp(-1, 1)
        if tape is not None:
            tape.append((x, x_start))
        x = clipped.mul_(step.coef_start).add_(x, alpha=step.coef_x)
        if i > 0:
            x.add_(injected[i - 1], alpha=step.sigma)
    return x


class ChainMLP:
    """
    The MLP that predicts the noise in all steps of one chain, without gradient, in memory that every step uses again.

    :param activation: activation function
    :param context: (B, H) what the condition adds to the first layer
    :param times: (N, H) what time and bias add to it
    :param weights: weight of the first layer for x (H, dim), weights of all further layers
    :param biases: biases of the further layers
    :param tape: list that takes the inputs of the activations of every step, which are then not overwritten
    """

    def __init__(
        self,
        activation: nn.Module,
        context: th.Tensor,
        times: th.Tensor,
        weights: Sequence[th.Tensor],
        biases: Sequence[th.Tensor],
        tape: list[list[th.Tensor]] | None = None,
    ):
        self.activation, self.context, self.weights, self.biases, self.tape = activation, context, weights, biases, tape
        self.times, self.transposed = times.unbind(), [weight.t() for weight in weights]
        self.values = self._empty()

    def _empty(self) -> list[th.Tensor]:
        return [self.context.new_empty(len(self.context), weight.shape[1]) for weight in self.weights[1:]]

    def __call__(self, x: th.Tensor, i: int) -> th.Tensor:
        """:return: (B, dim) predicted noise in x (B, dim) at step i"""
        inputs = self.values
        if self.tape is not None:
            inputs = self._empty()
            self.tape.append(inputs)
        th.add(self.context, self.times[i], out=inputs[0]).addmm_(x, self.transposed[0])
        for layer, (value, bias) in enumerate(zip(self.values, self.biases, strict=True), start=1):
            activate(self.activation, inputs[layer - 1], value)
            output = inputs[layer] if layer < len(inputs) else value.new_empty(x.shape)
            th.addmm(bias, value, self.transposed[layer], out=output)
        return output


class DenoisingChain(th.autograd.Function):
    """
    :func:`denoise` with a :class:`ChainMLP`, and its gradient.

    Inputs: the constants of the N steps; the activation; noise, mask, context and times as there; the first layer's weight
    for x; weight and bias of every further layer.
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
        ctx.steps, ctx.activation, ctx.mask, ctx.tape, ctx.mlp_tape = steps, activation, mask, [], []
        ctx.save_for_backward(*weights)
        return denoise(steps, noise, mask, ChainMLP(activation, context, times, weights, biases, ctx.mlp_tape), ctx.tape)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:  # type: ignore[override]
        weights = ctx.saved_tensors
        weight_gradients = [th.zeros_like(weight) for weight in weights]
        # Of the biases of all layers at every time; the first layer's are the times' own
        bias_gradients = [weight.new_empty(len(ctx.steps), len(weight)) for weight in weights]
        context_gradient = gradient.new_zeros(len(gradient), len(weights[0]))
        value, derivative, delta_ = ([th.empty_like(h) for h in ctx.mlp_tape[0]] for _ in range(3))
        tapes = zip(ctx.steps, reversed(ctx.tape), reversed(ctx.mlp_tape), strict=True)
        for i, (step, (x, x_start), hidden) in enumerate(tapes):
            start_gradient = th.ops.aten.hardtanh_backward(th.mul(gradient, step.coef_start), x_start, -1, 1)
            # Gradient at the output of a layer, from the last to the first
            delta = start_gradient * -step.recipm1
            for layer in range(len(weights) - 1, 0, -1):
                below = layer - 1
                activate_with_derivative(ctx.activation, hidden[below], value[below], derivative[below])
                weight_gradients[layer].addmm_(delta.t(), value[below])
                th.sum(delta, dim=0, out=bias_gradients[layer][i])
                delta = th.mm(delta, weights[layer], out=delta_[below]).mul_(derivative[below])
            weight_gradients[0].addmm_(delta.t(), x)
            th.sum(delta, dim=0, out=bias_gradients[0][i])
            context_gradient.add_(delta)
            gradient = th.mul(start_gradient, step.recip).add_(gradient, alpha=step.coef_x).addmm_(delta, weights[0])
            if ctx.mask is not None:
                gradient.mul_(ctx.mask)
        layers = [g for w, b in zip(weight_gradients[1:], bias_gradients[1:], strict=True) for g in (w, b.sum(dim=0))]
        return None, None, None, None, context_gradient, bias_gradients[0], weight_gradients[0], *layers
