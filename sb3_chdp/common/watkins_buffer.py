"""n-step returns that end before an action that costs much."""

from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.type_aliases import PyTorchObs
from stable_baselines3.common.vec_env import VecNormalize

from sb3_chdp.common.buffers import Index, check_takes, observations_at
from sb3_chdp.common.n_step_buffer import HybridNStepReplayBuffer

# Probability that a return goes on after a step, and most steps that one has
DECAY, MAX_STEPS = 0.9, 20
# Weight of a batch in the running mean of what random actions cost
COST_RATE = 0.05
# First transitions that tell how fast observations change, and entries of an observation at most that are looked at
N_FIRST, MAX_ENTRIES = 1000, 512


class WatkinsReplayBufferSamples(NamedTuple):
    """
    SB3's ``ReplayBufferSamples`` of n-step returns, where n differs from one to the next, with the (B, 1) rewards of the first
    steps, and the (B, columns) actions that were taken after the last ones, and where these are stored.
    """

    observations: PyTorchObs
    actions: th.Tensor
    next_observations: PyTorchObs
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor
    first_rewards: th.Tensor
    next_actions: th.Tensor
    next_indices: Index


def change_rate(before: np.ndarray, after: np.ndarray) -> float:
    """
    How much observations change in a step: E[(s' - s)^2] / (2 var s), which is 1 - autocorrelation.

    :param before: (n, n_entries) observations
    :param after: (n, n_entries) the next ones
    :return: mean over the entries that change, about 1 / number of steps until observations are others; infinity if none does
    """
    changes, variances = np.square(after - before).mean(axis=0), before.var(axis=0)
    which = (changes > 0) & (variances > 0)
    return float((changes[which] / (2 * variances[which])).mean()) if which.any() else np.inf


class WatkinsReplayBuffer(HybridNStepReplayBuffer):
    """
    Replay buffer of n-step returns that end before actions which are worse than the best ones of their states.

    A return goes on for as long as these actions, and a random one in the mean over all states, cost no more than
    ``tolerance`` in all. If each action decides, a random one alone costs more, and returns have one step. If an action
    matters little, as in a short time step, they have many: critics hear soon of what comes in the end. Returns end at
    random, too, with probability 1 - ``DECAY`` after each step, so that all costs are asked for again.

    Critics that have hardly seen a reward do not know what actions cost. So returns have one step, too, where observations
    become others within ``n_steps``, see :func:`change_rate`.

    Source: the cuts of Q(lambda) (Watkins, 1989), there at every action that is not the best, and its returns' geometric
    lengths.

    :param args: those of :class:`stable_baselines3.common.buffers.NStepReplayBuffer`
    :param n_steps: largest number of steps
    :param kwargs: those of :class:`stable_baselines3.common.buffers.NStepReplayBuffer`
    :raises ValueError: for dict observations, which need :class:`WatkinsDictReplayBuffer`

    :ivar costs: (buffer_size, n_envs) by how much the actions were worth less than the best ones when :meth:`update_costs` was
        last told, infinity before
    :ivar random_cost: running mean of that of random actions over states, infinity before
    :ivar tolerance: sum of costs up to which a return goes on
    :ivar change_rate: :func:`change_rate` of the first ``N_FIRST`` transitions, infinity before there are any
    :ivar n_seen: number of steps that it was taken from
    """

    def __init__(
        self, buffer_size: int, observation_space: spaces.Space[Any], *args: Any, n_steps: int = MAX_STEPS, **kwargs: Any
    ):
        check_takes(self, observation_space, "WatkinsDictReplayBuffer")
        super().__init__(buffer_size, observation_space, *args, n_steps=n_steps, **kwargs)
        self.costs = np.full((self.buffer_size, self.n_envs), np.inf, dtype=np.float32)
        self.random_cost = np.inf
        self.tolerance = 0.0
        self.change_rate, self.n_seen = np.inf, 0

    def add(self, *args: Any, **kwargs: Any) -> None:
        """See :meth:`stable_baselines3.common.buffers.ReplayBuffer.add`."""
        self.costs[self.pos] = np.inf
        super().add(*args, **kwargs)

    def update_costs(self, indices: Index, costs: th.Tensor, dones: th.Tensor) -> None:
        """
        :param indices: ``next_indices`` of a batch. Those behind the end of an episode or of the data count for nothing
        :param costs: (B, 2) by how much its ``next_actions`` and random ones are worth less than the best ones; below 0 is 0
        :param dones: (B, 1) its dones: where the episode has ended critics learn no values
        """
        of_stored, of_random = costs.clamp(min=0).cpu().numpy().T
        self.costs[indices] = of_stored
        of_random = of_random[dones[:, 0].cpu().numpy() == 0]
        if len(of_random) > 0:
            before, mean = self.random_cost, float(of_random.mean())
            self.random_cost = before + COST_RATE * (mean - before) if np.isfinite(before) else mean

    def _update_change_rate(self) -> None:
        n = min(self.size(), max(N_FIRST // self.n_envs, 1))
        # Not for every batch
        if n >= 2 * self.n_seen:
            self.n_seen = n
            self.change_rate = change_rate(*(self._first(obs, n) for obs in (self.observations, self.next_observations)))

    def _first(self, observations: np.ndarray | dict[str, np.ndarray], n: int) -> np.ndarray:
        """:return: (n * n_envs, n_entries) entries of observations of the first n steps"""
        parts = observations.values() if isinstance(observations, dict) else [observations]
        entries = [part[:n].reshape(n * self.n_envs, -1) for part in parts]
        return np.concatenate([part[:, :: 1 + part.shape[1] // MAX_ENTRIES].astype(np.float64) for part in entries], axis=1)

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> WatkinsReplayBufferSamples:  # type: ignore[override]
        self._update_change_rate()
        envs = np.random.randint(0, self.n_envs, size=batch_inds.shape)
        steps = (batch_inds[:, None] + np.arange(self.n_steps)) % self.buffer_size
        index = steps, envs[:, None]

        # What follows the newest transition is not its future
        ends = (self.dones[index] + self.timeouts[index] > 0) | (steps == (self.pos - 1) % self.buffer_size)
        costs = self.random_cost + np.cumsum(self.costs[index][:, 1:], axis=1)
        goes_on = ~ends[:, :-1] & (costs <= self.tolerance) & (self.n_steps * self.change_rate < 1)
        goes_on &= np.random.random(goes_on.shape) < DECAY
        n = 1 + np.logical_and.accumulate(goes_on, axis=1).sum(axis=1)
        rewards = self._normalize_reward(self.rewards[index], env)
        counts = (np.arange(self.n_steps) < n[:, None]) * self.gamma ** np.arange(self.n_steps)

        last = (batch_inds + n - 1) % self.buffer_size
        following = (last + 1) % self.buffer_size, envs
        actions = self.to_torch(self.actions[batch_inds, envs])
        self._tell_last(actions, self.to_torch(self.actions[last, envs]))
        return WatkinsReplayBufferSamples(
            observations=observations_at(self, self.observations, (batch_inds, envs), env),
            actions=actions,
            next_observations=observations_at(self, self.next_observations, (last, envs), env),
            # Only use dones that are not due to timeouts
            dones=self.to_torch(self.dones[last, envs] * (1 - self.timeouts[last, envs]))[:, None],
            rewards=self.to_torch((rewards * counts).sum(axis=1, keepdims=True).astype(np.float32)),
            discounts=self.to_torch((self.gamma ** n[:, None]).astype(np.float32)),
            first_rewards=self.to_torch(rewards[:, :1]),
            next_actions=self.to_torch(self.actions[following]),
            next_indices=following,
        )


class WatkinsDictReplayBuffer(WatkinsReplayBuffer, DictReplayBuffer):  # type: ignore[misc]
    """:class:`WatkinsReplayBuffer` for dict observations."""
