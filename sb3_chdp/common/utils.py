"""Small helpers that the algorithms share."""

import inspect
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from torch.nn import functional as F

# Rows of a table that are searched at a time, and size of the groups that are told apart first; one divides the other
NEAREST_ROW_CHUNK, NEAREST_ROW_GROUP = 2048, 128


def polyak_update(params: Iterable[th.Tensor], target_params: Iterable[th.Tensor], tau: float) -> None:
    """
    SB3's ``polyak_update`` in one fused operation: target <- (1 - tau) * target + tau * parameter.

    :param params: online parameters
    :param target_params: target parameters, in the same order
    :param tau: soft update coefficient in [0, 1]
    """
    with th.no_grad():
        th._foreach_lerp_(list(target_params), list(params), tau)


def default_optimizer_kwargs(optimizer_class: type[th.optim.Optimizer]) -> dict[str, Any]:
    """:return: ``fused=True`` for Adam: one kernel per step instead of a loop over parameters"""
    return {"fused": True} if optimizer_class == th.optim.Adam else {}


@th.no_grad()
def nearest_row(points: th.Tensor, table: th.Tensor) -> th.Tensor:
    """
    :param points: (B, d)
    :param table: (K, d)
    :return: (B,) index of the row of the table that is nearest in Euclidean distance
    """
    # |p - t|^2 without |p|^2, which is the same for all rows, as one product: (-2 t, |t|^2) (p, 1)
    n_rows, dim = table.shape
    is_large = n_rows > NEAREST_ROW_CHUNK
    padding = -n_rows % NEAREST_ROW_GROUP if is_large else 0
    rows = table.new_zeros(n_rows + padding, dim + 1)
    th.mul(table, -2, out=rows[:n_rows, :dim])
    rows[:n_rows, dim] = th.linalg.vecdot(table, table)
    points = F.pad(points, (0, 1), value=1.0)
    if not is_large:
        return th.mm(points, rows.t()).min(dim=1).indices
    # The distances to all rows of a large table do not fit into the processor's cache, and the place of a minimum takes
    # longer to find than its value: first the nearest group of rows, chunk by chunk, then the row within the group
    rows[n_rows:, dim] = th.inf
    columns = points.t().contiguous()
    of_groups = [
        th.mm(chunk, columns).view(-1, NEAREST_ROW_GROUP, len(points)).amin(dim=1) for chunk in rows.split(NEAREST_ROW_CHUNK)
    ]
    group = th.cat(of_groups).min(dim=0).indices
    candidates = rows.view(-1, NEAREST_ROW_GROUP, dim + 1)[group]
    return group * NEAREST_ROW_GROUP + th.bmm(candidates, points[:, :, None]).squeeze(2).argmin(dim=1)


def hash_observations(observations: PyTorchObs) -> th.Tensor:
    """
    :param observations: batch of observations
    :return: (B,) non-negative integers that depend on the content of each observation only
    """
    parts = observations.values() if isinstance(observations, dict) else [observations]
    total: th.Tensor | int = 0
    for part in parts:
        flat = part.reshape(len(part), -1)
        bits = flat.float().view(th.int32).long()
        # Multiplicative hashing; products wrap around
        factors = th.arange(1, flat.shape[1] + 1, device=flat.device) * 0x5851F42D4C957F2D + 1
        total = total * 31 + (bits * factors).sum(dim=1)
    assert isinstance(total, th.Tensor)
    return (total ^ (total >> 29)).abs()


def check_finite(name: str, value: np.ndarray | dict[str, np.ndarray]) -> None:
    """
    :param name: what the value is, for the message
    :param value: array, or dict of arrays
    :raises ValueError: if a float array holds NaN or infinity; the message names the environments concerned
    """
    if isinstance(value, dict):
        for key, part in value.items():
            check_finite(f"{name}[{key!r}]", part)
        return
    if value.dtype.kind == "f" and not np.isfinite(value).all():
        rows = value.reshape(len(value), -1) if value.ndim > 1 else value[:, None]
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=1)).tolist()
        raise ValueError(f"{name} must be finite, got NaN or inf from environment(s) {bad}: {value[bad]}")


def check_policy_kwargs(policy_class: type, policy_kwargs: dict[str, Any]) -> None:
    """
    :raises ValueError: if the policy has no such argument; the message lists those it has
    """
    accepted: set[str] = set()
    # A class that passes **kwargs on accepts what its parent does
    for parent in policy_class.__mro__:
        parameters = inspect.signature(parent).parameters.values()
        accepted |= {p.name for p in parameters if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)}
        if not any(p.kind is p.VAR_KEYWORD for p in parameters):
            break
    accepted -= {"observation_space", "action_space", "lr_schedule", "self"}
    unknown = set(policy_kwargs) - accepted
    if unknown:
        raise ValueError(
            f"policy_kwargs has unknown key(s) {sorted(unknown)}; {policy_class.__name__} accepts {sorted(accepted)}"
        )
