"""Episodes in replay buffers that are cut off."""

import warnings

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.her import HerReplayBuffer


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
