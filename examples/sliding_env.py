"""A puck on a plane after gym-hybrid's Sliding-v0: thrust, turn or brake, and stop on the target."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

THRUST, TURN, BRAKE = range(3)


class SlidingEnv(gym.Env):
    """
    Reward: how much nearer the puck came, less 0.001 per step; 1 for a stop on the target, -1 for leaving the plane.

    Action: what to do, the thrust (0 to 1) and the turn (-1 to 1, times 90 degrees). The puck keeps its velocity.
    Observation: position, speed, heading (cosine, sine), target, distance, on the target or not, share of the time gone.
    """

    time_limit = 200
    target_radius = 0.1

    def __init__(self):
        parameters = spaces.Box(np.array([0, -1], np.float32), np.array([1, 1], np.float32))
        self.action_space = spaces.Tuple((spaces.Discrete(3), parameters))
        self.observation_space = spaces.Box(-np.inf, np.inf, (10,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.position, self.target = self.np_random.uniform(-1, 1, 2), self.np_random.uniform(-0.9, 0.9, 2)
        self.velocity, self.heading, self.steps = np.zeros(2), self.np_random.uniform(-np.pi, np.pi), 0
        return self._observation(), {"is_success": False}

    def _ahead(self):
        return np.array([np.cos(self.heading), np.sin(self.heading)])

    def _distance(self):
        return float(np.linalg.norm(self.target - self.position))

    def _observation(self):
        distance, speed = self._distance(), np.linalg.norm(self.velocity)
        rest = [distance, distance < self.target_radius, self.steps / self.time_limit]
        return np.array([*self.position, speed, *self._ahead(), *self.target, *rest], dtype=np.float32)

    def step(self, action):
        kind, (thrust, turn) = action
        if kind == THRUST:
            self.velocity = self.velocity + thrust * self._ahead()
        elif kind == TURN:
            self.heading += turn * np.pi / 2
        else:
            speed = np.linalg.norm(self.velocity)
            self.velocity = self.velocity * (max(speed - 0.1, 0) / max(speed, 1e-9))
        before = self._distance()
        self.position = self.position + 0.005 * self.velocity
        self.steps += 1
        success = self._distance() < self.target_radius and bool(np.linalg.norm(self.velocity) < 1e-6)
        lost = bool(np.abs(self.position).max() > 1)
        reward = 1.0 if success else -1.0 if lost else before - self._distance() - 0.001
        return self._observation(), reward, success or lost, self.steps >= self.time_limit, {"is_success": success}
