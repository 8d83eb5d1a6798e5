"""Small helpers that the algorithms share."""

import math
from collections.abc import Sequence
from itertools import islice
from typing import Any

import torch as th
from torch import nn

# Rows of a table that are searched at a time, and size of the groups that are told apart first; one divides the other
NEAREST_ROW_CHUNK, NEAREST_ROW_GROUP = 2048, 128
# Adam keeps squares of gradients in float32
LARGEST_NORM = math.sqrt(th.finfo(th.float32).max)


class TargetUpdate:
    """
    SB3's ``polyak_update`` of all target networks in one fused operation: target <- (1 - tau) * target + tau * parameter.

    Running statistics of batch normalisation are copied, see SB3's GH issue #996.

    :param networks: the online networks, which may share parts
    :param targets: their targets, in the same order, which share the same parts
    """

    def __init__(self, networks: Sequence[nn.Module], targets: Sequence[nn.Module]):
        self.params, self.batch_norm_stats = self._tensors(networks)
        self.target_params, self.batch_norm_stats_target = self._tensors(targets)

    @staticmethod
    def _tensors(networks: Sequence[nn.Module]) -> tuple[list[th.Tensor], list[th.Tensor]]:
        """:return: parameters, each once, and running statistics"""
        params: dict[th.Tensor, None] = dict.fromkeys(p for net in networks for p in net.parameters())
        # The buffers themselves, not views of them as in a state_dict, which a pickle would part from the networks
        return list(params), [stat for net in networks for name, stat in net.named_buffers() if "running_" in name]

    @th.no_grad()
    def __call__(self, tau: float) -> None:
        """
        :param tau: soft update coefficient in [0, 1]
        """
        th._foreach_lerp_(self.target_params, self.params, tau)
        self.copy_statistics()

    @th.no_grad()
    def copy_statistics(self) -> None:
        """The targets take over running statistics alone."""
        if self.batch_norm_stats:
            th._foreach_copy_(self.batch_norm_stats_target, self.batch_norm_stats)


class NonFiniteLossError(FloatingPointError):
    """
    A loss or its gradient is NaN, infinite, or too large to be squared. No parameter has moved because of it.

    :param name: name of the loss in the log
    :param loss: its value
    :param details: where it happened, for the message
    """

    def __init__(self, name: str, loss: float, details: str = ""):
        self.name, self.loss = name, loss
        super().__init__(f"{name} and the squares of its gradient must be finite, got {loss:.6g}{details}")


def floats(numbers: Sequence[th.Tensor]) -> list[float]:
    """:return: the values of scalar tensors, all on one device"""
    # A GPU is asked once, as it waits for the whole computation; on the processor stacking costs more than asking
    return th.stack(list(numbers)).tolist() if numbers[0].is_cuda else [number.item() for number in numbers]


def clip(gradients: list[th.Tensor], norm: float, max_norm: float) -> None:
    """
    ``torch.nn.utils.clip_grad_norm_`` for gradients whose common norm is known.

    :param gradients: are scaled in place if ``norm`` is more than ``max_norm``
    """
    if norm > max_norm:
        th._foreach_mul_(gradients, max_norm / norm)


def gradient_step(
    loss: th.Tensor, optimizers: Sequence[th.optim.Optimizer], max_grad_norm: float | None = None, name: str = "The loss"
) -> None:
    """
    One gradient step of the parameters of the given optimizers, and of no others.

    :param loss: the loss to minimise
    :param optimizers: their parameters are all that moves
    :param max_grad_norm: bound on the gradient norm of each optimizer's parameters, None for none
    :param name: name of the loss in the log, for the message
    :raises NonFiniteLossError: before anything moves, if the loss is not finite, or the square of the gradient's norm
    """
    groups = [[p for group in of.param_groups for p in group["params"] if p.requires_grad] for of in optimizers]
    params = [p for group in groups for p in group]
    # Without a gradient: those of a shared features extractor, which belongs to another optimizer's loss
    gradients = th.autograd.grad(loss, params, allow_unused=True)
    for p, gradient in zip(params, gradients, strict=True):
        p.grad = gradient
    value, *norms = floats([loss.detach(), *th._foreach_norm([g for g in gradients if g is not None])])
    if not (math.isfinite(value) and math.hypot(*norms) <= LARGEST_NORM):
        raise NonFiniteLossError(name, value)
    remaining = iter(norms)
    for optimizer, group in zip(optimizers, groups, strict=True):
        if max_grad_norm is not None:
            own = [p.grad for p in group if p.grad is not None]
            clip(own, math.hypot(*islice(remaining, len(own))), max_grad_norm)
        optimizer.step()


def default_optimizer_kwargs(optimizer_class: type[th.optim.Optimizer]) -> dict[str, Any]:
    """:return: ``fused=True`` for Adam: one kernel per step instead of a loop over parameters"""
    return {"fused": True} if optimizer_class == th.optim.Adam else {}


@th.no_grad()
def nearest_row(points: th.Tensor, table: th.Tensor, masks: th.Tensor | None = None) -> th.Tensor:
    """
    :param points: (B, d)
    :param table: (K, d)
    :param masks: (B, K) False for rows of the table that are passed over, None: none
    :return: (B,) index of the row of the table that is nearest in Euclidean distance
    """
    # |p - t|^2 without |p|^2, which is the same for all rows
    n_rows = len(table)
    factors, squares = -2 * points, th.linalg.vecdot(table, table)
    if masks is not None:
        return th.addmm(squares, factors, table.t()).masked_fill(~masks, th.inf).min(dim=1).indices
    if n_rows <= NEAREST_ROW_CHUNK or th.compiler.is_exporting():
        return th.addmm(squares, factors, table.t()).min(dim=1).indices
    # The distances to all rows of a large table do not fit into the processor's cache, and the place of a minimum takes
    # longer to find than its value: first the nearest group of rows, chunk by chunk, then the row within the group
    columns, group_size = factors.t().contiguous(), NEAREST_ROW_GROUP
    distances = table.new_empty(NEAREST_ROW_CHUNK, len(points))
    of_groups = table.new_empty(math.ceil(n_rows / group_size), len(points))
    chunks = zip(table.split(NEAREST_ROW_CHUNK), squares[:, None].split(NEAREST_ROW_CHUNK), strict=True)
    chunk_groups = of_groups.split(NEAREST_ROW_CHUNK // group_size)
    for (chunk, chunk_squares), nearest in zip(chunks, chunk_groups, strict=True):
        th.addmm(chunk_squares, chunk, columns, out=distances[: len(chunk)])
        in_groups = distances[: len(nearest) * group_size]
        in_groups[len(chunk) :] = th.inf
        th.amin(in_groups.view(-1, group_size, len(points)), dim=1, out=nearest)
    group = of_groups.min(dim=0).indices
    rows = (group[:, None] * group_size + th.arange(group_size, device=table.device)).clamp(max=n_rows - 1)
    in_group = squares[rows] + th.bmm(table[rows], factors[:, :, None]).squeeze(2)
    return rows.gather(1, in_group.argmin(dim=1, keepdim=True)).squeeze(1)
