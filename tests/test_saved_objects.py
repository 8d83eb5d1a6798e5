"""What saved files can hold, and which objects need trust."""

import io
import json
import subprocess
import sys
from collections import OrderedDict

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import LinearSchedule

from sb3_chdp import CHDP, HPPO, PATD3, PaperCHDP
from sb3_chdp.chdp.policies import CHDPPolicy
from sb3_chdp.common.buffers import PrioritizedDictReplayBuffer, PrioritizedReplayBuffer
from sb3_chdp.common.normalization import NormalizedExtractor
from sb3_chdp.common.serialization import decode, encode
from tests.algorithms import make_model
from tests.hybrid_envs import GoalEnv, make_layout_env
from tests.saved_files import same_predictions, saved_model

ORDERED = OrderedDict(z=spaces.Discrete(2), a=spaces.Box(0, 1, (1,)))
SPACES = [
    spaces.Box(-np.inf, np.inf, (3,)),
    spaces.Box(np.array([0.1, -1], np.float64), np.array([0.3, np.inf], np.float64), dtype=np.float64),
    spaces.Box(0, 255, (36, 36, 3), np.uint8),
    spaces.Box(np.arange(200, dtype=np.int16), np.arange(200, dtype=np.int16) + 1, dtype=np.int16),
    spaces.Box(-(2**62), 2**62 + 1, (2,), np.int64),
    spaces.Box(-1, 1, (0,)),
    spaces.Box(-1, 1, ()),
    spaces.Discrete(4, start=-2),
    spaces.MultiDiscrete(np.array([[2, 3], [4, 5]]), start=np.array([[0, 1], [2, 3]])),
    spaces.MultiBinary(3),
    spaces.MultiBinary([2, 3]),
    spaces.Dict(ORDERED),
    spaces.Dict({"b": spaces.Discrete(2), "a": spaces.Tuple((spaces.MultiBinary(2), spaces.OneOf((spaces.Discrete(2),))))}),
]


@pytest.mark.parametrize("space", SPACES, ids=str)
def test_spaces(space):
    read = decode(json.loads(json.dumps(encode(space))))
    assert read == space and read.dtype == space.dtype
    if isinstance(space, spaces.Dict):
        assert list(read.spaces) == list(space.spaces)
    read.seed(3), space.seed(3)
    np.testing.assert_equal(read.sample(), space.sample())


def test_spaces_of_a_subclass_are_not_mistaken():
    class MyBox(spaces.Box):
        pass

    with pytest.raises(TypeError, match="MyBox"):
        encode(MyBox(0, 1))


def test_schedules(tmp_path):
    rl_zoo3_utils = pytest.importorskip("rl_zoo3.utils")
    for i, schedule in enumerate((LinearSchedule(1e-3, 1e-4, 0.5), rl_zoo3_utils.linear_schedule(1e-3), 1e-3)):
        model = make_model(HPPO, make_layout_env(), learning_rate=schedule, clip_range=schedule)
        model.save(tmp_path / str(i))
        loaded = HPPO.load(tmp_path / str(i))
        for progress in (1.0, 0.7, 0.0):
            assert loaded.lr_schedule(progress) == pytest.approx(model.lr_schedule(progress), rel=1e-12)
            assert loaded.clip_range(progress) == pytest.approx(model.clip_range(progress), rel=1e-12)
        loaded.set_env(make_layout_env())
        loaded.learn(20)


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("noise", [NormalActionNoise, OrnsteinUhlenbeckActionNoise])
def test_action_noise(noise, n_envs, tmp_path):
    env = make_vec_env(make_layout_env, n_envs)
    model = make_model(CHDP, env, action_noise=noise(np.zeros(2), np.full(2, 0.1))).learn(25)
    model.save(tmp_path / "model")
    loaded = CHDP.load(tmp_path / "model", env=env)
    values = []
    for each in (model, loaded):
        np.random.seed(0)
        values.append([each.action_noise() for _ in range(3)])
    np.testing.assert_array_equal(values[0], values[1])
    loaded.learn(20)


def test_action_noise_of_another_number_of_environments(tmp_path):
    noise = NormalActionNoise(np.zeros(2), np.full(2, 0.1))
    make_model(CHDP, make_vec_env(make_layout_env, 2), action_noise=noise).learn(25).save(tmp_path / "model")
    for n_envs in (1, 3):
        CHDP.load(tmp_path / "model", env=make_vec_env(make_layout_env, n_envs)).learn(20)


@pytest.mark.parametrize("algorithm", [HPPO, PATD3])
def test_classes_that_nothing_has_imported(algorithm, tmp_path):
    kwargs = dict(features_extractor_class=NormalizedExtractor)
    make_model(algorithm, make_layout_env(), policy_kwargs=kwargs).save(tmp_path / "model")
    code = f"from sb3_chdp import {algorithm.__name__}; {algorithm.__name__}.load({str(tmp_path / 'model')!r})"
    subprocess.run([sys.executable, "-c", code], check=True)


class MyExtractor(FlattenExtractor):
    pass


def test_custom_objects_need_trust(algorithm, tmp_path):
    kwargs = dict(net_arch=[8, 8], features_extractor_class=MyExtractor)
    model = saved_model(algorithm, tmp_path, policy_kwargs=kwargs)
    with pytest.raises(ValueError, match=r"holds policy_kwargs in pickled form.*trusted=True"):
        algorithm.load(tmp_path / "model")
    same_predictions(model, algorithm.load(tmp_path / "model", trusted=True))
    # Named by the user, not by the file
    same_predictions(model, algorithm.load(tmp_path / "model", custom_objects={"policy_kwargs": kwargs}))
    model.policy.save(tmp_path / "policy")
    with pytest.raises(ValueError, match=r"pickled form.*trusted=True"):
        type(model.policy).load(tmp_path / "policy")
    same_predictions(model, type(model.policy).load(tmp_path / "policy", trusted=True))


def test_schedule_of_the_user(tmp_path):
    model = saved_model(PATD3, tmp_path, learning_rate=lambda progress: 1e-3 * progress)
    with pytest.raises(ValueError, match="holds learning_rate, lr_schedule in pickled form"):
        PATD3.load(tmp_path / "model")
    same_predictions(
        model, PATD3.load(tmp_path / "model", custom_objects={"learning_rate": 1e-3, "lr_schedule": lambda _: 0.0})
    )


class MyBuffer(ReplayBuffer):
    pass


@pytest.mark.parametrize(
    "kwargs, observations",
    [
        ({}, None),
        (dict(replay_buffer_class=PrioritizedReplayBuffer), None),
        (dict(n_steps=3), None),
        (dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False)), None),
        (dict(replay_buffer_class=PrioritizedDictReplayBuffer), spaces.Dict(x=spaces.Box(-1, 1, (2,)), y=spaces.Discrete(3))),
        (dict(replay_buffer_class=MyBuffer), None),
    ],
    ids=["plain", "prioritized", "n_steps", "memory", "dict", "custom"],
)
def test_replay_buffers(kwargs, observations, tmp_path):
    env = make_vec_env(make_layout_env, 2, env_kwargs=dict(observation_space=observations))
    policy = "MlpPolicy" if observations is None else "MultiInputPolicy"
    model = make_model(CHDP, env, policy, **kwargs).learn(40)
    model.save_replay_buffer(tmp_path / "buffer")
    other = make_model(CHDP, env, policy, **kwargs)
    if kwargs.get("replay_buffer_class") is MyBuffer:
        with pytest.raises(ValueError, match="trusted=True"):
            other.load_replay_buffer(tmp_path / "buffer")
        other.load_replay_buffer(tmp_path / "buffer", trusted=True)
    else:
        other.load_replay_buffer(tmp_path / "buffer")
    assert type(other.replay_buffer) is type(model.replay_buffer)
    batches = []
    for each in (model, other):
        np.random.seed(0)
        batches.append(each.replay_buffer.sample(16))
    for mine, theirs in zip(*batches, strict=True):
        for a, b in zip(*((part.values() if isinstance(part, dict) else [part]) for part in (mine, theirs)), strict=True):
            np.testing.assert_array_equal(a, b)
    other.learn(20, reset_num_timesteps=False)


def test_hindsight_replay_buffer(tmp_path):
    make = lambda: make_model(PATD3, GoalEnv(), "MultiInputPolicy", replay_buffer_class=HerReplayBuffer)  # noqa: E731
    model, other = make().learn(23), make()
    model.save(tmp_path / "model")
    PATD3.load(tmp_path / "model", env=GoalEnv())
    model.save_replay_buffer(tmp_path / "buffer")
    other.load_replay_buffer(tmp_path / "buffer", truncate_last_traj=False)
    samples = []
    for each in (model, other):
        np.random.seed(0)
        samples.append(each.replay_buffer.sample(16))
    assert th.equal(samples[0].rewards, samples[1].rewards) and th.equal(samples[0].actions, samples[1].actions)
    other.load_replay_buffer(tmp_path / "buffer")
    other.learn(20, reset_num_timesteps=False)


def test_hindsight_replay_buffer_that_is_pickled(tmp_path):
    def make():
        settings = dict(replay_buffer_class=HerReplayBuffer, replay_buffer_kwargs=dict(copy_info_dict=True))
        return make_model(PATD3, GoalEnv(), "MultiInputPolicy", **settings)

    model, other = make().learn(23), make()
    model.save_replay_buffer(tmp_path / "buffer")
    other.load_replay_buffer(tmp_path / "buffer", trusted=True)
    assert other.replay_buffer.size() == 23
    other.learn(20, reset_num_timesteps=False)


def test_folders_of_pathlib(tmp_path):
    make_model(PATD3, make_layout_env(), tensorboard_log=tmp_path).save(tmp_path / "model")
    assert PATD3.load(tmp_path / "model").tensorboard_log == str(tmp_path)


def test_policy_of_another_algorithm(tmp_path):
    make_model(PaperCHDP, make_layout_env()).policy.save(tmp_path / "policy")
    with pytest.raises(ValueError, match=r"policy is not a CHDPPolicy: it holds a sb3_chdp\.chdp\.paper\.PaperPolicy"):
        CHDPPolicy.load(tmp_path / "policy")


def test_files_in_memory(tmp_path):
    model = saved_model(PATD3, tmp_path)
    for write, read in ((model.save, PATD3.load), (model.policy.save, type(model.policy).load)):
        file = io.BytesIO()
        write(file)
        file.seek(0)
        same_predictions(model, read(file))
    file = io.BytesIO()
    model.save_replay_buffer(file)
    file.seek(0)
    model.load_replay_buffer(file)
