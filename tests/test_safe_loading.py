"""Files of strangers: nothing in them runs."""

import base64
import io
import json
import pickle
import zipfile

import cloudpickle
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.save_util import save_to_pkl

from sb3_chdp import CHDP, HPPO, PATD3
from sb3_chdp.common.serialization import TAG
from tests.algorithms import LAYOUTS, make_model
from tests.hybrid_envs import make_layout_env
from tests.saved_files import UNPICKLED, Payload, entry, rewrite, same_predictions, saved_model, torch_file, with_data


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
    for pickled in (tmp_path / "pickled", io.BytesIO((tmp_path / "pickled").read_bytes())):
        with pytest.raises(Exception):  # noqa: B017
            type(policy).load(pickled, trusted=True)
        assert marker.exists()
        marker.unlink()


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
