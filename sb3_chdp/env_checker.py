"""The counterpart of SB3's ``check_env`` for environments with hybrid actions."""

import inspect
import warnings
from collections.abc import Callable
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils.env_checker import data_equivalence
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.vec_env import VecEnv

from sb3_chdp.common.checks import LARGEST, check_keys, check_observation_space
from sb3_chdp.common.masks import allowed_now
from sb3_chdp.common.space_mismatch import mismatch
from sb3_chdp.common.space_tree import find_options, name_of
from sb3_chdp.common.spaces import HybridActionSpec
from sb3_chdp.wrappers import FlattenHybridAction, with_scalars

# Random discrete actions that are played with extreme parameters
N_EXTREMES = 40
# Random play ends after so many episodes, or steps if they do not end
N_EPISODES = 3
N_STEPS = 10_000
# Of two runs that are compared
N_COMPARED = 20
# Episodes that all terminate after the same number of steps: fewer may be the task's own horizon
SUSPICIOUS_LENGTH = 10


def check_hybrid_env(env: gym.Env, action_layout: str = "auto", warn: bool = True, skip_render_check: bool = True) -> None:
    """
    Check that an environment with hybrid actions can be used with this package.

    Its action space must be readable as a hybrid one, its observations as those of SB3's policies. Then it is played: with
    the ends of the actions' parameters, and at random until three episodes have ended, 10,000 steps at most. All else that
    SB3's ``check_env`` demands is checked on the flattened environment.

    :param env: the environment
    :param action_layout: see :class:`HybridActionSpec`
    :param warn: whether to warn about legal but unusual things
    :param skip_render_check: whether to skip the checks of the render method
    :raises ValueError: if the action space is not a hybrid one, or SB3's policies cannot read the observations
    :raises AssertionError: if the environment breaks the API; the message says what to fix
    """
    _check_is_env(env)
    spec = HybridActionSpec(env.action_space, action_layout)
    check_observation_space(env.observation_space)
    check_keys(env.observation_space)
    player = _Player(env, spec)
    player.play_extremes()
    player.play_episodes()
    if warn:
        of_seed = player.seed_oddity()
        of_layout = player.layout_oddity() if of_seed is None else None
        for sentence in [*player.oddities(), of_seed, of_layout or _unusual_space(spec)]:
            if sentence is not None:
                warnings.warn(sentence, stacklevel=2)
    flat = FlattenHybridAction(env, action_layout)
    _call("SB3's check_env", check_env, flat, warn=warn, skip_render_check=skip_render_check)


def _check_is_env(env: Any) -> None:
    if isinstance(env, type):
        raise AssertionError(f"env is the class {env.__name__}: give an object of it, {env.__name__}()")
    if isinstance(env, str):
        raise AssertionError(f"env is a name: give the environment, gymnasium.make({env!r})")
    if isinstance(env, (VecEnv, gym.vector.VectorEnv)):
        raise AssertionError(f"env is a {type(env).__name__}, which holds several environments: give one of them")
    if not isinstance(env, gym.Env):
        raise AssertionError(f"env is a {type(env).__name__}: derive the class from gymnasium.Env")
    for name in ("action_space", "observation_space"):
        if not isinstance(getattr(env, name, None), spaces.Space):
            given = repr(getattr(env, name)) if hasattr(env, name) else "not there"
            raise AssertionError(f"env.{name} is {given}: set it in __init__ to a space of gymnasium.spaces")


def _unusual_space(spec: HybridActionSpec) -> str | None:
    if spec.n_discrete_actions == 1:
        return "The action space has a single discrete action: an algorithm for Box actions would do"
    if spec.layout == "auto" and not spec.is_shared and isinstance(spec.space, spaces.Dict):
        found = find_options(spec.space)
        assert found is not None, "that is how it was read"
        parts = [name_of(path) for path, _ in found[1]]
        if all(len(path) == 1 for path, _ in found[1]):
            return (
                f"The discrete actions 0, 1, ... have the parameters {', '.join(parts)}, one box each: give the algorithm, "
                "and this function, action_layout='per_action' if this is meant, and 'shared' if every action has all of them"
            )
    return None


def _call(what: str, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Call what the user wrote; an error in it names what was called."""
    try:
        return function(*args, **kwargs)
    except Exception as error:
        raise AssertionError(f"{what} failed with {type(error).__name__}: {error}") from error


class _Player:
    """
    Plays an environment, and raises an AssertionError at the first thing that breaks the API.

    :param env: the environment
    :param spec: of its action space
    """

    def __init__(self, env: gym.Env, spec: HybridActionSpec):
        self.env, self.spec = env, spec
        # Ends of episodes, and those whose info says whether it was a success
        self.n_ends = self.n_successes = 0
        # Length of each random episode, and whether it ended by termination
        self.episodes: list[tuple[int, bool]] = []
        self.overwrites = self.reuses_info = False
        self._last_info: dict[str, Any] | None = None
        # Of observations by key: how often an entry changed, and how often in float32 too
        self.changes: dict[str, np.ndarray] = {}

    def reset(self, **kwargs: Any) -> Any:
        """:return: the observation"""
        answer = _call("reset()", self.env.reset, **kwargs)
        if not (isinstance(answer, tuple) and len(answer) == 2):
            raise AssertionError(f"reset() must return two values, observation and info, got {_types(answer)}")
        obs, info = answer
        self._check_obs(obs, "reset()")
        self._check_info(info, "reset()")
        return obs

    def _check_obs(self, obs: Any, method: str) -> None:
        sentence = mismatch(self.env.observation_space, obs, "observation")
        if sentence is not None:
            raise AssertionError(f"{method} returned a wrong observation: {sentence}")

    @staticmethod
    def _check_info(info: Any, method: str) -> None:
        if not isinstance(info, dict):
            raise AssertionError(f"The info of {method} must be a dict, got {info!r}: return {{}} if there is nothing to say")

    def step(self, action: Any) -> tuple[Any, float, bool, bool]:
        """:return: observation, reward, terminated, truncated"""
        if not self.env.action_space.contains(action):
            raise AssertionError(
                f"{action} was made for {self.spec.space}, but env.action_space.contains() says no, or is another space by "
                "now: leave contains() and the space as they are"
            )
        try:
            answer = self.env.step(action)
        except Exception as error:
            sentence = str(error).rstrip(".") + self._hint_at_scalars(action)
            raise AssertionError(f"step({action}) failed with {type(error).__name__}: {sentence}") from error
        if not (isinstance(answer, tuple) and len(answer) == 5):
            raise AssertionError(
                f"step() must return five values, observation, reward, terminated, truncated and info, got {_types(answer)}"
            )
        obs, reward, terminated, truncated, info = answer
        self._check_obs(obs, "step()")
        self._check_reward(reward, action)
        for name, value in (("terminated", terminated), ("truncated", truncated)):
            if not isinstance(value, bool):
                raise AssertionError(f"{name} must be a bool, got {value!r}: return bool({name})")
        self._check_info(info, "step()")
        self.reuses_info |= info is self._last_info
        self._last_info = info
        if terminated or truncated:
            self.n_ends += 1
            self.n_successes += "is_success" in info
            if not isinstance(info.get("is_success", False), (bool, np.bool_, int, float)):
                raise AssertionError(f"info['is_success'] must be True or False, got {info['is_success']!r}")
        # Monitor and EvalCallback, which read it at the end of episodes, fail when only some report it
        if self.n_successes not in (0, self.n_ends):
            raise AssertionError(
                "info['is_success'] must be there at the end of every episode or of none: set it in every step()"
            )
        return obs, float(reward), terminated, truncated

    def _check_reward(self, reward: Any, action: Any) -> None:
        if not isinstance(reward, (float, int)):
            what = f"The reward must be a float, got {reward!r} of type {type(reward).__name__}"
            raise AssertionError(f"{what}: return float(reward){self._hint_at_scalars(action)}")
        if not abs(reward) <= LARGEST:
            raise AssertionError(
                f"The reward must be finite, and at most {LARGEST:.0e} in size, got {reward} after {action}: look for a "
                "division by zero or an overflow"
            )

    def _hint_at_scalars(self, action: Any) -> str:
        """Whether numbers in place of arrays of one element mend what went wrong."""
        numbers = with_scalars(self.env.action_space, action)
        if data_equivalence(numbers, action):
            return ""
        try:
            self.env.reset()
            reward = self.env.step(numbers)[1]
        except Exception:
            return ""
        if not isinstance(reward, (float, int)):
            return ""
        return ". It works with numbers in place of arrays of one element: wrap the environment in sb3_chdp.ScalarBoxes(env)"

    def play_extremes(self) -> None:
        """Play random discrete actions with all parameters at one of their ends."""
        parameters = inspect.signature(self.env.unwrapped.reset).parameters
        takes_all = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
        for name in ("seed", "options"):
            if name not in parameters and not takes_all:
                raise AssertionError(f"reset() has no argument {name}: write def reset(self, *, seed=None, options=None)")
        self.reset(seed=0)
        rng = np.random.default_rng(0)
        for i in range(N_EXTREMES):
            row = self._random_row(rng)
            self.spec.columns.view(row, "parameters")[:] = (-1.0, 1.0)[i % 2]
            *_, terminated, truncated = self.step(self.spec.to_native(row))
            if terminated or truncated:
                self.reset()

    def play_episodes(self) -> None:
        """Play at random until some episodes have ended."""
        rng = np.random.default_rng(0)
        obs, length = self.reset(seed=0), 0
        for _ in range(N_STEPS):
            kept, before = obs, deepcopy(obs)
            obs, _, terminated, truncated = self.step(self.spec.to_native(self._random_row(rng)))
            self.overwrites |= not data_equivalence(kept, before, exact=True)
            self._count_changes(before, obs)
            length += 1
            if terminated or truncated:
                self.episodes.append((length, terminated))
                if len(self.episodes) == N_EPISODES:
                    break
                kept, before = obs, deepcopy(obs)
                obs, length = self.reset(), 0
                self.overwrites |= not data_equivalence(kept, before, exact=True)

    def _count_changes(self, before: Any, obs: Any) -> None:
        parts = obs if isinstance(obs, dict) else {"": obs}
        for key, part in parts.items():
            if isinstance(part, np.ndarray) and part.dtype.kind in "fiu" and part.dtype.itemsize >= 4:
                former = before[key] if key else before
                changed = [part != former, part.astype(np.float32) != former.astype(np.float32)]
                self.changes[key] = self.changes.get(key, 0) + np.array(changed)

    def _random_row(self, rng: np.random.Generator) -> np.ndarray:
        return self.spec.sample_rows(rng, 1, _call("action_masks()", allowed_now, self.env, self.spec))[0]

    def oddities(self) -> list[str]:
        """:return: what is legal but most likely not meant, in the episodes played"""
        found = []
        if not self.episodes:
            found.append(
                f"No episode ended in {N_STEPS:,} random steps: give the environment a time limit, with "
                "gymnasium.wrappers.TimeLimit(env, max_episode_steps) or gym.register(..., max_episode_steps=...)"
            )
        lengths = {length for length, terminated in self.episodes if terminated}
        if len(self.episodes) == N_EPISODES and len(lengths) == 1 and all(terminated for _, terminated in self.episodes):
            (length,) = lengths
            if length >= SUSPICIOUS_LENGTH:
                found.append(
                    f"All random episodes terminated after {length} steps: if that is a time limit, return truncated=True "
                    "and terminated=False there, so that the future after it counts"
                )
        for key, (in_float64, in_float32) in self.changes.items():
            lost = np.argwhere(in_float32 < in_float64 / 2)
            if len(lost):
                name = f"observation[{key!r}]" if key else "observation"
                found.append(
                    f"{name} changes at {lost.tolist()} by less than float32 can hold, in which policies read it: subtract "
                    "what is the same in all states"
                )
        if self.overwrites:
            found.append("step() or reset() overwrites the observation that was returned before: return a copy, obs.copy()")
        if self.reuses_info:
            found.append("step() returns the same info every time, in which wrappers leave their notes: return a new dict")
        return found

    def seed_oddity(self) -> str | None:
        """:return: what is wrong if two runs with one seed differ"""
        if data_equivalence(self._run(self.spec), self._run(self.spec)):
            return None
        return (
            "Two runs with reset(seed=1) and the same actions differ: call super().reset(seed=seed) and draw random numbers "
            "from self.np_random only, so that trainings can be repeated. If a wrapper keeps statistics, check the "
            "environment without it"
        )

    def layout_oddity(self) -> str | None:
        """
        Compare runs in which only parameters of other actions than the chosen ones differ.

        :return: what is wrong with how the action space was read
        """
        spec = self.spec
        if spec.is_shared:
            if spec.layout != "auto" or find_options(spec.space, vectors=True) is None:
                return None
            spec = HybridActionSpec(spec.space, "per_action")
        low, high = (self._run(spec.leaving_others_at(place)) for place in (-1, 1))
        have_effect = not data_equivalence(low, high)
        if self.spec.is_shared:
            # Where no parameter at all has an effect there is nothing to say
            if have_effect or data_equivalence(low, self._run(self.spec)):
                return None
            return (
                f"Only one number of the Box seems to have an effect, {spec.names_of(0)} with action 0, {spec.names_of(1)} "
                "with action 1, and so on: give the algorithm, and this function, action_layout='per_action'"
            )
        if not have_effect:
            return None
        return (
            "Parameters of other actions than the chosen one have an effect. If every action has all of them, give the "
            "algorithm, and this function, action_layout='shared'. Else put them in the order of the actions: action 0 has "
            f"{spec.names_of(0)}, action 1 {spec.names_of(1)}, and so on; a Dict made of a plain dict sorts its keys"
        )

    def _run(self, spec: HybridActionSpec) -> list[Any]:
        """:return: what comes of random actions after ``reset(seed=1)``, made native by this codec"""
        rng = np.random.default_rng(1)
        run: list[Any] = [deepcopy(self.reset(seed=1))]
        for _ in range(N_COMPARED):
            answer = self.step(spec.to_native(self._random_row(rng)))
            run.append(deepcopy(answer))
            if answer[2] or answer[3]:
                break
        return run


def _types(answer: Any) -> str:
    if not isinstance(answer, tuple):
        return f"a {type(answer).__name__}"
    return f"{len(answer)} of types {', '.join(type(part).__name__ for part in answer)}"
