"""Files of strangers: nothing in them runs, and what needs trust says so."""

import base64
import io
import json
import os
import pickle
import sys
import zipfile
from collections import OrderedDict

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.save_util import load_from_zip_file, save_to_pkl
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.utils import LinearSchedule

import sb3_chdp
from sb3_chdp import CHDP, HHQNTD3, HPPO, PATD3
from sb3_chdp.common.buffers import PrioritizedDictReplayBuffer, PrioritizedReplayBuffer
from sb3_chdp.common.serialization import TAG, decode, encode
from tests.algorithms import LAYOUTS, make_model
from tests.hybrid_envs import make_layout_env

OBS = np.random.default_rng(0).uniform(-1, 1, (20, 2)).astype(np.float32)
UNPICKLED: list[str] = []
sys.addaudithook(lambda event, args: UNPICKLED.append(f"{args[0]}.{args[1]}") if event == "pickle.find_class" else None)


class Payload:
    """Makes a file when it is unpickled."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.system, (f"touch {self.marker}",)


def saved_model(algorithm, tmp_path, **kwargs):
    model = make_model(algorithm, make_layout_env(), **kwargs).learn(20)
    model.save(tmp_path / "model")
    return model


def rewrite(path, changes):
    """Copy a zip with some entries replaced or added."""
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    changed = path.with_name("changed.zip")
    with zipfile.ZipFile(changed, "w") as archive:
        for name, content in {**entries, **changes}.items():
            archive.writestr(name, content)
    return changed


def entry(path, name):
    with zipfile.ZipFile(path) as archive:
        return archive.read(name)


def with_data(path, **items):
    return rewrite(path, {"data": json.dumps({**json.loads(entry(path, "data")), **items})})


def torch_file(obj):
    file = io.BytesIO()
    th.save(obj, file)
    return file.getvalue()


def same_predictions(first, second):
    np.testing.assert_equal(first.predict(OBS, deterministic=True)[0], second.predict(OBS, deterministic=True)[0])


# ------------------------------------------------------------------------------------------------------ nothing is run


def test_payload_in_every_entry_of_a_model(algorithm, tmp_path):
    saved_model(algorithm, tmp_path)
    path, marker = tmp_path / "model.zip", tmp_path / "marker"
    pickled = {":type:": "", ":serialized:": base64.b64encode(cloudpickle.dumps(Payload(marker))).decode()}
    for key in [*json.loads(entry(path, "data")), "something_new", "env"]:
        with pytest.raises(ValueError, match=f"holds {key} in pickled form"):
            algorithm.load(with_data(path, **{key: pickled}))
    with pytest.raises(ValueError, match="policy_kwargs"):
        algorithm.load(with_data(path, policy_kwargs={"net_arch": [8, 8], "inner": pickled}))
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    assert {"sb3_chdp.json", "data", "policy.pth", "system_info.txt"} <= set(names)
    for name in [*names, "tensors.pth", "evil.pth", "evil.pkl"]:
        for content in (pickle.dumps(Payload(marker)), torch_file(Payload(marker)), torch_file({"a": Payload(marker)})):
            try:
                algorithm.load(rewrite(path, {name: content}))
            except Exception as error:
                print(name, error)
            else:
                # What is not read cannot harm
                assert not name.endswith(".pth") and name not in ("data", "sb3_chdp.json")
    assert not marker.exists()
    # The payload would have worked
    with pytest.raises(Exception):  # noqa: B017
        algorithm.load(with_data(path, policy_kwargs=pickled), trusted=True)
    assert marker.exists()


def test_payload_in_every_entry_of_a_policy(algorithm, tmp_path):
    policy = make_model(algorithm, make_layout_env()).policy
    policy.save(tmp_path / "policy")
    same_predictions(policy, type(policy).load(tmp_path / "policy"))
    marker = tmp_path / "marker"
    for name in ("sb3_chdp.json", "data", "policy.pth"):
        for content in (pickle.dumps(Payload(marker)), torch_file(Payload(marker))):
            with pytest.raises(Exception):  # noqa: B017
                type(policy).load(rewrite(tmp_path / "policy", {name: content}))
    for content in (pickle.dumps(Payload(marker)), torch_file({"state_dict": {}, "data": Payload(marker)})):
        (tmp_path / "pickled").write_bytes(content)
        with pytest.raises(ValueError, match="trusted=True"):
            type(policy).load(tmp_path / "pickled")
    assert not marker.exists()
    with pytest.raises(Exception):  # noqa: B017
        type(policy).load(tmp_path / "pickled", trusted=True)
    assert marker.exists()


def test_payload_in_every_entry_of_a_replay_buffer(tmp_path):
    model = make_model(CHDP, make_layout_env()).learn(20)
    model.save_replay_buffer(tmp_path / "buffer")
    marker = tmp_path / "marker"
    array = io.BytesIO()
    np.save(array, np.array([Payload(marker)]), allow_pickle=True)
    with zipfile.ZipFile(tmp_path / "buffer.pkl") as archive:
        names = archive.namelist()
    assert {"sb3_chdp.json", "data", "0.npy"} <= set(names)
    for name in names:
        for content in (pickle.dumps(Payload(marker)), array.getvalue()):
            with pytest.raises(ValueError):
                model.load_replay_buffer(rewrite(tmp_path / "buffer.pkl", {name: content}))
    save_to_pkl(tmp_path / "pickled", Payload(marker))
    with pytest.raises(ValueError, match="trusted=True"):
        model.load_replay_buffer(tmp_path / "pickled")
    assert not marker.exists()
    with pytest.raises(Exception):  # noqa: B017
        model.load_replay_buffer(tmp_path / "pickled", trusted=True)
    assert marker.exists()


@pytest.mark.parametrize("layout", LAYOUTS)
def test_no_pickle_is_read(algorithm, layout, tmp_path):
    model = make_model(algorithm, make_layout_env(layout)).learn(20)
    model.save(tmp_path / "model")
    model.policy.save(tmp_path / "policy")
    UNPICKLED.clear()
    loaded = algorithm.load(tmp_path / "model")
    policy = type(model.policy).load(tmp_path / "policy")
    if algorithm is not HPPO:
        model.save_replay_buffer(tmp_path / "buffer")
        loaded.load_replay_buffer(tmp_path / "buffer")
    assert UNPICKLED == []
    same_predictions(model, loaded)
    same_predictions(model, policy)
    assert loaded.action_space == model.action_space


IMAGE = spaces.Box(0, 255, (36, 36, 1), np.uint8)
OBSERVATIONS = {
    "MultiInputPolicy": spaces.Dict(x=spaces.Box(-1, 1, (2,)), y=spaces.Discrete(3), image=IMAGE),
    "CnnPolicy": IMAGE,
}


@pytest.mark.parametrize("policy", OBSERVATIONS)
def test_no_pickle_is_read_with_other_observations(algorithm, policy, tmp_path):
    env = make_vec_env(make_layout_env, 2, env_kwargs=dict(observation_space=OBSERVATIONS[policy]))
    model = make_model(algorithm, env, policy).learn(24)
    model.save(tmp_path / "model")
    UNPICKLED.clear()
    loaded = algorithm.load(tmp_path / "model", env=env)
    assert UNPICKLED == []
    obs = env.reset()
    np.testing.assert_equal(model.predict(obs, deterministic=True)[0], loaded.predict(obs, deterministic=True)[0])
    loaded.learn(20)


@pytest.mark.parametrize(
    "name", ["subprocess.Popen", "os.system", "builtins.eval", "torch.fx.GraphModule", "torch.nn.modules.module.warnings"]
)
def test_classes_outside_of_the_list(name, tmp_path):
    saved_model(PATD3, tmp_path)
    with pytest.raises(ValueError, match="not a class that a file may name"):
        PATD3.load(with_data(tmp_path / "model.zip", policy_kwargs={"activation_fn": {TAG: "class", "name": name}}))
    with pytest.raises(ValueError, match="not a kind of object"):
        PATD3.load(with_data(tmp_path / "model.zip", policy_kwargs={TAG: name, "arguments": {}}))


def test_environment_by_name(tmp_path, monkeypatch):
    """``gym.make("module:id")`` imports the module."""
    (tmp_path / "evil_module.py").write_text(f"open({str(tmp_path / 'marker')!r}, 'w')")
    monkeypatch.syspath_prepend(tmp_path)
    saved_model(PATD3, tmp_path)
    with pytest.raises(ValueError, match="trusted=True"):
        PATD3.load(with_data(tmp_path / "model.zip", env="evil_module:Evil-v0"))
    assert not (tmp_path / "marker").exists()


# ----------------------------------------------------------------------------------------------- what the files can hold

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
    spaces.MultiDiscrete([[2, 3], [4, 5]], start=[[0, 1], [2, 3]]),
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
    np.testing.assert_array_equal(*values)
    loaded.learn(20)


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


class GoalEnv(gym.Env):
    """The first parameter is to be the desired goal."""

    observation_space = spaces.Dict({key: spaces.Box(-1, 1, (1,)) for key in ("observation", "achieved_goal", "desired_goal")})
    action_space = spaces.Tuple((spaces.Discrete(2), spaces.Box(-1, 1, (1,))))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.obs = 0, {key: np.zeros(1, np.float32) for key in self.observation_space}
        return self.obs, {}

    def step(self, action):
        self.t += 1
        self.obs = {**self.obs, "achieved_goal": action[1]}
        reward = self.compute_reward(action[1], self.obs["desired_goal"], {})
        return self.obs, float(reward), False, self.t >= 5, {}

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -np.abs(achieved_goal - desired_goal).sum(axis=-1)


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


# ------------------------------------------------------------------------------------------------- classes and versions


def test_class_is_checked_before_anything_else_is_read(tmp_path):
    saved_model(HHQNTD3, tmp_path)
    broken = rewrite(tmp_path / "model.zip", {"data": b"nonsense", "policy.pth": b"nonsense"})
    with pytest.raises(ValueError, match=r"changed.zip is not a PATD3: it holds a sb3_chdp.*HHQNTD3"):
        PATD3.load(broken)


def test_subclasses(tmp_path):
    class MyCHDP(CHDP):
        pass

    model = saved_model(CHDP, tmp_path)
    mine = MyCHDP.load(tmp_path / "model")
    same_predictions(model, mine)
    mine.save(tmp_path / "mine")
    same_predictions(model, CHDP.load(tmp_path / "mine"))


def test_version_that_is_too_old(tmp_path):
    saved_model(PATD3, tmp_path)
    header = json.loads(entry(tmp_path / "model.zip", "sb3_chdp.json"))
    assert header["version"] == sb3_chdp.__version__
    changed = rewrite(tmp_path / "model.zip", {"sb3_chdp.json": json.dumps({**header, "version": "0.1.7"})})
    for trusted in (False, True):
        with pytest.raises(ValueError, match=r"was saved by sb3_chdp 0\.1\.7, and sb3_chdp .* reads files of") as error:
            PATD3.load(changed, trusted=trusted)
        assert "\n" not in str(error.value)


def test_version_that_does_not_fit(tmp_path):
    saved_model(PATD3, tmp_path)
    path = tmp_path / "model.zip"
    header = json.loads(entry(path, "sb3_chdp.json"))
    changed = rewrite(
        path,
        {"sb3_chdp.json": json.dumps({**header, "version": "99.1.0"}), "policy.pth": torch_file({"another": th.zeros(1)})},
    )
    with pytest.raises(ValueError, match=r"was saved by sb3_chdp 99\.1\.0 and does not fit sb3_chdp ") as error:
        PATD3.load(changed)
    assert "\n" not in str(error.value)


def test_zip_of_sb3s_kind(algorithm, tmp_path):
    """What this package wrote before there was a header."""
    model = make_model(algorithm, make_layout_env()).learn(20)
    BaseAlgorithm.save(model, tmp_path / "old")
    with pytest.raises(ValueError, match=r"old was saved by sb3_chdp 0\.1\.0 or earlier.*in pickled form.*trusted=True"):
        algorithm.load(tmp_path / "old")
    same_predictions(model, algorithm.load(tmp_path / "old", trusted=True))
    BaseModel.save(model.policy, tmp_path / "old_policy")
    with pytest.raises(ValueError, match=r"trusted=True"):
        type(model.policy).load(tmp_path / "old_policy")
    same_predictions(model, type(model.policy).load(tmp_path / "old_policy", trusted=True))


def test_sb3_reads_the_zip(algorithm, tmp_path):
    model = saved_model(algorithm, tmp_path)
    data, params, _ = load_from_zip_file(tmp_path / "model")
    assert data["num_timesteps"] == model.num_timesteps and data["policy_kwargs"] == dict(net_arch=[8, 8])
    other = make_model(algorithm, make_layout_env(), seed=3)
    other.set_parameters(params)
    same_predictions(model, other)
    other.set_parameters(tmp_path / "model")


@pytest.mark.parametrize("content", [b"", b"no zip", None])
def test_no_model_at_all(content, tmp_path):
    if content is None:
        with zipfile.ZipFile(tmp_path / "file.zip", "w") as archive:
            archive.writestr("something", "else")
    else:
        (tmp_path / "file.zip").write_bytes(content)
    with pytest.raises(ValueError, match=r"file\.zip is not a"):
        CHDP.load(tmp_path / "file.zip")
