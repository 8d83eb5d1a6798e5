"""Files of other classes and versions say so, published ones load, and SB3 reads what this package writes."""

import json
import zipfile
from pathlib import Path

import gymnasium as gym
import pytest
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.save_util import load_from_zip_file

import sb3_chdp
from sb3_chdp import ALGORITHMS, CHDP, HHQNTD3, PATD3
from sb3_chdp.chdp import PaperCHDP
from tests.algorithms import make_model
from tests.hybrid_envs import make_layout_env
from tests.saved_files import entry, rewrite, same_predictions, saved_model, torch_file


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


def test_the_papers_algorithm_is_another_one(tmp_path):
    saved_model(PaperCHDP, tmp_path)
    with pytest.raises(ValueError, match=r"model is not a CHDP: it holds a sb3_chdp\.chdp\.paper\.PaperCHDP"):
        CHDP.load(tmp_path / "model")


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


@pytest.mark.parametrize("path", sorted((Path(__file__).parent.parent / "benchmarks" / "models").glob("*/*/*.zip")))
def test_published_models_load(path):
    algorithm = ALGORITHMS[path.parent.parent.name].load_class()
    env = gym.make(path.stem)
    assert env.action_space.contains(algorithm.load(path).predict(env.reset(seed=0)[0])[0])


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
    assert data is not None
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
