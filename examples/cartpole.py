"""CartPole with a force: which way to push the cart, and how hard, in newtons."""

import gymnasium as gym
import numpy as np
from compare import compare
from gymnasium import spaces

LARGEST_FORCE = 10.0  # CartPole's only one


class Push(gym.ActionWrapper):
    def __init__(self, env):
        super().__init__(env)
        self.action_space = spaces.Tuple((spaces.Discrete(2), spaces.Box(0, LARGEST_FORCE, (1,))))

    def action(self, action):
        direction, force = action
        self.unwrapped.force_mag = force.item()
        return direction


def push_where_it_falls(env):
    *_, angle, speed = env.unwrapped.state
    return int(angle + speed > 0), np.array([LARGEST_FORCE], dtype=np.float32)


if __name__ == "__main__":
    compare(Push(gym.make("CartPole-v1")), push_where_it_falls, n_timesteps=5_000, name="cartpole")
