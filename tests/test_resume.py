"""Training that is killed and goes on: equal to the last bit, whole or not there, never silently another run."""

import gc
import json
import multiprocessing
import os
import random
import shutil
import subprocess
import sys
import threading
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback, EveryNTimesteps
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_chdp import CHDP, HPPO, PATD3
from sb3_chdp.common import replay_store
from sb3_chdp.common.buffers import PrioritizedDictReplayBuffer
from sb3_chdp.common.checkpoint_store import DamagedError, GenerationWriter
from sb3_chdp.common.plain_data import from_bytes, to_bytes
from sb3_chdp.common.resume import ResumableCheckpoint, resume
from tests import resume_runs
from tests.algorithms import make_model
from tests.resume_runs import RUNS, WalkEnv, make_env

# How often the crash test crashes
N_CRASHES = int(os.environ.get("N_CRASHES", "4"))
# New processes that do not begin as a copy of this one, and need not import everything again; optimizers import _dynamo
PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload(["torch._dynamo", "tests.resume_runs"])


def run(folder, name, kill_at=None):
    """:return: what the run came to, None if it was killed"""
    process = PROCESSES.Process(target=resume_runs.main, args=(str(folder), kill_at, name))
    process.start()
    process.join()
    assert process.exitcode == (0 if kill_at is None else -9) or kill_at is not None, "see the output of the process"
    return json.loads((folder / "outcome.json").read_text()) if process.exitcode == 0 else None


def assert_equal(outcome, expected):
    assert outcome["result"].keys() == expected["result"].keys()
    assert [key for key, value in expected["result"].items() if outcome["result"][key] != value] == []


@pytest.mark.parametrize("name", RUNS)
def test_killed_and_resumed_equals_not_killed(name, tmp_path):
    whole = run(tmp_path / "whole", name)
    kill_at = int(whole["n_moments"] * random.Random(name).uniform(0.5, 0.95))
    assert run(tmp_path / "killed", name, kill_at) is None
    resumed = run(tmp_path / "killed", name)
    assert resumed["resumed_at"] > 0
    assert_equal(resumed, whole)


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory):
    return run(tmp_path_factory.mktemp("run") / "whole", "PATD3-4")


def test_in_an_interpreter_of_its_own(whole_run, tmp_path):
    run(tmp_path, "PATD3-4", whole_run["n_moments"] * 2 // 3)
    command = [sys.executable, "-m", "tests.resume_runs", str(tmp_path), "null", "PATD3-4"]
    subprocess.run(command, env={**os.environ, "PYTHONHASHSEED": "2"}, check=True)
    outcome = json.loads((tmp_path / "outcome.json").read_text())
    assert outcome["resumed_at"] > 0
    assert_equal(outcome, whole_run)


def test_a_finished_run_stays_as_it_is(whole_run, tmp_path):
    run(tmp_path, "PATD3-4")
    checkpoints = generations(tmp_path / "checkpoints")
    again = run(tmp_path, "PATD3-4")
    assert generations(tmp_path / "checkpoints") == checkpoints
    assert again["resumed_at"] == resume_runs.TOTAL
    assert_equal(again, whole_run)


@settings(max_examples=N_CRASHES, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(moments=st.lists(st.floats(0.02, 0.98), min_size=1, max_size=3))
def test_killed_at_any_moments_equals_not_killed(moments, whole_run, tmp_path_factory):
    """Steps and writes are counted: half of a file is written at some of the moments."""
    folder = tmp_path_factory.mktemp("crash")
    for moment in moments:
        run(folder, "PATD3-4", max(1, int(moment * whole_run["n_moments"])))
    outcome = run(folder, "PATD3-4")
    assert_equal(outcome, whole_run)
    shutil.rmtree(folder)


def generations(folder):
    """:return: folders of the checkpoints, the newest last"""
    return sorted(folder.glob("*_steps"))


def trained(folder, total=60, n_envs=1, save_freq=10, env_class=resume_runs.ResumableWalkEnv, algorithm=PATD3, **kwargs):
    env = make_env(n_envs, env_class=env_class)
    return make_model(algorithm, env, **kwargs).learn(total, ResumableCheckpoint(save_freq, folder))


@pytest.mark.parametrize("n_envs", [1, 4])
@pytest.mark.parametrize("train_freq", [1, 3])
def test_buffer_and_counters_agree(n_envs, train_freq, tmp_path):
    model = make_model(PATD3, make_env(n_envs), train_freq=train_freq)

    class Kill(BaseCallback):
        def _on_step(self):
            return self.n_calls < 17

    model.learn(1000, [ResumableCheckpoint(5, tmp_path), Kill()])
    resumed = resume(tmp_path, make_env(n_envs))
    assert resumed.num_timesteps == 15 * n_envs == resumed.replay_buffer.size() * n_envs
    # What the stopping callback kept from the buffer is not part of a checkpoint
    before = {1: 10, 3: 12}[train_freq] * n_envs
    assert [path.name for path in generations(tmp_path)] == [f"000002_{before}_steps", f"000003_{15 * n_envs}_steps"]


def damage_nothing_left(path):
    path.unlink()


def damage_cut(path):
    path.write_bytes(path.read_bytes()[:-7])


def damage_bit(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


@pytest.mark.parametrize("damage", [damage_nothing_left, damage_cut, damage_bit])
def test_damaged_checkpoints(damage, tmp_path, monkeypatch):
    monkeypatch.setattr(replay_store, "CHUNK_BYTES", 200)
    trained(tmp_path / "run")
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


def test_only_new_rows_are_written(tmp_path, monkeypatch):
    monkeypatch.setattr(replay_store, "CHUNK_BYTES", 1000)
    written = []
    write = GenerationWriter.write

    def counting_write(self, name, content):
        written[-1] += name.startswith("replay/")
        write(self, name, content)

    monkeypatch.setattr(GenerationWriter, "write", counting_write)

    class Checkpoint(ResumableCheckpoint):
        def _save(self):
            written.append(0)
            super()._save()

    model = make_model(PATD3, make_env(2), learning_starts=10**6, buffer_size=2000).learn(2000, Checkpoint(50, tmp_path))
    assert len(written) > 15
    assert max(written[5:]) < 25 < written[1] * 10
    inodes = [{path.stat().st_ino for path in folder.rglob("*.npy")} for folder in generations(tmp_path)]
    assert not set.intersection(*inodes), "what damages one generation spares the other"
    np.testing.assert_array_equal(resume(tmp_path, make_env(2)).replay_buffer.observations, model.replay_buffer.observations)


@pytest.mark.parametrize("chunk_bytes", [1, 300])
@pytest.mark.parametrize("frugal", [False, True])
def test_rows_are_those_of_the_buffer_wherever_it_stands(chunk_bytes, frugal, tmp_path, monkeypatch):
    monkeypatch.setattr(replay_store, "CHUNK_BYTES", chunk_bytes)
    box = spaces.Box(-1, 1, (2,))
    kwargs = dict(optimize_memory_usage=frugal, handle_timeout_termination=not frugal)
    buffer, rng = ReplayBuffer(30, box, box, "cpu", **kwargs), np.random.default_rng(0)
    store = replay_store.ReplayStore()
    for i in range(60):
        for _ in range(rng.integers(0, 5)):
            buffer.add(*rng.uniform(-1, 1, (3, 1, 2)), rng.normal(size=1), rng.integers(0, 2, 1), [{}])
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


@pytest.mark.parametrize("vec_env_class", [DummyVecEnv, SubprocVecEnv])
@pytest.mark.parametrize("normalize", [False, True])
def test_without_state_a_fresh_episode_begins(vec_env_class, normalize, tmp_path):
    kwargs = dict(env_class=WalkEnv, normalize=normalize, vec_env_class=vec_env_class)
    env = make_env(2, **kwargs)
    with pytest.warns(UserWarning, match="fresh episode") as said:
        model = make_model(PATD3, env).learn(60, ResumableCheckpoint(8, tmp_path))
    assert len([w for w in said if "fresh episode" in str(w.message)]) == 1
    again = make_env(2, **kwargs)
    with pytest.warns(UserWarning, match="fresh episode") as said:
        resumed = resume(tmp_path, again)
    assert len([w for w in said if "fresh episode" in str(w.message)]) == 1
    if normalize:
        np.testing.assert_array_equal(again.ret_rms.var, env.ret_rms.var)
        assert np.abs(again.unnormalize_obs(resumed._last_obs)[:, 0]).max() <= 1.001
    else:
        assert np.abs(resumed._last_obs).max() <= 1, "an episode begins within -1 and 1"
    np.testing.assert_array_equal(resumed.replay_buffer.actions, model.replay_buffer.actions)
    resumed.learn(20, ResumableCheckpoint(8, tmp_path), reset_num_timesteps=False)
    for each in (env, again):
        each.close()


def test_environments_in_other_processes(tmp_path):
    runs = []
    for parts in ([40, 40], [80]):
        env = make_env(2, vec_env_class=SubprocVecEnv)
        model = make_model(PATD3, env, exploration_initial_eps=0.2, exploration_final_eps=0.2)
        for i, part in enumerate(parts):
            if i > 0:
                env.close()
                env = make_env(2, vec_env_class=SubprocVecEnv)
                model = resume(tmp_path / "2", env)
            model.learn(part, ResumableCheckpoint(10, tmp_path / str(len(parts))), reset_num_timesteps=False)
        env.close()
        runs.append((model.replay_buffer.observations, [e["r"] for e in model.ep_info_buffer]))
    np.testing.assert_array_equal(runs[0][0], runs[1][0])
    assert runs[0][1] == runs[1][1]


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


def test_wrong_use(tmp_path):
    with pytest.raises(ValueError, match="save_freq must be a whole number of at least 1, got 0"):
        ResumableCheckpoint(0, tmp_path)
    with pytest.raises(FileNotFoundError, match="no checkpoint"):
        resume(tmp_path / "nothing", make_env(1))
    with pytest.raises(ValueError, match="must be given to learn"):
        make_model(PATD3, make_env(1)).learn(20, EveryNTimesteps(5, ResumableCheckpoint(5, tmp_path / "inner")))
    trained(tmp_path / "run")
    with pytest.raises(ValueError, match="1 environment"):
        resume(tmp_path / "run", make_env(2))
    with pytest.raises(ValueError, match="wrapped"):
        resume(tmp_path / "run", VecNormalize(make_env(1)))
    model = resume(tmp_path / "run", make_env(1))
    with pytest.raises(ValueError, match="reset_num_timesteps=False"):
        model.learn(100, ResumableCheckpoint(10, tmp_path / "run"))


def test_replay_buffers_that_hold_more_than_numbers(tmp_path):
    class Wordy(ReplayBuffer):
        def __init__(self, *args, **kwargs):
            super().__init__(*args, **kwargs)
            self.notes = [object()]

    with pytest.raises(ValueError, match="no Wordy: its notes"):
        trained(tmp_path, replay_buffer_class=Wordy)


def test_another_end_is_told(tmp_path):
    class Stop(BaseCallback):
        def _on_step(self):
            return self.n_calls < 35

    make_model(PATD3, make_env(1)).learn(100, [ResumableCheckpoint(10, tmp_path), Stop()])
    model = resume(tmp_path, make_env(1))
    with pytest.warns(UserWarning, match="to end after 100 steps, now it ends after 130"):
        model.learn(100, ResumableCheckpoint(10, tmp_path), reset_num_timesteps=False)


def test_callback_that_is_gone_is_told(tmp_path):
    model = make_model(PATD3, make_env(1))
    model.learn(60, [EvalCallback(make_env(1), eval_freq=20, verbose=0), ResumableCheckpoint(10, tmp_path)])
    resumed = resume(tmp_path, make_env(1))
    with pytest.warns(UserWarning, match="callback that is not there: EvalCallback"):
        resumed.learn(20, ResumableCheckpoint(10, tmp_path), reset_num_timesteps=False)


def test_dict_observations(tmp_path):
    class DictWalkEnv(resume_runs.ResumableWalkEnv):
        def __init__(self):
            super().__init__()
            self.observation_space = spaces.Dict(x=self.observation_space, n=spaces.Discrete(3))

        def _obs(self):
            return {"x": super()._obs(), "n": 1}

    env = make_env(2, env_class=DictWalkEnv, normalize=False)
    settings = dict(replay_buffer_class=PrioritizedDictReplayBuffer, buffer_size=50, learning_starts=10, seed=0)
    model = CHDP("MultiInputPolicy", env, **settings)
    model.learn(80, ResumableCheckpoint(10, tmp_path))
    buffer = resume(tmp_path, make_env(2, env_class=DictWalkEnv)).replay_buffer
    for name in ("observations", "next_observations"):
        for key, rows in getattr(model.replay_buffer, name).items():
            np.testing.assert_array_equal(getattr(buffer, name)[key], rows)
    np.testing.assert_array_equal(buffer.priorities, model.replay_buffer.priorities)


def test_nothing_runs_when_state_is_read(tmp_path):
    trained(tmp_path)
    for path in (generations(tmp_path)[-1]).rglob("*.np[yz]"):
        loaded = np.load(path, allow_pickle=False)
        for name in getattr(loaded, "files", []):
            assert loaded[name].dtype.kind in "biufU"
    with pytest.raises(TypeError, match="not plain data"):
        to_bytes({"x": print})
    value = {"a": (1, None, float("inf")), 3: [np.float32(0.1), True], "__kind__": "x", "long": [0.1] * 40}
    again = from_bytes(*to_bytes(value))
    assert again == value and type(again[3][0]) is np.float32 and type(again["a"]) is tuple and type(again["long"][0]) is float


def test_wrappers_with_a_state_of_their_own(tmp_path):
    class Counting(gym.Wrapper):
        def __init__(self, env):
            super().__init__(env)
            self.count = 0
            self.secret = threading.Lock()

        def step(self, action):
            self.count += 1
            return self.env.step(action)

    env = DummyVecEnv([lambda: Monitor(Counting(resume_runs.ResumableWalkEnv()))])
    with pytest.warns(UserWarning, match="Counting keeps secret"):
        make_model(PATD3, env).learn(25, ResumableCheckpoint(10, tmp_path))
    again = DummyVecEnv([lambda: Monitor(Counting(resume_runs.ResumableWalkEnv()))])
    resume(tmp_path, again)
    assert again.get_attr("count") == [25] == again.get_attr("total_steps")
