"""Small environments with hybrid actions in every layout and several kinds of observations."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_chdp import HybridActionSpec

UNIT = spaces.Box(-1.0, 1.0, (1,), dtype=np.float32)


def box(low: float, high: float, *shape: int) -> spaces.Box:
    return spaces.Box(low, high, shape, dtype=np.float32)


def layouts() -> dict[str, spaces.Space]:
    """:return: one action space per layout, with 3 discrete actions, parameter sizes differ where they can"""
    return {
        "nested": spaces.Tuple((spaces.Discrete(3), spaces.Tuple((box(-1, 1, 2), box(0, 5, 1), box(-1, 1, 0))))),
        "flat": spaces.Tuple((spaces.Discrete(3), box(-2, 3, 1), box(-1, 1, 2), box(0, 1, 1))),
        "shared": spaces.Tuple((spaces.Discrete(3), box(-4, 4, 2))),
        "dict": spaces.Dict({"kind": spaces.Discrete(3), "values": spaces.Tuple((box(0, 1, 1), box(0, 2, 1), box(0, 3, 2)))}),
        "one_of": spaces.OneOf((box(0, 1, 2), spaces.Tuple((spaces.Discrete(2), box(5, 6, 1))))),
        "product": spaces.Dict({"a": spaces.MultiDiscrete([2, 2]), "b": spaces.MultiBinary(1), "x": box(-1, 1, 2)}),
    }


def gym_make(env_id: str, **kwargs: Any) -> Any:
    """:return: the environment, as Any: it and its wrappers have methods that ``gym.Env`` has not"""
    return gym.make(env_id, **kwargs)


class LayoutEnv(gym.Env):
    """
    Random observations; an action outside of the action space is an error.

    :param action_space: native action space
    :param observation_space: observation space, two floats if None
    :param episode_length: steps of an episode, which ends by truncation
    """

    def __init__(self, action_space: spaces.Space, observation_space: spaces.Space | None = None, episode_length: int = 10):
        self.action_space = action_space
        self.observation_space = observation_space or spaces.Box(-1.0, 1.0, (2,), dtype=np.float32)
        self.episode_length = episode_length
        self.t = 0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.t = 0
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        if not self.action_space.contains(action):
            raise ValueError(f"{action!r} is not in {self.action_space}")
        self.t += 1
        truncated = self.t >= self.episode_length
        return self.observation_space.sample(), float(self.np_random.normal()), False, truncated, {"is_success": False}


def make_layout_env(layout: str = "nested", **kwargs: Any) -> LayoutEnv:
    return LayoutEnv(layouts()[layout], **kwargs)


class MaskedEnv(LayoutEnv):
    """
    Allows some discrete actions at a time, which it tells by ``action_masks()``; any other one is an error.

    The observation shows the latest mask, so that it can be compared with those that a buffer stores.

    :param layout: name of the action space
    :param tells_last: whether infos hold the mask too, the only way to learn that of the last state of an episode
    """

    def __init__(self, layout: str = "nested", tells_last: bool = False):
        action_space = layouts()[layout]
        self.codec = HybridActionSpec(action_space)
        self.masks = np.ones(self.codec.n_discrete_actions, dtype=bool)
        super().__init__(action_space, spaces.Box(0.0, 1.0, self.masks.shape, dtype=np.float32))
        self.tells_last = tells_last

    def action_masks(self) -> np.ndarray:
        return self.masks

    def _draw(self) -> np.ndarray:
        self.masks = self.np_random.random(len(self.masks)) < 0.3
        self.masks[self.np_random.integers(len(self.masks))] = True
        return self.masks.astype(np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        return self._draw(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
        k = int(self.codec.to_row(action)[0])
        if not self.masks[k]:
            raise ValueError(f"{action} is masked")
        _, reward, terminated, truncated, info = super().step(action)
        obs = self._draw()
        return obs, reward, terminated, truncated, {**info, **({"action_masks": self.masks} if self.tells_last else {})}


class FewValidEnv(gym.Env):
    """
    Of 32 discrete actions the observed situation, one of 8, allows 4, of which one earns 1; what is not allowed costs 1.

    Episodes last one step.

    :param with_masks: whether ``action_masks()`` tells what is allowed, else only the penalty does
    """

    def __init__(self, with_masks: bool):
        self.action_space = spaces.Tuple((spaces.Discrete(32), UNIT))
        self.observation_space = spaces.Box(0.0, 1.0, (8,), dtype=np.float32)
        self.situation = 0
        if with_masks:
            self.action_masks = lambda: np.arange(32) // 4 == self.situation

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.situation = int(self.np_random.integers(8))
        return np.eye(8, dtype=np.float32)[self.situation], {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        situation, choice = divmod(int(action[0]), 4)
        reward = -1.0 if situation != self.situation else float(choice == situation % 4)
        obs, _ = self.reset()
        return obs, reward, True, False, {"is_success": reward == 1}


class HybridIdentityEnv(gym.Env):
    """
    Reward 1 if the discrete action is the observed one and its parameter lies within 0.3 of the observed value.

    Chance level of uniformly random actions: 0.09 for 3 actions. Episodes last one step.

    :param n_actions: number of discrete actions
    """

    def __init__(self, n_actions: int = 3):
        self.n_actions = n_actions
        self.action_space = spaces.Tuple((spaces.Discrete(n_actions), spaces.Tuple([UNIT] * n_actions)))
        self.observation_space = spaces.Box(-1.0, 1.0, (n_actions + 1,), dtype=np.float32)
        self.choice, self.value = 0, 0.0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.choice = int(self.np_random.integers(self.n_actions))
        self.value = float(self.np_random.uniform(-1, 1))
        obs = np.full(self.n_actions + 1, -1.0, dtype=np.float32)
        obs[self.choice], obs[-1] = 1.0, self.value
        return obs, {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        k, parameters = action
        success = k == self.choice and abs(float(parameters[k][0]) - self.value) < 0.3
        obs, _ = self.reset()
        return obs, float(success), True, False, {"is_success": success}


class HybridChainEnv(gym.Env):
    """
    Three decisions, and one reward for all of them at the end: the mean of how good they were.

    A decision is worth 0 with a wrong discrete action, else 1 less half the distance of its parameter from the best value.
    The observation says which step it is and what the decisions so far were worth. Learning from rewards alone, without the
    values of next states, gets the last decision right and leaves the others to chance.
    """

    # The right discrete action and the best value of its parameter
    STEPS = ((2, 0.5), (0, -0.5), (1, 0.5))

    def __init__(self):
        self.action_space = spaces.Tuple((spaces.Discrete(3), spaces.Tuple([UNIT] * 3)))
        self.observation_space = spaces.Box(0.0, 1.0, (len(self.STEPS) + 1,), dtype=np.float32)
        self.t, self.worth = 0, 0.0

    def _obs(self) -> np.ndarray:
        obs = np.zeros(len(self.STEPS) + 1, dtype=np.float32)
        if self.t < len(self.STEPS):
            obs[self.t] = 1.0
        obs[-1] = self.worth
        return obs

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.t, self.worth = 0, 0.0
        return self._obs(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        (k, parameters), (right_k, value) = action, self.STEPS[self.t]
        if k == right_k:
            self.worth += (1 - abs(float(parameters[k][0]) - value) / 2) / len(self.STEPS)
        self.t += 1
        done = self.t == len(self.STEPS)
        return self._obs(), self.worth if done else 0.0, done, False, {}


class GoalEnv(LayoutEnv):
    """What ``HerReplayBuffer`` needs."""

    def __init__(self):
        parts: dict[str, spaces.Space] = dict.fromkeys(("observation", "achieved_goal", "desired_goal"), box(-1, 1, 2))
        super().__init__(layouts()["shared"], spaces.Dict(parts))

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -np.abs(achieved_goal - desired_goal).sum(axis=-1)

    def step(self, action):
        obs, _, *rest = super().step(action)
        return obs, float(self.compute_reward(obs["achieved_goal"], obs["desired_goal"], {})), *rest


class Walk(gym.Env):
    """A walk at random with nothing wrong; see :func:`walk`."""

    action_space, observation_space = layouts()["shared"], box(-1, 1, 2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.observation(), {}

    def observation(self):
        return self.np_random.uniform(-1, 1, 2).astype(np.float32)

    def step(self, action):
        self.t += 1
        return self.observation(), self.reward(action), self.terminated(), self.truncated(), self.info()

    def reward(self, action):
        return 0.5

    def terminated(self):
        return bool(self.np_random.uniform() < 0.1)

    def truncated(self):
        return self.t >= 20

    def info(self):
        return {}


def walk(**changes):
    """:return: the walk, in which functions are methods and all else is returned in place of what a method returns"""
    methods = {
        name: change if callable(change) or name.endswith("space") else lambda self, *_, value=change: value
        for name, change in changes.items()
    }
    return type("Walk", (Walk,), methods)()
