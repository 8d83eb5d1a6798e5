"""Replay buffers that replay transitions of large TD error more often."""

import math
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.vec_env import VecNormalize

from sb3_chdp.common.arguments import FRACTION, check

# Added to every error, so that no transition is forgotten
PRIORITY_EPSILON = 1e-3
# Transitions whose priorities are summed up before the sums are searched
BLOCK = 1024
# Time steps and environments of transitions
Index = tuple[np.ndarray, np.ndarray]


def check_takes(buffer: ReplayBuffer, observation_space: spaces.Space[Any], of_dicts: str) -> None:
    """
    :param buffer: a replay buffer
    :param observation_space: the space of its observations
    :param of_dicts: name of the class for dict observations
    :raises ValueError: for dict observations, unless the buffer is of dicts
    """
    if isinstance(observation_space, spaces.Dict) and not isinstance(buffer, DictReplayBuffer):
        raise ValueError(f"replay_buffer_class must be {of_dicts} for dict observations, got {type(buffer).__name__}")


def observations_at(
    buffer: ReplayBuffer, observations: np.ndarray | dict[str, np.ndarray], index: Index, env: VecNormalize | None
) -> PyTorchObs:
    """
    :param buffer: a replay buffer
    :param observations: its (buffer_size, n_envs, ...) observations or next observations, of dicts those of each part
    :param index: B places in it
    :param env: VecEnv that normalises observations
    :return: (B, ...) tensors
    """
    if isinstance(observations, dict):
        parts = buffer._normalize_obs({key: part[index] for key, part in observations.items()}, env)
        assert isinstance(parts, dict)
        return {key: buffer.to_torch(part) for key, part in parts.items()}
    part = buffer._normalize_obs(observations[index], env)
    assert isinstance(part, np.ndarray)
    return buffer.to_torch(part)


class PrioritizedReplayBufferSamples(NamedTuple):
    """SB3's ``ReplayBufferSamples``, the (B, 1) importance weights in (0, 1], and where the transitions are stored."""

    observations: PyTorchObs
    actions: th.Tensor
    next_observations: PyTorchObs
    dones: th.Tensor
    rewards: th.Tensor
    weights: th.Tensor
    indices: Index
    # For n-step replay buffers, which this is not
    discounts: None = None


class PrioritizedReplayBuffer(ReplayBuffer):
    """
    Replay buffer that samples a transition i with probability P(i) proportional to (|TD error| + epsilon)^alpha.

    New transitions count as the highest priority so far, until they have been sampled and
    :meth:`update_priorities` was called. The losses are to be weighted by (N P(i))^-beta, divided by the largest of the batch.

    Source: Schaul et al. (2016), "Prioritized Experience Replay", https://arxiv.org/abs/1511.05952, proportional variant
    with stratified sampling; beta stays constant. In place of a sum tree, priorities are summed up anew for every batch: a
    fast pass over memory that costs little beside a gradient step.

    :param args: those of :class:`stable_baselines3.common.buffers.ReplayBuffer`
    :param alpha: how much errors count, from 0 (uniform sampling) to 1
    :param beta: how much of the sampling's bias the weights take back, from 0 to 1 (all of it)
    :param kwargs: those of :class:`stable_baselines3.common.buffers.ReplayBuffer`
    :raises ValueError: for ``optimize_memory_usage=True``, an alpha or beta out of range, or dict observations, which need
        :class:`PrioritizedDictReplayBuffer`
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        *args: Any,
        alpha: float = 0.6,
        beta: float = 0.4,
        **kwargs: Any,
    ):
        check_takes(self, observation_space, "PrioritizedDictReplayBuffer")
        super().__init__(buffer_size, observation_space, *args, **kwargs)
        if self.optimize_memory_usage:
            raise ValueError(f"{type(self).__name__} does not support optimize_memory_usage=True")
        check(FRACTION, alpha=alpha, beta=beta)
        self.alpha, self.beta = alpha, beta
        # Of all places, whether filled or not, and zeros that complete the last block
        size = self.buffer_size * self.n_envs
        self._priorities = np.zeros(math.ceil(size / BLOCK) * BLOCK, dtype=np.float32)
        self.max_priority = 1.0

    @property
    def priorities(self) -> np.ndarray:
        """:return: (buffer_size, n_envs) priorities, 0 where there is no transition yet"""
        return self._priorities[: self.buffer_size * self.n_envs].reshape(self.buffer_size, self.n_envs)

    def add(self, *args: Any, **kwargs: Any) -> None:
        """See :meth:`stable_baselines3.common.buffers.ReplayBuffer.add`."""
        self.priorities[self.pos] = self.max_priority
        super().add(*args, **kwargs)

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> PrioritizedReplayBufferSamples:  # type: ignore[override]
        """
        :param batch_size: number B of transitions
        :param env: VecEnv that normalises observations and rewards
        :return: a batch with its weights
        """
        index, probabilities = self._draw(batch_size)
        weights = (self.size() * self.n_envs * probabilities) ** -self.beta
        return PrioritizedReplayBufferSamples(
            observations=observations_at(self, self.observations, index, env),
            actions=self.to_torch(self.actions[index]),
            next_observations=observations_at(self, self.next_observations, index, env),
            # Only use dones that are not due to timeouts
            dones=self.to_torch(self.dones[index] * (1 - self.timeouts[index])).reshape(-1, 1),
            rewards=self.to_torch(self._normalize_reward(self.rewards[index].reshape(-1, 1), env)),
            weights=self.to_torch((weights / weights.max()).astype(np.float32)).reshape(-1, 1),
            indices=index,
        )

    def update_priorities(self, indices: Index, errors: th.Tensor) -> None:
        """
        :param indices: those of a batch that was sampled
        :param errors: (B,) its TD errors, of any sign
        """
        priorities = (errors.abs().cpu().numpy() + PRIORITY_EPSILON) ** self.alpha
        self.priorities[indices] = priorities
        self.max_priority = max(self.max_priority, float(priorities.max()))

    def _draw(self, batch_size: int) -> tuple[Index, np.ndarray]:
        """:return: time steps and environments of B transitions, (B,) their probabilities"""
        blocks = self._priorities.reshape(-1, BLOCK)
        of_blocks = blocks.sum(axis=1, dtype=np.float64)
        ends = np.cumsum(of_blocks)
        # One draw from each of B equal parts of the sum: first the block, then the place within
        draws = (np.arange(batch_size) + np.random.random(batch_size)) * (ends[-1] / batch_size)
        block = np.minimum(np.searchsorted(ends, draws, side="right"), len(ends) - 1)
        rest = draws - (ends[block] - of_blocks[block])
        places = np.cumsum(blocks[block], axis=1, dtype=np.float64)
        flat = block * BLOCK + (places <= rest[:, None]).sum(axis=1)
        # Rounding may lead beyond the last transition
        flat = np.minimum(flat, self.size() * self.n_envs - 1)
        return (flat // self.n_envs, flat % self.n_envs), self._priorities[flat] / ends[-1]


class PrioritizedDictReplayBuffer(PrioritizedReplayBuffer, DictReplayBuffer):  # type: ignore[misc]
    """:class:`PrioritizedReplayBuffer` for dict observations."""
