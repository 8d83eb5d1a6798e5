"""The package installs as a wheel, with its data and without the tests."""

import re
import subprocess
import sys
import zipfile
from pathlib import Path

import gymnasium as gym
import pytest

import sb3_chdp

ROOT = Path(__file__).parent.parent


def test_wheel(tmp_path):
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--outdir", str(tmp_path), str(ROOT)], check=True, capture_output=True
    )
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        archive.extractall(tmp_path / "site")
    assert {
        "sb3_chdp/py.typed",
        "sb3_chdp/version.txt",
        "sb3_chdp/hyperparams/chdp.yml",
        "sb3_chdp/benchmark/protocol.yml",
    } <= set(names)
    assert {name.split("/")[0].split("-")[0] for name in names} == {"sb3_chdp"}, "nothing else, no tests"
    # Used from the wheel: the version and the YAML files are found
    code = (
        "import sb3_chdp;"
        "print(sb3_chdp.__file__, sb3_chdp.__version__, all(a.hyperparams.is_file() for a in sb3_chdp.ALGORITHMS.values()))"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path / "site", check=True, capture_output=True, text=True
    ).stdout.split()
    assert result[-3:] == [str(tmp_path / "site" / "sb3_chdp" / "__init__.py"), sb3_chdp.__version__, "True"]


def test_version_of_the_command():
    result = subprocess.run([sys.executable, "-m", "sb3_chdp", "--version"], check=True, capture_output=True, text=True)
    assert result.stdout == f"sb3_chdp {sb3_chdp.__version__}\n"


def test_import_is_light():
    """Importing the package imports neither rl_zoo3, which patches Gymnasium, nor pygame."""
    code = "import sys, sb3_chdp; print([m for m in ('rl_zoo3', 'pygame', 'optuna', 'matplotlib.pyplot') if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert result.stdout.strip() == "[]"


def test_classes_of_the_registry_are_exported():
    for algorithm in sb3_chdp.ALGORITHMS.values():
        assert getattr(sb3_chdp, algorithm.class_name) is algorithm.load_class()
        assert algorithm.class_name in sb3_chdp.__all__ and algorithm.class_name in dir(sb3_chdp)
    with pytest.raises(AttributeError, match="NoAlgorithm"):
        _ = sb3_chdp.NoAlgorithm


def test_example_of_the_readme(capsys):
    code = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)[0]
    names: dict = {}
    exec(code.replace("2_000", "150"), names)
    assert names["Drone"].action_space.contains(names["action"])
    # As the command line has it; Gymnasium checks more then
    gym.register("Drone-v0", names["Drone"])
    env = gym.make("Drone-v0")
    del gym.registry["Drone-v0"]
    env.reset()
    env.step(names["action"])
    assert re.fullmatch(r"success of CHDP \d+% and of SAC on flat actions \d+%\n", capsys.readouterr().out)
