"""Checkpoints on disk: whole or not there, written once, and one run's own."""

import gc
import multiprocessing
import shutil
import subprocess
import sys
import warnings
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback

from sb3_chdp import HPPO, PATD3
from sb3_chdp.common import replay_store
from sb3_chdp.common.checkpoint_store import DamagedError, GenerationWriter
from sb3_chdp.common.plain_data import from_bytes, to_bytes
from sb3_chdp.common.resume import ResumableCheckpoint, resume
from sb3_chdp.common.serialization import TAG, NotSerializable
from tests.algorithms import make_model
from tests.resume_runs import SmallChunks, generations, make_env, trained

# New processes that do not begin as a copy of this one
PROCESSES = multiprocessing.get_context("forkserver")


@pytest.mark.parametrize("n_envs", [1, 4])
@pytest.mark.parametrize("train_freq", [1, 3])
def test_buffer_and_counters_agree(n_envs, train_freq, tmp_path):
    model = make_model(PATD3, make_env(n_envs), train_freq=train_freq)

    class Kill(BaseCallback):
        def _on_step(self):
            return self.n_calls < 17

    model.learn(1000, [ResumableCheckpoint(5, tmp_path), Kill()])
    resumed: Any = resume(tmp_path, make_env(n_envs))
    assert resumed.num_timesteps == 15 * n_envs == resumed.replay_buffer.size() * n_envs
    # What the stopping callback kept from the buffer is not part of a checkpoint
    before = {1: 10, 3: 12}[train_freq] * n_envs
    assert [path.name for path in generations(tmp_path)] == [f"000002_{before}_steps", f"000003_{15 * n_envs}_steps"]


class TinyChunks(ResumableCheckpoint):
    chunk_bytes = 200


def damage_nothing_left(path):
    path.unlink()


def damage_cut(path):
    path.write_bytes(path.read_bytes()[:-7])


def damage_bit(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


@pytest.mark.parametrize("damage", [damage_nothing_left, damage_cut, damage_bit])
def test_damaged_checkpoints(damage, tmp_path):
    trained(tmp_path / "run", checkpoint=TinyChunks)
    older, newer = generations(tmp_path / "run")
    names = sorted(path.relative_to(newer) for path in newer.rglob("*") if path.is_file())
    assert len(names) > 8
    for name in names:
        copy = tmp_path / "copy"
        # With the links, as they are
        subprocess.run(["cp", "-a", str(tmp_path / "run"), str(copy)], check=True)
        damage(copy / newer.name / name)
        with pytest.warns(UserWarning, match=f"{name} is damaged"):
            model = resume(copy, make_env(1))
        assert model.num_timesteps == 50 and older.name.endswith("_50_steps")
        shutil.rmtree(copy)
    damage(newer / "model.zip")
    damage(older / "state.npz")
    with pytest.warns(UserWarning, match=r"(model\.zip|state\.npz) is damaged"), pytest.raises(
        DamagedError, match=r"state\.npz"
    ):
        resume(tmp_path / "run", make_env(1))


def test_training_goes_on_after_a_damaged_checkpoint(tmp_path):
    trained(tmp_path)
    damage_cut(generations(tmp_path)[-1] / "model.zip")
    with pytest.warns(UserWarning, match="is damaged"):
        model = resume(tmp_path, make_env(1))
    model.learn(10, ResumableCheckpoint(5, tmp_path), reset_num_timesteps=False)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert resume(tmp_path, make_env(1)).num_timesteps == 60
    assert len(generations(tmp_path)) == 2


def test_only_new_rows_are_written(tmp_path):
    """A file of transitions that is not new has the time and the place on the disk of an earlier one."""
    seen: set[tuple[int, int]] = set()
    written: dict[str, int] = {}

    class Watch(BaseCallback):
        def _on_step(self):
            newest = generations(tmp_path)[-1:]
            files = {file for folder in newest for file in (folder / "replay").iterdir()}
            found = {(file.stat().st_ino, file.stat().st_mtime_ns) for file in files}
            for folder in newest:
                written.setdefault(folder.name, len(found - seen))
            seen.update(found)
            return True

    model = make_model(PATD3, make_env(2), learning_starts=10**6, buffer_size=2000)
    model.learn(2000, [SmallChunks(50, tmp_path), Watch()])
    counts = list(written.values())
    assert len(counts) > 15
    assert max(counts[5:]) < 25 < counts[1] * 10
    inodes = [{path.stat().st_ino for path in folder.rglob("*.npy")} for folder in generations(tmp_path)]
    assert not set.intersection(*inodes), "what damages one generation spares the other"
    resumed: Any = resume(tmp_path, make_env(2))
    np.testing.assert_array_equal(resumed.replay_buffer.observations, model.replay_buffer.observations)


@pytest.mark.parametrize("chunk_bytes", [1, 300])
@pytest.mark.parametrize("frugal", [False, True])
def test_rows_are_those_of_the_buffer_wherever_it_stands(chunk_bytes, frugal, tmp_path):
    box = spaces.Box(-1, 1, (2,))
    kwargs = dict(optimize_memory_usage=frugal, handle_timeout_termination=not frugal)
    buffer, rng = ReplayBuffer(30, box, box, "cpu", **kwargs), np.random.default_rng(0)
    store = replay_store.ReplayStore(chunk_bytes)
    for i in range(60):
        for _ in range(rng.integers(0, 5)):
            obs, next_obs, action = rng.uniform(-1, 1, (3, 1, 2))
            buffer.add(obs, next_obs, action, rng.normal(size=1), rng.integers(0, 2, 1), [{}])
            store.n_added += 1
        writer = GenerationWriter(tmp_path / str(i))
        writer.folder.mkdir()
        n_rows = store.write(buffer, writer)
        store.commit(buffer, writer.folder, writer.files)
        again = ReplayBuffer(30, box, box, "cpu", **kwargs)
        replay_store.read_rows(again, writer.folder, n_rows)
        for name, rows in replay_store.row_arrays(buffer).items():
            np.testing.assert_array_equal(getattr(again, name), rows)


def test_hppo_saves_when_it_logs(tmp_path):
    """It counts rollouts within learn(): a resumed run would log at others."""

    class Stop(BaseCallback):
        def _on_step(self):
            return self.n_calls < 85

    make_model(HPPO, make_env(1)).learn(200, [ResumableCheckpoint(10, tmp_path), Stop()], log_interval=3)
    assert [path.name for path in generations(tmp_path)] == ["000001_30_steps", "000002_60_steps"]


@pytest.mark.skipif(sys.platform == "win32", reason="has no limits of file sizes")
def test_disk_that_takes_no_more(tmp_path):
    import resource

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    smallest = []

    class Fill(BaseCallback):
        def _on_step(self):
            if self.n_calls == 35:
                smallest.append(len(generations(tmp_path)))
                resource.setrlimit(resource.RLIMIT_FSIZE, (2000, limits[1]))
            return True

    model = make_model(PATD3, make_env(1))
    try:
        with pytest.warns(UserWarning, match="could not be written to .*too large.*Training goes on, the last .*_30_steps"):
            model.learn(60, [ResumableCheckpoint(10, tmp_path), Fill()])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert model.num_timesteps == 60
    assert [path.name for path in generations(tmp_path)] == ["000002_20_steps", "000003_30_steps"]
    assert resume(tmp_path, make_env(1)).num_timesteps == 30


def test_folder_that_cannot_be_written_to(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"):
        trained(tmp_path / "file" / "run")


def test_folder_of_another_run(tmp_path):
    model = trained(tmp_path)
    with pytest.raises(ValueError, match=r"save_path .*000006_60_steps of another run.*resume"):
        trained(tmp_path)
    model.learn(20, ResumableCheckpoint(10, tmp_path), reset_num_timesteps=False)
    assert resume(tmp_path, make_env(1)).num_timesteps == 80


def go_on(folder):
    """Ten more steps; writes down why not."""
    model = resume(folder, make_env(1))
    try:
        model.learn(10, ResumableCheckpoint(5, folder), reset_num_timesteps=False)
    except ValueError as error:
        (folder / "error").write_text(str(error))
    return model


def test_folder_that_another_process_writes_to(tmp_path):
    trained(tmp_path)
    # A lock of this process ends when any file of it is closed
    gc.collect()
    model = go_on(tmp_path)
    for is_there in (True, False):
        process = PROCESSES.Process(target=go_on, args=(tmp_path,))
        process.start()
        process.join()
        assert process.exitcode == 0 and (tmp_path / "error").exists() == is_there
        if is_there:
            assert "Another process writes checkpoints to" in (tmp_path / "error").read_text()
            (tmp_path / "error").unlink()
            del model
            gc.collect()
    assert resume(tmp_path, make_env(1)).num_timesteps == 80


def test_replay_buffers_that_hold_more_than_numbers(tmp_path):
    class Wordy(ReplayBuffer):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            self.notes = [object()]

    with pytest.raises(ValueError, match="no Wordy: its notes"):
        trained(tmp_path, replay_buffer_class=Wordy)


def test_nothing_runs_when_state_is_read(tmp_path):
    trained(tmp_path)
    for path in (generations(tmp_path)[-1]).rglob("*.np[yz]"):
        loaded = np.load(path, allow_pickle=False)
        for name in getattr(loaded, "files", []):
            assert loaded[name].dtype.kind in "biufU"
    with pytest.raises(NotSerializable, match="print"):
        to_bytes({"x": print})
    value = {"a": (1, None, float("inf")), 3: [np.float32(0.1), True], TAG: "x", "long": [0.1] * 40, "word": np.str_("y")}
    again = from_bytes(*to_bytes(value))
    assert again == value and type(again[3][0]) is np.float32 and type(again["a"]) is tuple and type(again["long"][0]) is float
