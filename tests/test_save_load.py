"""Zips, replay buffers, resuming."""

import io
import pickle
import warnings
import zipfile
from collections import OrderedDict
from copy import deepcopy

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her import HerReplayBuffer

from sb3_chdp import FlattenHybridAction
from sb3_chdp.common.td3 import HybridTD3
from tests.algorithms import LAYOUTS, make_model
from tests.hybrid_envs import GoalEnv, LayoutEnv, box, make_layout_env

OBS = np.random.default_rng(0).uniform(-1, 1, (20, 2)).astype(np.float32)


def same_predictions(first, second):
    np.testing.assert_equal(first.predict(OBS, deterministic=True)[0], second.predict(OBS, deterministic=True)[0])


def optimizers(model):
    return [state for name, state in model.get_parameters().items() if name.endswith("optimizer")]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_save_and_load(algorithm, layout, tmp_path):
    model = make_model(algorithm, make_layout_env(layout)).learn(30)
    model.save(tmp_path / "model")
    same_predictions(model, algorithm.load(tmp_path / "model"))
    loaded = algorithm.load(tmp_path / "model", env=make_vec_env(make_layout_env, 3, env_kwargs={"layout": layout}))
    same_predictions(model, loaded)
    loaded.learn(30)
    for before, after in zip(optimizers(model), optimizers(algorithm.load(tmp_path / "model")), strict=True):
        states = [list(optimizer["state"].values()) for optimizer in (before, after)]
        assert len(states[0]) > 0
        for mine, theirs in zip(*states, strict=True):
            assert all(th.equal(th.as_tensor(mine[key]), th.as_tensor(theirs[key])) for key in mine)


def test_zip_holds_no_network_twice(algorithm, tmp_path):
    model = make_model(algorithm, make_layout_env()).learn(30)
    model.save(tmp_path / "model")
    with zipfile.ZipFile(tmp_path / "model.zip") as archive:
        assert archive.getinfo("data").file_size < 40_000
    buffer = io.BytesIO()
    model.save(buffer)
    buffer.seek(0)
    same_predictions(model, algorithm.load(buffer))


def test_set_parameters_and_policy_save(algorithm, tmp_path):
    model = make_model(algorithm, make_layout_env()).learn(30)
    other = make_model(algorithm, make_layout_env(), seed=5)
    other.set_parameters(model.get_parameters())
    same_predictions(model, other)
    model.policy.save(tmp_path / "policy")
    same_predictions(model.policy, type(model.policy).load(tmp_path / "policy"))


def test_copies_and_files_in_memory(algorithm):
    model = make_model(algorithm, make_layout_env()).learn(30)
    same_predictions(model, deepcopy(model))
    for part in (model, model.policy):
        file = io.BytesIO()
        part.save(file)
        same_predictions(model, type(part).load(file))


def test_pickled_models_train_as_the_original_does(algorithm):
    model = make_model(algorithm, make_layout_env()).learn(30)
    models = [model, deepcopy(model), pickle.loads(pickle.dumps(model))]
    for each in models:
        set_random_seed(0)
        each.learn(30, reset_num_timesteps=False)
    for copied in models[1:]:
        for mine, copies in zip(model.policy.state_dict().values(), copied.policy.state_dict().values(), strict=True):
            assert not isinstance(mine, th.Tensor) or th.equal(mine, copies)


def test_replay_buffer(off_policy_algorithm, tmp_path):
    model = make_model(off_policy_algorithm, make_layout_env()).learn(30)
    model.save_replay_buffer(tmp_path / "buffer")
    other = make_model(off_policy_algorithm, make_layout_env())
    other.load_replay_buffer(tmp_path / "buffer")
    assert other.replay_buffer.size() == model.replay_buffer.size()
    np.testing.assert_array_equal(other.replay_buffer.actions, model.replay_buffer.actions)
    other.learn(30, reset_num_timesteps=False)


def test_continued_learning_equals_learning_at_once(algorithm):
    # What by default depends on the length of the training
    constant = dict(learning_rate=1e-3)
    if issubclass(algorithm, HybridTD3):
        constant |= dict(exploration_initial_eps=0.3, exploration_final_eps=0.3)
    runs = []
    for parts in ((60,), (30, 30)):
        model = make_model(algorithm, make_layout_env(), **constant)
        for part in parts:
            model.learn(part, reset_num_timesteps=False)
        assert model.num_timesteps == 60
        runs.append([p.detach() for p in model.policy.parameters()])
    assert all((a == b).all() for a, b in zip(*runs, strict=True))


def test_set_env(algorithm):
    model = make_model(algorithm, make_layout_env("nested")).learn(20)
    model.set_env(make_layout_env("nested"))
    model.learn(20)
    with pytest.raises(ValueError, match="Action spaces do not match"):
        model.set_env(make_layout_env("flat"))


def test_another_order_of_the_actions(algorithm, tmp_path):
    """Gymnasium calls the spaces equal."""
    first, second = spaces.Discrete(2), [("run", box(0, 1, 1)), ("hop", box(0, 1, 1))]
    env, other = (LayoutEnv(spaces.Dict(OrderedDict([("k", first), *parts]))) for parts in (second, reversed(second)))
    model = make_model(algorithm, env)
    model.save(tmp_path / "model")
    for use in (model.set_env, lambda env: algorithm.load(tmp_path / "model", env=env)):
        with pytest.raises(ValueError, match=r"parts in the model's order, .*run.*hop.*, got .*hop.*run"):
            use(other)
    model.set_env(env)


def test_hindsight_asks_the_new_environment(off_policy_algorithm):
    class OtherGoalEnv(GoalEnv):
        n_asked = 0

        def compute_reward(self, achieved_goal, desired_goal, info):
            OtherGoalEnv.n_asked += len(np.atleast_2d(achieved_goal))
            return super().compute_reward(achieved_goal, desired_goal, info)

    model = make_model(off_policy_algorithm, GoalEnv(), "MultiInputPolicy", replay_buffer_class=HerReplayBuffer).learn(25)
    model.set_env(OtherGoalEnv())
    model.learn(25)
    assert OtherGoalEnv.n_asked > 25, "not of its own steps alone"


def test_vec_normalize_statistics(algorithm, tmp_path):
    env = VecNormalize(make_vec_env(make_layout_env, 2))
    model = make_model(algorithm, env).learn(40)
    model.save(tmp_path / "model")
    env.save(str(tmp_path / "statistics"))
    restored = VecNormalize.load(str(tmp_path / "statistics"), make_vec_env(make_layout_env, 2))
    algorithm.load(tmp_path / "model", env=restored).learn(20)


def test_zip_of_another_algorithm(algorithm, tmp_path):
    other = TD3("MlpPolicy", FlattenHybridAction(make_layout_env()), buffer_size=10)
    other.save(tmp_path / "td3")
    with pytest.raises(ValueError, match=f"td3 is not a {algorithm.__name__} model: its policy is of stable_baselines3.td3"):
        algorithm.load(tmp_path / "td3")


def test_n_step_returns_follow_the_arguments_of_load(off_policy_algorithm, tmp_path):
    make_model(off_policy_algorithm, make_layout_env(), n_steps=3).save(tmp_path / "model")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        same, other = (off_policy_algorithm.load(tmp_path / "model", **kwargs) for kwargs in ({}, dict(n_steps=5, gamma=0.5)))
        one = off_policy_algorithm.load(tmp_path / "model", n_steps=1)
    assert (same.replay_buffer.n_steps, same.replay_buffer.gamma) == (3, same.gamma)
    assert (other.replay_buffer.n_steps, other.replay_buffer.gamma) == (5, 0.5)
    assert type(one.replay_buffer) is (off_policy_algorithm.default_buffer_classes or [ReplayBuffer])[0]


def test_wrong_policy_kwargs_at_load(algorithm, tmp_path):
    make_model(algorithm, make_layout_env()).save(tmp_path / "model")
    with pytest.raises(ValueError, match="policy kwargs"):
        algorithm.load(tmp_path / "model", policy_kwargs=dict(net_arch=[4]))
