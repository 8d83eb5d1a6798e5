"""``sb3-chdp train --resume``: in processes of their own, as the script is run only once in each."""

import json
import multiprocessing
import os
import runpy
import signal
import sys

import numpy as np
import pytest

pytest.importorskip("rl_zoo3")

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_chdp.cli import prepare_arguments
from sb3_chdp.common.checkpoint_store import CheckpointStore
from sb3_chdp.zoo import register
from sb3_chdp.zoo_resume import prepare_training

# No preload: rl_zoo3 patches Gymnasium, for the processes of all tests
PROCESSES = multiprocessing.get_context("forkserver")
SETTINGS = (
    "learning_starts:40 batch_size:8 n_envs:2 policy_kwargs:dict(net_arch=[8]) buffer_size:200 "
    "callback:'tests.test_zoo_resume.Killer'"
)
# Environment variable with the number of steps after which a training is killed
KILL_AT = "TESTS_KILL_AT"
ARGUMENTS = (
    f"--algo pa_td3 --env Platform-v0 -n 240 --save-freq 40 --eval-freq 60 --eval-episodes 2 --verbose 0 -params {SETTINGS}"
)


class Killer(BaseCallback):
    """Kills its process when so many steps have been made."""

    def _on_step(self):
        if str(self.num_timesteps) == os.environ.get(KILL_AT):
            os.kill(os.getpid(), signal.SIGKILL)
        return True


def train(arguments, kill_at=None):
    """rl_zoo3's script, killed when so many steps have been made."""
    os.environ[KILL_AT] = str(kill_at)
    register()
    sys.argv = ["train", *prepare_training(arguments)]
    runpy.run_module("rl_zoo3.train", run_name="__main__", alter_sys=True)


def run(arguments, kill_at=None):
    process = PROCESSES.Process(target=train, args=(arguments, kill_at))
    process.start()
    process.join()
    return process.exitcode


def new_run(folder, *more):
    """:return: arguments for a run of its own"""
    return prepare_arguments("train", [*ARGUMENTS.split(), "-f", str(folder), *more])


def test_a_killed_training_goes_on(tmp_path):
    whole, killed = (tmp_path / name / "pa_td3" / "Platform-v0_1" for name in "ab")
    assert run(new_run(tmp_path / "a", "--seed", "4")) == 0
    assert run(new_run(tmp_path / "b", "--seed", "4"), kill_at=170) == -signal.SIGKILL
    assert not (killed / "Platform-v0.zip").exists()
    # The settings of -params are those of the killed run
    assert run(["--resume", str(killed)]) == 0
    assert (killed / "Platform-v0.zip").exists() and not (killed.parent / "Platform-v0_2").exists()
    for name in ("timesteps", "results", "ep_lengths"):
        with np.load(whole / "evaluations.npz") as expected, np.load(killed / "evaluations.npz") as found:
            np.testing.assert_array_equal(found[name], expected[name])
    for name in ("0.monitor.csv", "1.monitor.csv"):
        rows = [[line.split(",")[:2] for line in (run / name).read_text().splitlines()[1:]] for run in (whole, killed)]
        assert rows[0] == rows[1]


class OwnExtractor(FlattenExtractor):
    """A class that only this module knows."""


def test_what_is_kept_of_the_arguments(tmp_path):
    """Also of a model with a class of the user's own, which goes on; not while another process has it."""
    module = "__import__('tests.test_zoo_resume').test_zoo_resume"
    own = f"policy_kwargs:dict(net_arch=[8],features_extractor_class={module}.OwnExtractor)"
    arguments = [own if part.startswith("policy_kwargs:") else part for part in new_run(tmp_path)]
    assert run(arguments, kill_at=60) == -signal.SIGKILL
    folder = tmp_path / "pa_td3" / "Platform-v0_1"
    kept = json.loads((folder / "arguments.json").read_text())
    assert kept[:-1] == [*arguments, "--seed"]
    assert prepare_training(["--resume", str(folder)]) == kept == prepare_training([f"--resume={folder}"])
    monitor, store = (folder / "0.monitor.csv").read_text(), CheckpointStore(folder / "resumable")
    store.lock()
    assert run(["--resume", str(folder)]) == 1 and (folder / "0.monitor.csv").read_text() == monitor
    del store
    assert run(["--resume", str(folder)]) == 0


def test_wrong_use(tmp_path):
    with pytest.raises(ValueError, match="no other arguments"):
        prepare_training(["--resume", str(tmp_path), "--seed", "3"])
    with pytest.raises(ValueError, match="no resumable checkpoint"):
        prepare_training(["--resume", str(tmp_path)])
