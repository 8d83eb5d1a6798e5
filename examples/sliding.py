"""A puck after gym-hybrid's Sliding-v0: thrust, turn or brake, and stop on the target."""

import numpy as np
from compare import compare
from sliding_env import BRAKE, SlidingEnv


def do_nothing(env):
    return BRAKE, np.zeros(2, dtype=np.float32)


if __name__ == "__main__":
    compare(SlidingEnv(), do_nothing, n_timesteps=30_000, name="sliding")
