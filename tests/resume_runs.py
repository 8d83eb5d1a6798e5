"""Trainings that tests/test_resume.py runs in processes of their own, kills and resumes."""

import csv
import hashlib
import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import sb3_chdp
from sb3_chdp import PATD3
from sb3_chdp.common.buffers import PrioritizedReplayBuffer
from sb3_chdp.common.resume import ResumableCheckpoint, resume
from tests.algorithms import make_model
from tests.hybrid_envs import UNIT

# Steps between checkpoints, calls of env.step() between evaluations
SAVE_STEPS, EVAL_FREQ = 16, 9
# Steps: the buffer is full before the end
TOTAL, BUFFER_SIZE = 120, 80


class WalkEnv(gym.Env):
    """
    A walk on a line with noise: reward for staying near 0, episodes end at +-3.
    """

    def __init__(self):
        self.action_space = spaces.Tuple((spaces.Discrete(2), spaces.Tuple((UNIT, UNIT))))
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), dtype=np.float32)
        self.x = self.v = 0.0

    def _obs(self):
        return np.array([self.x, self.v], dtype=np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.v = self.np_random.uniform(-1, 1, 2).tolist()
        return self._obs(), {}

    def step(self, action):
        k, parameters = action
        self.v += float(parameters[k][0]) * (0.5 if k else -0.5) + 0.1 * self.np_random.normal()
        self.x += self.v
        terminated = abs(self.x) > 3
        return self._obs(), 1 - abs(self.x), terminated, False, {"is_success": terminated}


class ResumableWalkEnv(WalkEnv):
    """The walk with the two methods that exact resuming needs."""

    def get_state(self):
        return {"x": self.x, "v": np.array([self.v]), "generator": self.np_random.bit_generator.state}

    def set_state(self, state):
        self.x, self.v = state["x"], float(state["v"][0])
        self.np_random.bit_generator.state = state["generator"]


class SmallChunks(ResumableCheckpoint):
    """Checkpoints with more than one file of transitions."""

    chunk_bytes = 1000


def make_env(n_envs, folder=None, env_class=ResumableWalkEnv, normalize=False, vec_env_class=DummyVecEnv, seed=3):
    def make(i):
        file = None if folder is None else str(folder / str(i))
        return Monitor(gym.wrappers.TimeLimit(env_class(), 7), file)

    env = vec_env_class([lambda i=i: make(i) for i in range(n_envs)])
    env.seed(seed)
    return VecNormalize(env) if normalize else env


def generations(folder):
    """:return: folders of the checkpoints, the newest last"""
    return sorted(folder.glob("*_steps"))


def trained(folder, total=60, n_envs=1, save_freq=10, checkpoint=ResumableCheckpoint, **kwargs):
    """:return: a model that was trained with checkpoints"""
    return make_model(PATD3, make_env(n_envs), **kwargs).learn(total, checkpoint(save_freq, folder))


# Algorithm, number of environments and settings: each setting that has a state of its own is on in one of them
RUNS: dict[str, dict[str, Any]] = {
    "CHDP-1": {},
    "CHDP-4": dict(n_steps=3),
    "PaperCHDP-1": dict(n_diffusion_steps=2),
    "PaperCHDP-4": dict(n_diffusion_steps=2, replay_buffer_class=PrioritizedReplayBuffer),
    "HPPO-1": {},
    "HPPO-4": {},
    "PATD3-1": {},
    "PATD3-4": dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False)),
    "PDQNTD3-1": dict(train_freq=(1, "episode"), gradient_steps=-1),
    "PDQNTD3-4": dict(action_noise=True),
    "HHQNTD3-1": {},
    "HHQNTD3-4": dict(train_freq=4, gradient_steps=2, policy_delay=3),
    "HyARTD3-1": {},
    "HyARTD3-4": {},
}


def train(folder, name, moments):
    """Train or go on: what is run again and again until it ends."""
    algorithm, n_envs = name.split("-")[0], int(name.split("-")[1])
    normalize = n_envs > 1
    env = make_env(n_envs, folder / "monitor", normalize=normalize)
    eval_env = make_env(1, normalize=normalize, seed=77)
    kwargs = dict(RUNS[name])
    with_noise = kwargs.pop("action_noise", False)
    if algorithm != "HPPO":
        kwargs["buffer_size"] = BUFFER_SIZE
    try:
        model = resume(folder / "checkpoints", env, device="cpu")
        resumed_at = model.num_timesteps
    except FileNotFoundError:
        resumed_at = 0
        model = make_model(getattr(sb3_chdp, algorithm), env, device="cpu", **kwargs)
        if with_noise:
            size = model.policy.noise_dim
            model.action_noise = OrnsteinUhlenbeckActionNoise(np.zeros(size), np.full(size, 0.3))
    model.set_logger(configure(str(folder / "log"), ["csv", "json"]))
    callbacks = [
        EvalCallback(eval_env, eval_freq=EVAL_FREQ, n_eval_episodes=2, log_path=str(folder), verbose=0),
        SmallChunks(SAVE_STEPS // n_envs, folder / "checkpoints"),
        moments.callback(),
    ]
    log_interval = 2 if algorithm == "HPPO" else 4
    model.learn(TOTAL - model.num_timesteps, callbacks, log_interval=log_interval, reset_num_timesteps=False)
    return model, env, resumed_at


def _rows(path):
    """Rows of a log without what a clock says."""
    if not path.exists():
        return None
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    if path.suffix == ".json":
        rows = [json.loads(line) for line in lines]
    else:
        rows = list(csv.DictReader(lines))
    return [{k: v for k, v in row.items() if k not in ("t", "time/fps", "time/time_elapsed")} for row in rows]


def result(model, env, folder):
    """Everything that two equal runs have in common, as checksums by name."""
    parts = {}

    def add(name, value):
        if isinstance(value, dict):
            for key, part in value.items():
                add(f"{name}/{key}", part)
        elif isinstance(value, (list, tuple)):
            add(name, dict(enumerate(value)))
        else:
            array = value.detach().numpy() if isinstance(value, th.Tensor) else np.asarray(value)
            content = str(value).encode() if array.dtype.hasobject else array.tobytes()
            parts[name] = hashlib.sha256(content + str(array.dtype).encode()).hexdigest()[:16]

    add("parameters", model.get_parameters())
    buffer = getattr(model, "replay_buffer", None)
    if buffer is not None:
        public = {name: getattr(buffer, name) for name in dir(buffer) if not name.startswith("_")}
        add("buffer", {k: v for k, v in public.items() if isinstance(v, (np.ndarray, int, float, bool))})
    add("num_timesteps", model.num_timesteps)
    add("environments", env.env_method("get_state"))
    of_actions = model.action_space.np_random.bit_generator.state
    add("generators", [th.get_rng_state(), np.random.get_state(legacy=False), of_actions])
    for path in sorted([*(folder / "monitor").glob("*.csv"), *(folder / "log").iterdir()]):
        for i, row in enumerate(_rows(path)):
            for key, value in row.items():
                parts[f"{path.name}/{i}/{key}"] = str(value)
    with np.load(folder / "evaluations.npz") as evaluations:
        add("evaluations", {key: evaluations[key] for key in evaluations.files})
    return parts


class Moments:
    """
    Counts steps and what is done to files of checkpoints, and kills the process at one of these moments.

    A file that is opened to be written holds something else than it should when the process is killed.

    :param folder: of the checkpoints
    :param kill_at: number of the moment, None to count only
    """

    EVENTS = ("open", "os.link", "os.mkdir", "os.remove", "os.rename", "os.rmdir", "shutil.rmtree")

    def __init__(self, folder, kill_at):
        self.folder, self.kill_at, self.n = str(folder), kill_at, 0
        sys.addaudithook(self._hear)

    def _hear(self, event, args):
        # shutil.rmtree names files relative to their folder
        if event not in self.EVENTS or not (str(args[0]).startswith(self.folder) or event in ("os.remove", "os.rmdir")):
            return
        if self.n + 1 == self.kill_at and event == "open" and "w" in str(args[1]):
            self.kill_at = None
            Path(args[0]).write_bytes(b"half of")
            self.kill_at = self.n + 1
        self.pass_by()

    def pass_by(self):
        self.n += 1
        if self.n == self.kill_at:
            os.kill(os.getpid(), signal.SIGKILL)

    def callback(self):
        moments = self

        class Steps(BaseCallback):
            def _on_step(self):
                moments.pass_by()
                return True

        return Steps()


def main(folder, kill_at, name):
    """Run in a process of its own; writes what came out."""
    th.set_num_threads(1)
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    moments = Moments(folder / "checkpoints", kill_at)
    model, env, resumed_at = train(folder, name, moments)
    outcome = {"result": result(model, env, folder), "n_moments": moments.n, "resumed_at": resumed_at}
    (folder / "outcome.json").write_text(json.dumps(outcome))


if __name__ == "__main__":
    main(sys.argv[1], json.loads(sys.argv[2]), sys.argv[3])
