"""Training that is killed and goes on: equal to the last bit, and never silently another run."""

import json
import multiprocessing
import os
import random
import shutil
import subprocess
import sys
import threading
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from stable_baselines3 import A2C
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback, EveryNTimesteps
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
from stable_baselines3.her import HerReplayBuffer

from sb3_chdp import CHDP, HPPO, PATD3
from sb3_chdp.common.buffers import PrioritizedDictReplayBuffer
from sb3_chdp.common.resume import ResumableCheckpoint, resume
from tests import resume_runs
from tests.algorithms import make_model
from tests.resume_runs import RUNS, ResumableWalkEnv, WalkEnv, generations, make_env, trained

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


def test_where_nothing_has_imported_the_algorithm(tmp_path):
    make_model(PATD3, gym.make("sb3_chdp/Goal-v0")).learn(25, ResumableCheckpoint(10, tmp_path))
    code = (
        "import sys, gymnasium as gym, sb3_chdp; from sb3_chdp.common.resume import resume;"
        "print(type(resume(sys.argv[1], gym.make('sb3_chdp/Goal-v0'))).__name__)"
    )
    result = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True)
    assert result.stdout.split() == ["PATD3"], result.stderr


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
        resumed: Any = resume(tmp_path, again)
    assert len([w for w in said if "fresh episode" in str(w.message)]) == 1
    if normalize:
        np.testing.assert_array_equal(again.ret_rms.var, env.ret_rms.var)
    np.testing.assert_array_equal(resumed.replay_buffer.actions, model.replay_buffer.actions)
    place = resumed.replay_buffer.pos
    resumed.learn(20, ResumableCheckpoint(8, tmp_path), reset_num_timesteps=False)
    first = resumed.replay_buffer.observations[place]
    assert np.abs(first[:, 0]).max() <= 1, "an episode begins within -1 and 1"
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


def test_generators_of_the_old_kind_in_other_processes(tmp_path):
    class OldWalkEnv(ResumableWalkEnv):
        old = np.random.RandomState(0)
        np_random = property(lambda self: self.old, lambda self, value: None)

        def get_state(self):
            return {"x": self.x}

    env = make_env(1, env_class=OldWalkEnv, vec_env_class=SubprocVecEnv)
    make_model(PATD3, env).learn(20, ResumableCheckpoint(10, tmp_path))
    env.close()


def test_replay_buffers_of_another_size(tmp_path):
    """What was never written is never replayed."""
    small = make_model(PATD3, make_env(1), buffer_size=20).learn(30)
    small.save_replay_buffer(tmp_path / "buffer")
    model = make_model(PATD3, make_env(1))
    model.load_replay_buffer(tmp_path / "buffer")
    model.learn(30, ResumableCheckpoint(10, tmp_path / "run"), reset_num_timesteps=False)
    with pytest.raises(ValueError, match="buffer_size must be 20 like the checkpoint, got 500"):
        resume(tmp_path / "run", make_env(1), buffer_size=500)
    resumed = resume(tmp_path / "run", make_env(1))
    assert isinstance(resumed, PATD3) and resumed.replay_buffer.size() == 20


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
    resumed: Any = resume(tmp_path, make_env(2, env_class=DictWalkEnv))
    for name in ("observations", "next_observations"):
        for key, rows in getattr(model.replay_buffer, name).items():
            np.testing.assert_array_equal(getattr(resumed.replay_buffer, name)[key], rows)
    np.testing.assert_array_equal(resumed.replay_buffer.priorities, model.replay_buffer.priorities)


def test_hindsight(tmp_path):
    class GoalWalkEnv(resume_runs.ResumableWalkEnv):
        def __init__(self):
            super().__init__()
            parts = dict.fromkeys(("observation", "achieved_goal", "desired_goal"), self.observation_space)
            self.observation_space = spaces.Dict(parts)

        def _obs(self):
            walk = super()._obs()
            return {"observation": walk, "achieved_goal": walk, "desired_goal": np.zeros_like(walk)}

        def compute_reward(self, achieved_goal, desired_goal, info):
            return -np.abs(achieved_goal - desired_goal).sum(axis=-1)

    outcomes = []
    for parts in ([80], [40, 40]):
        # A rate that falls would depend on where the training ends
        settings: dict[str, Any] = dict(exploration_initial_eps=0.2, exploration_final_eps=0.2)
        settings.update(replay_buffer_class=HerReplayBuffer, buffer_size=60, learning_starts=20)
        model: Any = make_model(PATD3, make_env(2, env_class=GoalWalkEnv), "MultiInputPolicy", **settings)
        for i, part in enumerate(parts):
            folder = tmp_path / str(len(parts))
            if i > 0:
                model = resume(folder, make_env(2, env_class=GoalWalkEnv))
            model.learn(part, ResumableCheckpoint(10, folder), reset_num_timesteps=False)
        outcomes.append(model.policy.state_dict())
    assert all(outcomes[1][name].equal(value) for name, value in outcomes[0].items())


def test_algorithms_of_sb3(tmp_path):
    A2C("MlpPolicy", "CartPole-v1").learn(20, ResumableCheckpoint(10, tmp_path))
    with pytest.warns(UserWarning, match="fresh episode"):
        assert "trusted" not in vars(resume(tmp_path, gym.make("CartPole-v1"), trusted=True))


def test_a_training_that_went_beyond_its_end(tmp_path):
    model = make_model(HPPO, make_env(3)).learn(50, ResumableCheckpoint(10, tmp_path))
    resumed = resume(tmp_path, make_env(3))
    assert model.num_timesteps == 60 == resumed.learn(50 - 60, reset_num_timesteps=False).num_timesteps


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
