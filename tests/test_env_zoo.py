"""rl_zoo3's scripts with the ids of this package, which contain a slash, and videos of the frames inside a step."""

from typing import Any

import numpy as np
import pytest
import yaml
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

from sb3_chdp import ALGORITHMS
from sb3_chdp.cli import prepare_arguments
from sb3_chdp.envs.recorder import FrameVideoRecorder
from tests.commands import run
from tests.test_zoo import TINY

pytest.importorskip("rl_zoo3")
imageio = pytest.importorskip("imageio")

ENV_ID, FOLDER = "sb3_chdp/Platform-v0", "sb3_chdp-Platform-v0"


def n_pictures(folder):
    """:return: pictures of the only video in a folder"""
    (video,) = folder.glob("*.mp4")
    return sum(1 for _ in imageio.get_reader(video))


@pytest.mark.slow
def test_an_id_with_a_slash(tmp_path):
    run("train", "--env", ENV_ID, "-n", "120", "--eval-freq", "-1", *TINY, cwd=tmp_path)
    logs = tmp_path / "logs" / "chdp" / f"{FOLDER}_1"
    assert (logs / f"{FOLDER}.zip").is_file()
    config = dict(yaml.load((logs / FOLDER / "config.yml").read_text(), Loader=yaml.UnsafeLoader))
    own = yaml.safe_load(ALGORITHMS["chdp"].hyperparams.read_text())["Platform-v0"]
    overridden = {part.split(":")[0] for part in TINY}
    assert own["n_timesteps"]
    assert all(config[name] == value for name, value in own.items() if name not in overridden), "its own settings"
    assert "Mean reward" in run("enjoy", "--env", ENV_ID, "-f", "logs", "--no-render", "-n", "30", cwd=tmp_path)
    run("record", "--env", ENV_ID, "-f", "logs", "-n", "60", "-o", "videos", cwd=tmp_path)
    # A run alone has 20 frames: these are not the pictures of 60 steps, but the first steps that together have 60
    assert 60 < n_pictures(tmp_path / "videos") < 60 + 300
    assert "-to-step-60" not in next((tmp_path / "videos").glob("*.mp4")).name
    output = run("plot", "--env", ENV_ID, "-f", "logs", "-y", "success", "-w", "1", "-o", "p.png", cwd=tmp_path)
    assert "No data" not in output
    assert prepare_arguments("all_plots", ["-e", ENV_ID, "-f", "logs"]) == ["-a", "chdp", "-e", FOLDER, "-f", "logs"]


@pytest.mark.parametrize("env_id", [ENV_ID, "CartPole-v1"])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_recorder(env_id, n_envs, tmp_path, monkeypatch):
    """Every frame of our environments, a picture per step of others; several environments side by side."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    vec_env_cls = SubprocVecEnv if n_envs == 2 else None
    # "module:id" imports the module in the worker processes too
    full_id = f"sb3_chdp:{env_id}" if env_id == ENV_ID else env_id
    env: Any = make_vec_env(full_id, n_envs, seed=0, env_kwargs={"render_mode": "rgb_array"}, vec_env_cls=vec_env_cls)
    env = FrameVideoRecorder(env, str(tmp_path), lambda step: step == 0, video_length=1000)
    env.reset()
    expected = 1
    if env_id == ENV_ID:
        runs, hop = ((k, [np.array([value], dtype=np.float32)] * 3) for k, value in ((0, 0.0), (1, 200.0)))
        for actions in ([runs, hop][:n_envs], [runs] * n_envs):
            _, _, dones, infos = env.step(actions)
            assert not dones.any()
            expected += max(info["frames"] for info in infos)
    else:
        for _ in range(5):
            env.step(np.array([0, 1][:n_envs]))
            expected += 1
    assert len(env.recorded_frames) == expected
    heights, widths = zip(*(frame.shape[:2] for frame in env.recorded_frames), strict=True)
    assert len(set(heights)) == len(set(widths)) == 1
    env.close()
    # moviepy may lose the last one: it computes the number from the duration
    assert expected - 1 <= n_pictures(tmp_path) <= expected
