"""Numbers that nothing can be learnt from are refused before they are stored or fed, and losses before they move a network."""

import warnings
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_chdp import HPPO, PATD3
from sb3_chdp.common.checks import check_numbers
from sb3_chdp.common.resume import ResumableCheckpoint, resume
from sb3_chdp.common.utils import NonFiniteLossError, gradient_step
from tests.algorithms import OFF_POLICY_ALGORITHMS, has_learnt, make_model, snapshot
from tests.hybrid_envs import LayoutEnv, box, layouts, make_layout_env

DICT = spaces.Dict({"place": box(-1, 1, 2), "speed": box(-1, 1, 1)})


class BrokenEnv(LayoutEnv):
    """
    Puts out a number that it should not.

    :param place: "first" (observation after the second reset), "next" (the 15th), "terminal" or "truncated" (the last of the
        second episode) or "reward"
    :param value: the number
    """

    def __init__(self, place, value, observation_space=None):
        super().__init__(layouts()["shared"], observation_space, episode_length=10)
        self.place, self.value, self.n = place, value, 0
        self.n_resets = 0

    def broken(self, obs):
        part = obs["speed"] if isinstance(obs, dict) else obs
        part[0] = self.value
        return obs

    def reset(self, **kwargs):
        obs, info = super().reset(**kwargs)
        self.n_resets += 1
        return (self.broken(obs) if self.place == "first" and self.n_resets == 2 else obs), info

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        self.n += 1
        if self.place == "terminal":
            terminated, truncated = truncated, False
        if (self.place, self.n) in (("next", 15), ("terminal", 20), ("truncated", 20)):
            obs = self.broken(obs)
        if (self.place, self.n) == ("reward", 15):
            reward = self.value
        return obs, reward, terminated, truncated, info


def arrays_of(model):
    """:return: everything that must be finite: parameters, what optimizers keep, and the buffer"""
    yield from (p.detach().numpy() for p in model.policy.parameters())
    for name, state in model.get_parameters().items():
        if name.endswith("optimizer"):
            yield from (np.asarray(value) for each in state["state"].values() for value in each.values())
    buffer = model.replay_buffer if hasattr(model, "replay_buffer") else model.rollout_buffer
    for part in (buffer.observations, getattr(buffer, "next_observations", {}), buffer.rewards):
        yield from part.values() if isinstance(part, dict) else [part]


def is_finite(model):
    return all(np.isfinite(array).all() for array in arrays_of(model))


def goes_on(model, env):
    """:return: whether the model learns in a sound environment, and stays finite"""
    model.set_env(env)
    before = snapshot(model)
    model.learn(40)
    return has_learnt(model, before) and is_finite(model)


PLACES = {
    "first": "The observation",
    "next": "The observation",
    "terminal": "The terminal observation",
    "truncated": "The terminal observation",
    "reward": "The reward",
}


@pytest.mark.parametrize(("place", "value"), [*((place, np.nan) for place in PLACES), ("next", -np.inf), ("reward", 1e38)])
def test_bad_numbers_are_refused(algorithm, place, value):
    env = DummyVecEnv([make_shared_env, lambda: BrokenEnv(place, value)])
    model = make_model(algorithm, env)
    with pytest.raises(ValueError, match=rf"{PLACES[place]} must be finite and between .* from environment\(s\) \[1\]"):
        model.learn(60)
    if algorithm in OFF_POLICY_ALGORITHMS:
        # The sound transitions before are stored
        assert model.replay_buffer.size() == {"first": 9, "next": 14, "terminal": 19, "truncated": 19, "reward": 14}[place]
    assert is_finite(model)
    assert goes_on(model, DummyVecEnv([make_shared_env] * 2))


def make_shared_env(**kwargs):
    return make_layout_env("shared", **kwargs)


@pytest.mark.parametrize("place", ["first", "next", "truncated"])
def test_bad_numbers_in_dict_observations(algorithm, place):
    model = make_model(algorithm, BrokenEnv(place, np.nan, DICT), "MultiInputPolicy")
    with pytest.raises(ValueError, match=rf"{PLACES[place]}\['speed'\] must be finite .* from environment\(s\) \[0\]"):
        model.learn(60)
    assert is_finite(model) and goes_on(model, make_shared_env(observation_space=DICT))


def test_the_very_first_observation(algorithm):
    env = BrokenEnv("first", np.nan)
    env.n_resets = 1
    model = make_model(algorithm, env)
    with pytest.raises(ValueError, match="The observation must be finite"):
        model.learn(60)
    # The same environment, which is sound from its next reset on
    model.learn(40, reset_num_timesteps=False)
    assert is_finite(model)


def test_after_an_error_the_environment_is_reset(off_policy_algorithm):
    """It has gone on: a step from what was seen before the error would never have happened."""
    env = BrokenEnv("reward", np.nan)
    model = make_model(off_policy_algorithm, env)
    with pytest.raises(ValueError, match="The reward must be finite"):
        model.learn(60)
    n_resets = env.n_resets
    # Too few for the end of an episode
    model.learn(2, reset_num_timesteps=False)
    assert env.n_resets == n_resets + 1


class MoreThanTheSpace(LayoutEnv):
    """Its observations have an entry that its space does not have."""

    def step(self, action):
        obs, *rest = super().step(action)
        return {**obs, "more": np.zeros(3)}, *rest


def test_entries_of_observations_that_are_not_in_the_space(algorithm):
    make_model(algorithm, MoreThanTheSpace(layouts()["shared"], DICT, episode_length=10), "MultiInputPolicy").learn(30)


@pytest.mark.parametrize("reward", [3e38, 1e20], ids=str)
def test_rewards_that_normalization_hides(algorithm, reward):
    env = VecNormalize(DummyVecEnv([lambda: BrokenEnv("reward", reward)]))
    model = make_model(algorithm, env)
    with pytest.raises(ValueError, match="The reward before normalization must be finite"):
        model.learn(60)
    assert is_finite(model) and goes_on(model, VecNormalize(DummyVecEnv([make_shared_env])))


def test_observations_that_normalization_hides(off_policy_algorithm):
    env = VecNormalize(DummyVecEnv([lambda: BrokenEnv("next", 1e30)]))
    with pytest.raises(ValueError, match="The observation before normalization must be finite"):
        make_model(off_policy_algorithm, env).learn(60)


@pytest.mark.parametrize("observation_space", [None, DICT], ids=["box", "dict"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30], ids=str)
@pytest.mark.parametrize("place", ["first", "next", "reward"])  # it counts no terminal observations
def test_normalization_forgets_what_is_refused(place, value, observation_space):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # NumPy's, of infinite means
        env = VecNormalize(DummyVecEnv([lambda: BrokenEnv(place, value, observation_space)]))
        model = make_model(PATD3, env, "MlpPolicy" if observation_space is None else "MultiInputPolicy")
        with pytest.raises(ValueError, match="must be finite"):
            model.learn(60)
        statistics = [env.ret_rms, *(env.obs_rms.values() if isinstance(env.obs_rms, dict) else [env.obs_rms])]
        assert all(np.abs(number).max() < 100 for rms in statistics for number in (rms.mean, rms.var))
        # The same environment, which is sound from now on
        model.learn(40, reset_num_timesteps=False)
    assert is_finite(model)


def test_normalization_forgets_a_refused_first_observation(algorithm):
    broken = BrokenEnv("first", np.nan)
    broken.n_resets = 1
    env: Any = VecNormalize(DummyVecEnv([lambda: broken]))
    model = make_model(algorithm, env)
    with pytest.raises(ValueError, match="The observation must be finite"):
        model.learn(60)
    assert np.isfinite(env.obs_rms.mean).all()
    model.learn(40, reset_num_timesteps=False)
    assert is_finite(model)


class LargeObservations(LayoutEnv):
    """Observations of up to 1e14, and 9e14 at the end of an episode."""

    def large(self, unit=1e14):
        return (unit * self.np_random.uniform(-1, 1, 2)).astype(np.float32)

    def reset(self, **kwargs):
        _, info = super().reset(**kwargs)
        return self.large(), info

    def step(self, action):
        _, reward, terminated, truncated, info = super().step(action)
        return self.large(9e14 if terminated or truncated else 1e14), reward, terminated, truncated, info


@pytest.mark.parametrize("activation_fn", [th.nn.Tanh, th.nn.ReLU])
def test_large_observations_are_learnt_from_or_refused(algorithm, activation_fn):
    env = LargeObservations(layouts()["shared"], box(-np.inf, np.inf, 2))
    model = make_model(algorithm, env, policy_kwargs=dict(net_arch=[8, 8], activation_fn=activation_fn))
    before = snapshot(model)
    try:
        model.learn(60)
    except NonFiniteLossError as error:
        assert "smaller rewards or observations" in str(error)
        assert algorithm is not HPPO or activation_fn is th.nn.ReLU
    else:
        assert has_learnt(model, before)
    assert is_finite(model)


class ShortLastObservation(LayoutEnv):
    """Of shape (1,) instead of (2,), which NumPy would stretch."""

    def step(self, action):
        obs, *rest = super().step(action)
        return obs[:1], *rest


def test_observations_of_another_shape(algorithm):
    model = make_model(algorithm, ShortLastObservation(layouts()["shared"]))
    with pytest.raises(ValueError, match=r"terminal observation must have shape \(2,\), got \(1,\) from environment 0"):
        model.learn(60)
    with pytest.raises(ValueError, match=r"shape \(1,\)"):
        model.predict(np.zeros(1, dtype=np.float32))


@pytest.mark.parametrize("std", [np.nan, 1e30], ids=str)
def test_action_noise_is_refused(off_policy_algorithm, std):
    model = make_model(off_policy_algorithm, make_vec_env(make_shared_env, 2))
    size = model.policy.noise_dim
    model.action_noise = NormalActionNoise(np.zeros(size), np.full(size, std))
    with pytest.raises(ValueError, match=r"action_noise must be finite .* from environment\(s\) \[0, 1\]"):
        model.learn(60)
    # The random actions before are stored
    assert model.replay_buffer.size() == 6 and is_finite(model)


@pytest.mark.parametrize(
    "value, is_good",
    [([1e15, -1e15], True), ([1.1e15, 0], False), (np.array([2**62]), False), (np.array([2**31 - 1], dtype=np.int32), True),
     (np.full((3, 200, 200), 9e14), True), (np.array([np.nan], dtype=np.float16), False), (np.ones((2, 0)), True)],
)  # fmt: skip
def test_numbers_are_told_apart(value, is_good):
    value = np.asarray(value)
    if is_good:
        check_numbers("It", value)
    else:
        with pytest.raises(ValueError, match=r"It must be finite .* environment\(s\) \[4\]"):
            check_numbers("It", value, first_env=4)


@pytest.mark.parametrize("factor, message", [(np.nan, "got nan"), (np.inf, "got inf"), (1e25, "got 1e\\+25")])
def test_a_loss_is_refused_before_it_moves_anything(factor, message):
    parameter = th.nn.Parameter(th.ones(3))
    optimizer = th.optim.Adam([parameter])
    with pytest.raises(NonFiniteLossError, match=f"my_loss .*{message}"):
        gradient_step(parameter.mean() * factor, [optimizer], 1.0, "my_loss")
    assert (parameter == 1).all() and not optimizer.state
    gradient_step(parameter.mean(), [optimizer], 1.0, "my_loss")
    assert (parameter != 1).all()


@pytest.mark.parametrize("gradient", [np.nan, np.inf, 1e25], ids=str)
@pytest.mark.parametrize("max_grad_norm", [None, 1.0])
def test_a_gradient_is_refused_before_it_moves_anything(gradient, max_grad_norm):
    """Of one parameter alone, which has a single entry, for a finite loss."""
    parameters = [th.nn.Parameter(th.ones(3)), th.nn.Parameter(th.ones(1))]
    optimizers = [th.optim.Adam([parameter]) for parameter in parameters]
    parameters[1].register_hook(lambda _: th.tensor([gradient]))
    with pytest.raises(NonFiniteLossError, match="got 6"):
        gradient_step(parameters[0].sum() + 3 * parameters[1].sum(), optimizers, max_grad_norm)
    assert all((parameter == 1).all() for parameter in parameters) and not any(each.state for each in optimizers)


def test_gradients_are_clipped_per_optimizer():
    parameters = [th.nn.Parameter(th.ones(2)) for _ in range(3)]
    optimizers = [th.optim.SGD([parameter], lr=1.0) for parameter in parameters]
    # The last one has no gradient
    gradient_step(3 * parameters[0][0] + 4 * parameters[0][1] + 0.5 * parameters[1].sum(), optimizers, max_grad_norm=1.0)
    for parameter, change in zip(parameters, [(0.6, 0.8), (0.5, 0.5), (0, 0)], strict=True):
        np.testing.assert_allclose(1 - parameter.detach(), change, rtol=1e-5)


@pytest.mark.parametrize("with_checkpoint", [True, False])
def test_a_diverged_training_stops(algorithm, with_checkpoint, tmp_path):
    callback = ResumableCheckpoint(10, tmp_path) if with_checkpoint else None
    model = make_model(algorithm, make_shared_env()).learn(40, callback)
    with th.no_grad():
        for name, parameter in model.policy.named_parameters():
            if "value_net" in name or "critic" in name:
                parameter.fill_(1e37)
    weights = snapshot(model)
    checkpoint = "the last checkpoint is .*_40_steps" if with_checkpoint else "no ResumableCheckpoint is in use"
    message = rf"_loss and the squares .* at step \d+, after \d+ updates\. It moved no parameter, {checkpoint}"
    with pytest.raises(NonFiniteLossError, match=message):
        model.learn(40, reset_num_timesteps=False)
    assert not has_learnt(model, weights)
    if with_checkpoint:
        assert goes_on(resume(tmp_path, make_shared_env()), make_shared_env())


@pytest.mark.parametrize("in_dict", [False, True])
@pytest.mark.parametrize("place", ["first", "next", "terminal"])
def test_discrete_observations_outside_of_their_space(algorithm, place, in_dict):
    class Cells(BrokenEnv):
        def broken(self, obs):
            return {"cell": np.int64(4)} if in_dict else np.int64(4)

    cells: spaces.Space = spaces.Dict({"cell": spaces.Discrete(4)}) if in_dict else spaces.Discrete(4)
    model = make_model(algorithm, Cells(place, 4, cells), "MultiInputPolicy" if in_dict else "MlpPolicy")
    with pytest.raises(ValueError, match=r"observation.* must be in Discrete\(4\), got \[4\] from environment\(s\) \[0\]"):
        model.learn(60)
    model.set_env(LayoutEnv(layouts()["shared"], cells))
    model.learn(60)
