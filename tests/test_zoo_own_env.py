"""The command line with environments of the user's own."""

import pytest

from tests.commands import run

pytest.importorskip("rl_zoo3")

OWN_ENV = """
import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Discrete, Tuple


class OwnEnv(gym.Env):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    action_space = Tuple((Discrete(2), Box(-1, 1, (1,))))
    observation_space = Box(-1, 1, (2,))

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        return np.zeros(2, np.float32), float(action[1][0]), False, False, {}

    def render(self):
        return np.zeros((16, 16, 3), np.uint8)


gym.register("Own-v0", OwnEnv, max_episode_steps=5)
"""


@pytest.mark.parametrize(
    "algo, settings, run_that",
    [
        ("hppo", ["n_steps:5", "batch_size:10"], []),
        (
            "sb3:sac",
            ["learning_starts:20", "buffer_size:100", "action_layout:'shared'"],
            ["--algo", "sb3:sac", "--env", "Own-v0"],
        ),
    ],
    ids=["the last run", "the run that is named"],
)
def test_own_environment(algo, settings, run_that, tmp_path):
    """With every command; its info says nothing about success."""
    (tmp_path / "mine.py").write_text(OWN_ENV)
    run("train", "--algo", algo, "--env", "Own-v0", "--gym-packages", "mine", "-n", "60", "--eval-freq", "30",
        "--eval-episodes", "2", "-params", *settings, cwd=tmp_path)  # fmt: skip
    folder = tmp_path / "logs" / algo.removeprefix("sb3:") / "Own-v0_1"
    assert (folder / "Own-v0" / "vecnormalize.pkl").is_file(), "the block default normalises"
    which = [*run_that, "--gym-packages", "mine"]
    run("enjoy", *which, "--no-render", "-n", "20", cwd=tmp_path)
    run("record", *which, "-n", "5", cwd=tmp_path)
    assert list(folder.glob("videos/*.mp4"))
    run("plot", *which, "-w", "2", "-o", "plot.png", cwd=tmp_path)
    run("all_plots", *which, "-o", "all.png", cwd=tmp_path)
    assert (tmp_path / "plot.png").is_file() and (tmp_path / "all.png").is_file()
    message = run("enjoy", "--no-render", cwd=tmp_path, code=1)
    assert message == "sb3-chdp enjoy: unknown environment 'Own-v0' (--gym-packages names the module that registers it)\n"


OWN_NETWORKS = """
from stable_baselines3.common.torch_layers import FlattenExtractor


class OwnExtractor(FlattenExtractor):
    pass


policy_kwargs = dict(features_extractor_class=OwnExtractor)
hyperparams = {"Own-v0": dict(n_timesteps=20, n_steps=5, batch_size=10, policy_kwargs=policy_kwargs)}
"""


def test_own_networks(tmp_path):
    """Classes of the user's own, which need trust elsewhere."""
    (tmp_path / "mine.py").write_text(OWN_ENV + OWN_NETWORKS)
    arguments = ["train", "--algo", "hppo", "--env", "Own-v0", "--gym-packages", "mine", "-conf", "mine", "--eval-freq", "-1"]
    run(*arguments, cwd=tmp_path)
    run("enjoy", "--gym-packages", "mine", "--no-render", "-n", "5", cwd=tmp_path)
    run(*arguments, "-i", "logs/hppo/Own-v0_1/Own-v0.zip", "-f", "continued", cwd=tmp_path)


def test_settings_that_say_little(tmp_path):
    """Policy and number of steps need not stand in a file."""
    (tmp_path / "mine.py").write_text(OWN_ENV)
    (tmp_path / "mine.yml").write_text("Own-v0: {n_steps: 5, batch_size: 10}")
    arguments = ["train", "--algo", "hppo", "--env", "Own-v0", "--gym-packages", "mine", "-conf", "mine.yml"]
    run(*arguments, "-n", "20", "--eval-freq", "-1", cwd=tmp_path)
    assert run(*arguments, cwd=tmp_path, code=1).endswith("-n says for how many steps: the file mine.yml does not\n")


def test_numbers_that_are_text_to_yaml(tmp_path):
    (tmp_path / "mine.py").write_text(OWN_ENV)
    (tmp_path / "mine.yml").write_text("Own-v0: {n_steps: 5, batch_size: 10, n_timesteps: 1e2}")
    arguments = ["train", "--algo", "hppo", "--env", "Own-v0", "--gym-packages", "mine", "-conf", "mine.yml"]
    message = run(*arguments, cwd=tmp_path, code=1)
    assert message.endswith("n_timesteps: 1e2 is a text, not a number; in YAML write !!float 1e2\n")


def test_settings_that_nobody_has(tmp_path):
    (tmp_path / "mine.py").write_text(OWN_ENV)
    arguments = ["train", "--algo", "hppo", "--env", "Own-v0", "--gym-packages", "mine", "-params", "n_setps:5"]
    message = run(*arguments, cwd=tmp_path, code=1)
    assert "unknown setting 'n_setps', did you mean n_steps? (hppo has action_layout, batch_size, " in message
    assert not (tmp_path / "logs").exists()


def test_success_that_only_some_infos_have(tmp_path):
    """The monitor insists on what it is told to note."""
    own_env = OWN_ENV.replace("False, False, {}", 'False, False, {"is_success": True} if action[0] else {}')
    (tmp_path / "mine.py").write_text(own_env)
    run("train", "--algo", "hppo", "--env", "Own-v0", "--gym-packages", "mine", "-n", "100", "--eval-freq", "-1",
        "-params", "n_steps:5", "batch_size:10", cwd=tmp_path)  # fmt: skip


def test_masks_of_joint_actions(tmp_path):
    own_env = OWN_ENV.replace("Tuple((Discrete(2), Box(-1, 1, (1,))))", "Tuple((MultiBinary(7), Box(-1, 1, (1,))))")
    own_env = own_env.replace("import Box, Discrete", "import Box, Discrete, MultiBinary")
    mask = "    def action_masks(self):\n        return np.arange(128) % 2 == 0\n\n    def render"
    (tmp_path / "mine.py").write_text(own_env.replace("    def render", mask))
    run("train", "--algo", "hppo", "--env", "Own-v0", "--gym-packages", "mine", "-n", "20", "--eval-freq", "-1",
        "-params", "n_steps:5", "batch_size:10", "action_layout:'joint'", cwd=tmp_path)  # fmt: skip


@pytest.mark.parametrize("algo", ["hppo", "pdqn_td3", "sb3:sac"])
def test_observations_that_cannot_be_normalized(algo, tmp_path):
    (tmp_path / "mine.py").write_text(
        OWN_ENV.replace("observation_space = Box(-1, 1, (2,))", "observation_space = Discrete(3)").replace(
            "np.zeros(2, np.float32)", "np.int64(1)"
        )
    )
    settings = ["n_steps:5"] if algo == "hppo" else ["learning_starts:10", "buffer_size:100"]
    run("train", "--algo", algo, "--env", "Own-v0", "--gym-packages", "mine", "-n", "20", "--eval-freq", "-1",
        "-params", *settings, "batch_size:10", cwd=tmp_path)  # fmt: skip


CAMERA_ENV = """
import gymnasium as gym
import numpy as np
from gymnasium import spaces

from tests.hybrid_envs import LayoutEnv, layouts

CAMERA = spaces.Box(0, 255, (36, 36, 1), np.uint8)
VECTOR = spaces.Box(-1, 1, (2,))
gym.register("Camera-v0", lambda: LayoutEnv(layouts()["shared"], CAMERA))
gym.register("Both-v0", lambda: LayoutEnv(layouts()["shared"], spaces.Dict(camera=CAMERA, gps=VECTOR)))
gym.register("Nested-v0", lambda: LayoutEnv(layouts()["shared"], spaces.Dict(a=spaces.Dict(b=VECTOR))))
"""


@pytest.mark.parametrize(("algo", "env"), [("chdp", "Both-v0"), ("pa_td3", "Camera-v0"), ("pa_td3", "Both-v0")])
def test_the_policy_follows_from_the_observations(algo, env, tmp_path):
    """Within VecNormalize, too, which the settings of pa_td3 ask for."""
    (tmp_path / "cameras.py").write_text(CAMERA_ENV)
    run("train", "--algo", algo, "--env", env, "--gym-packages", "cameras", "-n", "30", "--eval-freq", "20",
        "--eval-episodes", "1", "-params", "learning_starts:10", "buffer_size:100", "batch_size:4", cwd=tmp_path)  # fmt: skip
    run("enjoy", "--gym-packages", "cameras", "--no-render", "-n", "20", cwd=tmp_path)


def test_nested_observations_need_a_wrapper(tmp_path):
    (tmp_path / "cameras.py").write_text(CAMERA_ENV)
    arguments = ["train", "--env", "Nested-v0", "--gym-packages", "cameras", "-n", "20", "-params", "learning_starts:100"]
    wrapper = "env_wrapper:'gymnasium.wrappers.FlattenObservation'"
    assert f'-params env_wrapper:"{wrapper.partition(":")[2]}"' in run(*arguments, cwd=tmp_path, code=1)
    run(*arguments, wrapper, cwd=tmp_path)


MASKED_ENV = """
import gymnasium as gym
import numpy as np

from tests.hybrid_envs import MaskedEnv


class MaskedPicture(MaskedEnv):
    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 10}

    def __init__(self, render_mode=None):
        super().__init__()
        self.render_mode = render_mode

    def render(self):
        return np.zeros((16, 16, 3), np.uint8)


gym.register("Masked-v0", MaskedPicture)
"""


def test_models_are_played_with_masks(tmp_path):
    """The environment raises for what it forbids: while it is trained, evaluated, watched, recorded and published."""
    (tmp_path / "masked.py").write_text(MASKED_ENV)
    run("train", "--env", "Masked-v0", "--gym-packages", "masked", "-n", "60", "--eval-freq", "30", "--eval-episodes", "2",
        "-params", "learning_starts:20", "buffer_size:100", "n_diffusion_steps:2", cwd=tmp_path)  # fmt: skip
    # Three actions, of which most states forbid two: nobody comes through 100 steps by chance
    assert "10 Episodes" in run("enjoy", "--gym-packages", "masked", "--no-render", "-n", "100", cwd=tmp_path)
    run("enjoy", "--gym-packages", "masked", "--no-render", "-n", "50", "--n-envs", "2", "--stochastic", cwd=tmp_path)
    run("record", "--gym-packages", "masked", "-n", "30", cwd=tmp_path)
    assert list((tmp_path / "logs").glob("*/*/videos/*.mp4"))
    options = "-orga me --no-upload --eval-episodes 5 -n 20".split()
    run("push_to_hub", "--gym-packages", "masked", *options, cwd=tmp_path)
