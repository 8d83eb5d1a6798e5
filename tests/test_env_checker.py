"""The mistakes that users make in their environments, and what they are told to do about each."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_chdp import CHDP, ScalarBoxes, check_hybrid_env
from tests.hybrid_envs import GoalEnv, LayoutEnv, MaskedEnv, Walk, box, layouts, walk

PLANE = box(-1, 1, 2)


def observing(space, value=None):
    """:return: the walk with other observations, samples of the space if no value is given"""
    return walk(observation_space=space, observation=(lambda self: space.sample()) if value is None else value)


def old_reset(self):
    self.t = 0
    return self.observation(), {}


def reset_without_info(self, *, seed=None, options=None):
    return Walk.reset(self, seed=seed)[0]


def unseeded_reset(self, *, seed=None, options=None):
    return Walk.reset(self)


def four_values(self, action):
    obs, reward, terminated, truncated, info = Walk.step(self, action)
    return obs, reward, terminated or truncated, info


def one_array(self):
    self.__dict__.setdefault("kept", np.zeros(2, np.float32))[:] = Walk.observation(self)
    return self.kept


def kept_observation(self):
    self.kept = Walk.observation(self)
    return self.kept


def reset_in_place(self, *, seed=None, options=None):
    before = self.__dict__.get("kept", np.zeros(2, np.float32))
    before[:] = Walk.reset(self, seed=seed)[0]
    return before, {}


def far_away_at_times(self):
    return np.array([0, 1.5 if self.t == 15 else 0.5], dtype=np.float32)


def failing_assertion(self):
    raise AssertionError("the robot is off")


ERRORS = {
    "class": (lambda: Walk, "env is the class Walk: give an object of it, Walk()"),
    "vec_env": (lambda: DummyVecEnv([Walk]), "env is a DummyVecEnv, which holds several environments: give one of them"),
    "no_env": (lambda: object(), "env is a object: derive the class from gymnasium.Env"),
    "no_action_space": (lambda: walk(action_space=None), "env.action_space is None: set it in __init__ to a space"),
    "only_boxes": (lambda: walk(action_space=PLANE), "must be a Tuple, Dict or OneOf with a discrete and a continuous part"),
    "key_of_modules": (
        lambda: observing(spaces.Dict({"type": PLANE})),
        "observation_space has the key 'type', which PyTorch takes for no name: rename it",
    ),
    "unbounded": (
        lambda: walk(action_space=spaces.Tuple((spaces.Discrete(2), box(-np.inf, 1, 2)))),
        "action_space[1] is unbounded or has NaN bounds (Box(-inf, 1.0, (2,), float32)); give it finite bounds, in the "
        "environment or with gymnasium.wrappers.TransformAction(",
    ),
    "text_in_action": (
        lambda: walk(action_space=spaces.Tuple((spaces.Discrete(2), PLANE, spaces.Text(3)))),
        "action_space[2] is a Text; a hybrid action is made of Discrete, MultiDiscrete, MultiBinary and Box parts",
    ),
    "nested_observation": (
        lambda: observing(spaces.Dict({"a": spaces.Dict({"x": PLANE})})),
        "observation_space['a'] is a Dict, but SB3's policies read Box, Discrete, MultiDiscrete (of one dimension) and "
        "MultiBinary, the discrete ones from 0 on, and a Dict of these; flatten the observations to one vector with "
        "gymnasium.wrappers.FlattenObservation(env)",
    ),
    "tuple_observation": (lambda: observing(spaces.Tuple((PLANE, PLANE))), "observation_space is a Tuple, but"),
    "oneof_inside": (
        lambda: walk(action_space=spaces.Tuple((spaces.Discrete(2), spaces.OneOf((PLANE, PLANE))))),
        "action_space[1] is a OneOf; a hybrid action is made of Discrete, MultiDiscrete, MultiBinary and Box parts, or is a",
    ),
    "broken_masks": (lambda: walk(action_masks=lambda self: 1 / 0), "action_masks() failed with ZeroDivisionError: division"),
    "no_elements": (lambda: observing(box(-1, 1, 0)), "which has no elements: leave it out"),
    "a_number": (lambda: observing(spaces.Box(-1, 1, ())), "a number: make it an array, of the shape (1,)"),
    "observation_from_one": (lambda: observing(spaces.Discrete(4, start=1)), "observation_space is Discrete(4, start=1), but"),
    "sequence_observation": (
        lambda: observing(spaces.Sequence(PLANE)),
        "give the observations a fixed size, for example by padding them to a Box",
    ),
    "reset_without_seed": (
        lambda: walk(reset=old_reset),
        "reset() has no argument seed: write def reset(self, *, seed=None, options=None)",
    ),
    "reset_without_options": (
        lambda: walk(reset=lambda self, seed=None: Walk.reset(self, seed=seed)),
        "reset() has no argument options: write def reset(self, *, seed=None, options=None)",
    ),
    "reset_asserts": (lambda: walk(observation=failing_assertion), "reset() failed with AssertionError: the robot is off"),
    "reset_without_info": (
        lambda: walk(reset=reset_without_info),
        "reset() must return two values, observation and info, got a ndarray",
    ),
    "reset_fails": (lambda: walk(observation=lambda self: self.position), "reset() failed with AttributeError: 'Walk' object"),
    "list": (lambda: observing(PLANE, [0.1, 0.2]), "observation is a list, not an array: return np.asarray("),
    "dtype": (lambda: observing(PLANE, np.zeros(2)), "observation has dtype float64, and its space float32: return np.a"),
    "shape": (lambda: observing(PLANE, np.zeros((1, 2), np.float32)), "observation has the shape (1, 2), and its space (2,)"),
    "nan": (lambda: observing(PLANE, np.array([0, np.nan], np.float32)), "observation must be finite, and at most 1e+15 in"),
    "too_large": (
        lambda: observing(box(-np.inf, np.inf, 2), np.array([0, 1e20], np.float32)),
        "observation must be finite, and at most 1e+15 in size, got [0.e+00 1.e+20]",
    ),
    "outside": (
        lambda: walk(observation=far_away_at_times, terminated=False),
        "step() returned a wrong observation: observation is outside of its space: element [1] is 1.5, and the bounds there "
        "are -1.0 and 1.0: widen the bounds or clip the value",
    ),
    "missing_key": (
        lambda: observing(spaces.Dict({"x": PLANE, "y": PLANE}), {"x": np.zeros(2, np.float32)}),
        "observation has the keys ['x'], and its space ['x', 'y']: give both the same",
    ),
    "no_dict": (lambda: observing(spaces.Dict({"x": PLANE}), 3), "observation is a int, not a dict: return one with the keys"),
    "not_in_discrete": (lambda: observing(spaces.Discrete(3), 3), "observation is 3, which is not in Discrete(3): mend the"),
    "four_values": (
        lambda: walk(step=four_values),
        "step() must return five values, observation, reward, terminated, truncated and info, got 4 of types ndarray, float,",
    ),
    "reward_of_numpy": (lambda: walk(reward=np.float32(1)), "The reward must be a float, got np.float32(1.0) of type float32"),
    "reward_none": (lambda: walk(reward=None), "The reward must be a float, got None of type NoneType: return float(reward)"),
    "reward_infinite": (lambda: walk(reward=-np.inf), "The reward must be finite, and at most 1e+15 in size, got -inf"),
    "reward_too_large": (lambda: walk(reward=-1e16), "at most 1e+15 in size, got -1e+16 after"),
    "success_in_words": (lambda: walk(info={"is_success": "yes"}), "info['is_success'] must be True or False, got 'yes'"),
    "terminated": (lambda: walk(terminated=np.bool_(False)), "terminated must be a bool, got np.False_: return bool("),
    "truncated": (lambda: walk(truncated=0), "truncated must be a bool, got 0: return bool(truncated)"),
    "info": (lambda: walk(info=None), "The info of step() must be a dict, got None: return {} if there is nothing to say"),
    "success_of_some_episodes": (
        lambda: walk(info=lambda self: {"is_success": True} if self.t % 2 == 0 else {}),
        "info['is_success'] must be there at the end of every episode or of none: set it in every step()",
    ),
    "wrong_key": (lambda: walk(reward=lambda self, action: action["x"]), "failed with TypeError: tuple indices must be"),
    "wants_scalars": (
        lambda: walk(action_space=layouts()["dict"], reward=lambda self, action: {0.0: 1.0}.get(action["values"][0], 0.0)),
        "failed with TypeError: unhashable type: 'numpy.ndarray'. It works with numbers in place of arrays of one element: "
        "wrap the environment in sb3_chdp.ScalarBoxes(env)",
    ),
    "reward_is_array": (
        lambda: walk(action_space=layouts()["dict"], reward=lambda self, action: action["values"][0] + 1.0),
        "return float(reward). It works with numbers in place of arrays of one element",
    ),
    "a_name": (lambda: "Goal-v0", "env is a name: give the environment, gymnasium.make('Goal-v0')"),
    "own_contains": (
        lambda: walk(
            action_space=type("Own", (spaces.Tuple,), {"contains": lambda self, x: False})((spaces.Discrete(3), PLANE))
        ),
        "but env.action_space.contains() says no",
    ),
}
WARNINGS = {
    "single_action": (
        lambda: walk(action_space=spaces.Tuple((spaces.Discrete(1), spaces.Tuple((PLANE,))))),
        "a single discrete action: an algorithm for Box actions would do",
    ),
    "one_box_each": (
        lambda: walk(action_space=spaces.Dict(lift=spaces.Discrete(2), x=PLANE, y=PLANE)),
        "discrete actions 0, 1, ... have the parameters action_space['x'], action_space['y'], one box each: give",
    ),
    "one_box_for_all": (
        lambda: walk(
            action_space=spaces.Tuple((spaces.Discrete(2), PLANE, PLANE)), reward=lambda self, action: float(action[2][0])
        ),
        "have an effect. If every action has all of them, give the algorithm, and this function, action_layout='shared'.",
    ),
    "a_number_each": (
        lambda: walk(
            action_space=spaces.Tuple((spaces.Discrete(2), PLANE)), reward=lambda self, action: float(action[1][action[0]])
        ),
        "action_space[1][0] with action 0, action_space[1][1] with action 1, and so on: give the algorithm, and this "
        "function, action_layout='per_action'",
    ),
    "rows_for_all": (
        lambda: walk(
            action_space=spaces.Tuple((spaces.Discrete(2), box(-1, 1, 2, 3))),
            reward=lambda self, action: float(action[1].sum()),
        ),
        "have an effect. If every action has all of them, give the algorithm, and this function, action_layout='shared'.",
    ),
    "sorted_keys": (
        lambda: walk(
            action_space=spaces.Tuple((spaces.Discrete(2), spaces.Dict({"run": PLANE, "hop": PLANE}))),
            reward=lambda self, action: float(action[1][["run", "hop"][action[0]]][0]),
        ),
        "action 0 has action_space[1]['hop'], action 1 action_space[1]['run'], and so on; a Dict made of a plain dict sorts",
    ),
    "no_end": (
        lambda: walk(terminated=False, truncated=False),
        "No episode ended in 10,000 random steps: give the environment a time limit, with gymnasium.wrappers.TimeLimit(env, ",
    ),
    "limit_as_termination": (
        lambda: walk(terminated=lambda self: self.t == 20, truncated=False),
        "All random episodes terminated after 20 steps: if that is a time limit, return truncated=True and terminated=False",
    ),
    "seed_without_effect": (
        lambda: walk(reset=unseeded_reset),
        "call super().reset(seed=seed) and draw random numbers from self",
    ),
    "other_generator": (
        lambda: walk(observation=lambda self: np.random.uniform(-1, 1, 2).astype(np.float32)),
        "Two runs with reset(seed=1) and the same actions differ",
    ),
    "clock": (
        lambda: observing(spaces.Box(0, np.inf, (2,), np.float64), lambda self: np.array([self.t, 1.7e9 + self.t])),
        "observation changes at [[1]] by less than float32 can hold, in which policies read it: subtract",
    ),
    "clock_in_whole_numbers": (
        lambda: observing(spaces.Box(0, 2**40, (2,), np.int64), lambda self: np.array([self.t, 1_700_000_000 + self.t])),
        "observation changes at [[1]] by less than float32 can hold, in which policies read it: subtract",
    ),
    "overwritten": (lambda: walk(observation=one_array), "step() or reset() overwrites the observation that was returned"),
    "overwritten_by_reset": (
        lambda: walk(observation=kept_observation, reset=reset_in_place),
        "step() or reset() overwrites the observation that was returned before: return a copy",
    ),
    "one_info": (lambda: walk(info={}), "step() returns the same info every time, in which wrappers leave their notes"),
}


SOUND = {
    "walk": Walk,
    "success_at_the_end_only": lambda: walk(terminated=False, info=lambda self: {"is_success": True} if self.t == 20 else {}),
    "forbidden_actions": MaskedEnv,
    "float16": lambda: observing(spaces.Box(-1, 1, (2,), np.float16), lambda self: Walk.observation(self).astype(np.float16)),
    "own_parameters": lambda: walk(
        action_space=spaces.Tuple((spaces.Discrete(2), spaces.Dict({"run": PLANE, "hop": PLANE}))),
        reward=lambda self, action: float(action[1][["hop", "run"][action[0]]][0]),
    ),
}


@pytest.mark.parametrize("name", SOUND)
def test_a_sound_environment_is_passed_in_silence(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_hybrid_env(SOUND[name]())


@pytest.mark.parametrize("mistake", ERRORS)
def test_errors(mistake):
    make, sentence = ERRORS[mistake]
    with pytest.raises((AssertionError, ValueError)) as raised:
        check_hybrid_env(make())
    assert sentence in str(raised.value)


@pytest.mark.parametrize("mistake", WARNINGS)
def test_warnings(mistake):
    make, sentence = WARNINGS[mistake]
    with pytest.warns(UserWarning) as said:
        check_hybrid_env(make())
    assert [warning for warning in said if sentence in str(warning.message)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_hybrid_env(make(), warn=False)


@pytest.mark.parametrize("action_layout", ["auto", "per_action", "shared"])
@pytest.mark.parametrize("numbers", ["none", "own", "all"])
def test_numbers_of_a_vector(numbers, action_layout):
    """There is a hint where the vector was read in the wrong way, and nowhere else."""
    rewards = {
        "none": lambda self, action: 0.0,
        "own": lambda self, action: float(action[1][action[0]]),
        "all": lambda self, action: float(action[1].sum()),
    }
    env = walk(action_space=spaces.Tuple((spaces.Discrete(2), PLANE)), reward=rewards[numbers])
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        check_hybrid_env(env, action_layout)
    hints = [str(warning.message) for warning in said if "action_layout=" in str(warning.message)]
    assert len(hints) == ((numbers, action_layout) in {("own", "auto"), ("all", "per_action")}), hints


@pytest.mark.parametrize("layout", layouts())
def test_every_layout_passes(layout):
    check_hybrid_env(LayoutEnv(layouts()[layout]), warn=False)


def test_training_through_scalar_boxes():
    class Strict(Walk):
        action_space = spaces.OneOf((box(0, 1, 1), box(2, 3, 1)))

        def reward(self, action):
            assert isinstance(action[1], float)
            return action[1]

    CHDP("MlpPolicy", ScalarBoxes(Strict()), learning_starts=5, n_diffusion_steps=2, batch_size=4).learn(10)


def test_training_refuses_what_the_checker_does():
    for mistake in ("nested_observation", "tuple_observation", "observation_from_one"):
        make, sentence = ERRORS[mistake]
        with pytest.raises(ValueError) as raised:
            CHDP("MultiInputPolicy", make())
        assert sentence in str(raised.value)


def test_flattening_mends_nested_observations():
    env = gym.wrappers.FlattenObservation(
        observing(spaces.Dict({"a": spaces.Dict({"x": PLANE}), "k": spaces.Discrete(3, start=1)}))
    )
    check_hybrid_env(env, warn=False)
    CHDP("MlpPolicy", env, learning_starts=5, n_diffusion_steps=2, batch_size=4).learn(10)


def test_an_environment_with_goals():
    check_hybrid_env(GoalEnv())
