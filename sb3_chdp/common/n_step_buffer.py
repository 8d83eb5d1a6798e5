"""n-step returns with what rows know of the last of the n states."""

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from sb3_chdp.common.arguments import Accepted, check, constructor_defaults, is_class_of, whole
from sb3_chdp.common.hybrid_box import HybridBox


class HybridNStepReplayBuffer(NStepReplayBuffer):
    """
    SB3's n-step replay buffer for rows with ``next_masks`` or ``next_returns``, which in its samples are those of the last of
    the n steps. n-step buffers of one's own have to derive from it.

    The arguments are those of :class:`stable_baselines3.common.buffers.NStepReplayBuffer`.
    """

    action_space: HybridBox

    def _get_samples(self, batch_inds: np.ndarray, env: VecNormalize | None = None) -> ReplayBufferSamples:
        # SB3's method draws the environments: here they are drawn before it, to know them, and there once more
        before = np.random.get_state()
        env_indices = np.random.randint(0, self.n_envs, size=batch_inds.shape)
        np.random.set_state(before)
        samples = super()._get_samples(batch_inds, env)

        steps = (batch_inds[:, None] + np.arange(self.n_steps)) % self.buffer_size
        ends = self.dones[steps, env_indices[:, None]] + self.timeouts[steps, env_indices[:, None]] > 0
        # What follows the newest transition is not its future
        ends |= steps == (self.pos - 1) % self.buffer_size
        ends[:, -1] = True
        last = steps[np.arange(len(steps)), ends.argmax(axis=1)]
        self._tell_last(samples.actions, self.to_torch(self.actions[last, env_indices]))
        return samples

    def _tell_last(self, rows: th.Tensor, last_rows: th.Tensor) -> None:
        """What rows say about the next state becomes that of the last of the n steps."""
        columns = self.action_space.columns
        for name in self.action_space.state_parts:
            if name.startswith("next_"):
                columns.view(rows, name)[:] = columns.view(last_rows, name)


# What rows say about the next state is that of the last of n steps
TELLS_LAST = Accepted(
    "derived from HybridNStepReplayBuffer if it is one of n steps",
    lambda kind: not is_class_of(kind, NStepReplayBuffer) or issubclass(kind, HybridNStepReplayBuffer),
)


def n_step_settings(
    kind: type[ReplayBuffer] | None,
    kwargs: dict[str, Any],
    n_steps: int,
    gamma: float,
    has_dicts: bool,
    default: type[ReplayBuffer] | None,
) -> tuple[type[ReplayBuffer] | None, dict[str, Any]]:
    """
    :param kind: class of the replay buffer, None if the user names none
    :param kwargs: its keyword arguments, as far as the user names them
    :param n_steps: that of the algorithm; with 1 the default of a buffer of n steps holds
    :param gamma: that of the algorithm
    :param has_dicts: whether observations are dicts, of which SB3 refuses n-step returns
    :param default: class of the buffer if neither the user names one nor ``n_steps`` asks for one; None: SB3's
    :return: class and keyword arguments of the buffer to make
    """
    if kind is None and n_steps == 1:
        kind = default
    if kind is NStepReplayBuffer or (kind is None and n_steps > 1 and not has_dicts):
        kind = HybridNStepReplayBuffer
    if kind is not None and issubclass(kind, NStepReplayBuffer):
        of_algorithm = {"gamma": gamma, **({"n_steps": n_steps} if n_steps > 1 else {})}
        taken = constructor_defaults(kind)
        kwargs = {**{name: value for name, value in of_algorithm.items() if name in taken}, **kwargs}
        check(whole(1), n_steps=kwargs.get("n_steps", n_steps))
    return kind, dict(kwargs)
