"""Replay of more than one step of an episode: where it ends, and n-step returns with what is known of the last state."""

import warnings

import numpy as np
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her import HerReplayBuffer

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
        columns, last_rows = self.action_space.columns, self.to_torch(self.actions[last, env_indices])
        for name in self.action_space.state_parts:
            if name.startswith("next_"):
                columns.view(samples.actions, name)[:] = columns.view(last_rows, name)
        return samples


def end_trajectories(buffer: ReplayBuffer) -> None:
    """
    Let unfinished episodes end with the newest transitions, as at a time limit: what is added next comes of a reset.

    :param buffer: the replay buffer, which may be empty
    """
    if buffer.size() == 0:
        return
    newest = (buffer.pos - 1) % buffer.buffer_size
    if isinstance(buffer, HerReplayBuffer):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="The last trajectory in the replay buffer")
            buffer.truncate_last_trajectory()
    elif buffer.optimize_memory_usage:
        buffer.dones[newest] = 1  # the next observation, which it takes from what is added next, counts for nothing
    else:
        buffer.timeouts[newest] = np.maximum(buffer.timeouts[newest], 1 - buffer.dones[newest])
