"""Models on the Hub: built, published and loaded without a network."""

import json
import re
import shutil
import subprocess
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import yaml

import sb3_chdp
from tests import commands

load_from_hub = pytest.importorskip("rl_zoo3.load_from_hub")
huggingface_hub = pytest.importorskip("huggingface_hub")

ENV_ID = "HardMove4-v0"
NAME = f"pa_td3-{ENV_ID}"
# A Hub that is a folder, in which repositories lie by name
HUB = Path("the_hub")


def download(repo_id, filename, **kwargs):
    path = HUB / repo_id / filename
    if not path.exists():
        raise load_from_hub.HTTPError(filename)
    return str(path)


class Api:
    def create_repo(self, repo_id, exist_ok):
        return "https://hub/" + repo_id

    def upload_folder(self, repo_id, folder_path, commit_message):
        shutil.copytree(folder_path, HUB / repo_id, dirs_exist_ok=True)

    def list_repo_files(self, repo_id):
        return [path.name for path in (HUB / repo_id).iterdir()]


def main_with_hub(*arguments):
    """The command, which takes the folder for the Hub."""
    huggingface_hub.HfApi, huggingface_hub.hf_hub_download, load_from_hub.load_from_hub = Api, download, download
    commands.main(*arguments)


run = partial(commands.run, main=main_with_hub)


@pytest.fixture(scope="module")
def pushed(tmp_path_factory):
    """A folder in which a run was trained and published."""
    folder = tmp_path_factory.mktemp("hub")
    run("train", "--algo", "pa_td3", "--env", ENV_ID, "-n", "60", "--eval-freq", "30", "--eval-episodes", "2",
        "-params", "learning_starts:20", "buffer_size:100", cwd=folder)  # fmt: skip
    output = run("push_to_hub", "-orga", "me", "--eval-episodes", "3", "-n", "20", cwd=folder)
    assert "Uploaded to https://hub/me/" + NAME in output
    return folder


def test_the_repository(pushed):
    repository = pushed / "the_hub" / "me" / NAME
    assert {path.name for path in repository.iterdir()} == {
        "README.md", f"{NAME}.zip", "config.yml", "args.yml", "env_kwargs.yml", "results.json", "train_eval_metrics.zip",
        "replay.mp4",
    }  # fmt: skip
    results = json.loads((repository / "results.json").read_text())
    assert len(results["returns"]) == len(results["successes"]) == 3
    assert yaml.safe_load((repository / "config.yml").read_text())["policy"] == "MlpPolicy"
    everything = "".join((repository / name).read_text() for name in ("config.yml", "args.yml", "env_kwargs.yml", "README.md"))
    assert str(pushed) not in everything and "!!python" not in everything


def test_the_card(pushed, monkeypatch):
    repository = pushed / "the_hub" / "me" / NAME
    card = huggingface_hub.ModelCard.load(repository / "README.md")
    results = json.loads((repository / "results.json").read_text())
    mean = f"{np.mean(results['returns']):.2f} ± {np.std(results['returns']):.2f}"
    assert {result.metric_name: result.metric_value for result in card.data.eval_results}["mean return"] == mean
    assert f"| mean return | {mean} |" in card.text and "| success | " in card.text
    assert f"sb3-chdp train --algo pa_td3 --env {ENV_ID} -n 64" in card.text and "'n_timesteps': 64" in card.text
    assert f"sb3-chdp load_from_hub --algo pa_td3 --env {ENV_ID} -orga me -name {NAME}" in card.text
    # The example loads the model
    monkeypatch.setattr(huggingface_hub, "hf_hub_download", lambda repo, file: str(pushed / "the_hub" / repo / file))
    names: dict = {}
    exec(re.findall(r"```python\n(from.*?)```", card.text, re.DOTALL)[0], names)
    assert isinstance(names["model"], sb3_chdp.PATD3)


def test_load_and_enjoy(pushed, tmp_path):
    (tmp_path / "the_hub").symlink_to(pushed / "the_hub")
    load = ["load_from_hub", "--algo", "pa_td3", "--env", ENV_ID, "-orga", "me"]
    assert f"Saving to logs/pa_td3/{ENV_ID}_1" in run(*load, cwd=tmp_path)
    assert "Mean reward" in run("enjoy", "--no-render", "-n", "60", cwd=tmp_path)
    assert f"Saving to logs/pa_td3/{ENV_ID}_2" in run(*load, cwd=tmp_path)
    assert "is there already" in run(*load, "--exp-id", "1", cwd=tmp_path, code=1)
    run(*load, "--exp-id", "1", "--force", "--trusted", cwd=tmp_path)
    assert (tmp_path / "logs" / "pa_td3" / f"{ENV_ID}_1" / ENV_ID / "config.yml").is_file(), "trusted: everything"


DANGERS = {
    "wrapper": ("config.yml", "env_wrapper: os.system", "was trained with env_wrapper"),
    "normalized": ("config.yml", "normalize: true", "was trained with normalize"),
    "yaml": ("env_kwargs.yml", "!!python/object/apply:os.system [touch ran]", "env_kwargs.yml of the repository holds Python"),
    "pickle": (f"{NAME}.zip", "not a model", ""),
}


@pytest.mark.parametrize("danger", DANGERS)
def test_untrusted(danger, pushed, tmp_path):
    name, content, message = DANGERS[danger]
    repository = tmp_path / "the_hub" / "me" / NAME
    repository.parent.mkdir(parents=True)
    subprocess.run(["cp", "-r", str(pushed / "the_hub" / "me" / NAME), str(repository)], check=True)
    (repository / name).write_text(content)
    output = run("load_from_hub", "--algo", "pa_td3", "--env", ENV_ID, "-orga", "me", cwd=tmp_path, code=1)
    assert message in output and not (tmp_path / "ran").exists() and not (tmp_path / "logs" / "pa_td3").exists()


def test_models_of_sb3_are_pickles(tmp_path):
    output = run("load_from_hub", "--algo", "sb3:sac", "--env", ENV_ID, "-orga", "me", cwd=tmp_path, code=1)
    assert output.startswith("sb3-chdp load_from_hub: models of Stable-Baselines3's own sac are pickles")


def test_look_first(pushed):
    run("push_to_hub", "-orga", "you", "-name", "mine", "--eval-episodes", "1", "--no-render", "--no-upload", cwd=pushed)
    assert (pushed / "hub" / "mine" / "README.md").is_file() and not (pushed / "the_hub" / "you").exists()
