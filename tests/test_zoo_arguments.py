"""What the command line fills in, and what it says about mistakes."""

import os
import re

import gymnasium as gym
import pytest

from sb3_chdp.cli import COMMANDS, prepare_arguments
from sb3_chdp.zoo_arguments import (
    ArgumentsError,
    check_env,
    check_hyperparams,
    check_renders,
    complete,
    import_packages,
    option,
    split_option,
)
from tests.hybrid_envs import make_layout_env


@pytest.fixture
def logs(tmp_path, monkeypatch):
    """Runs in the order in which they were trained."""
    monkeypatch.chdir(tmp_path)
    files = ("chdp/Goal-v0_1/Goal-v0", "hppo/Goal-v0_9/Goal-v0", "hppo/Goal-v0_10/Goal-v0", "chdp/sb3_chdp-Platform-v0_2/")
    for age, name in enumerate(files):
        run = tmp_path / "logs" / os.path.dirname(name)
        run.mkdir(parents=True)
        # The last run is not finished
        for file in [run / "0.monitor.csv", run / (os.path.basename(name) or "rl_model_5_steps")]:
            file = file.with_suffix(file.suffix or ".zip")
            file.write_text("#{}\nr,l,t\n1,1,1\n" if file.suffix == ".csv" else "")
            os.utime(file, (age, age))
    # The environment broke at once
    (tmp_path / "logs/chdp/Broken-v0_1").mkdir()
    (tmp_path / "logs/chdp/Broken-v0_1/0.monitor.csv").write_text("#{}\nr,l,t\n")


@pytest.mark.parametrize(
    ("command", "arguments", "added"),
    [
        ("enjoy", "", "-f logs --algo hppo --env Goal-v0 --exp-id 10"),
        ("record", "--algo chdp -n 5", "-f logs --env Goal-v0 --exp-id 1"),
        ("enjoy", "--algo=sb3:hppo --exp-id 9", "-f logs --env Goal-v0"),
        ("enjoy", "--load-last-checkpoint", "-f logs --algo chdp --env sb3_chdp/Platform-v0 --exp-id 2"),
        ("enjoy", "--load-best --env sb3_chdp/Platform-v0", "-f logs --algo chdp --exp-id 2"),
        ("plot", "", "-f logs -a chdp -e sb3_chdp/Platform-v0"),
        ("all_plots", "--env Goal-v0", "-f logs -a hppo"),
        ("enjoy", "--folder logs --algo chdp", "--env Goal-v0 --exp-id 1"),
        ("enjoy", "--folder elsewhere --env Goal-v0", ""),
        ("plot", "-f logs", "-a chdp -e sb3_chdp/Platform-v0"),
        ("all_plots", "-f elsewhere", ""),
        ("enjoy", "--help", ""),
    ],
)
def test_the_last_run(logs, command, arguments, added):
    assert complete(command, arguments.split()) == [*added.split(), *arguments.split()]


@pytest.mark.parametrize(
    ("command", "arguments", "message"),
    [
        ("enjoy", "--algo pa_td3", "no finished run of pa_td3 in logs; -f names another folder"),
        ("record", "--env sb3_chdp/Platform-v0", "no finished run on sb3_chdp/Platform-v0 in logs"),
        ("plot", "--env Other-v0", "no run with a finished episode on Other-v0 in logs"),
        ("enjoy", "--folder elsewhere", "no finished run in elsewhere"),
        ("enjoy", "--env Goal-v0 --exp-id 2", "no finished run on Goal-v0 with --exp-id 2 in logs"),
        ("plot", "-f elsewhere", "no run with a finished episode in elsewhere"),
    ],
)
def test_no_such_run(logs, command, arguments, message):
    with pytest.raises(ArgumentsError, match=re.escape(message)):
        complete(command, arguments.split())


@pytest.mark.parametrize(
    ("command", "arguments", "prepared"),
    [
        ("train", "--algo sb3:sac --env Goal-v0", "--algo sac --env Goal-v0"),
        ("enjoy", "--algo=sb3:sac -f logs --env Goal-v0", "--algo=sac -f logs --env Goal-v0"),
        ("enjoy", "-f logs --env Goal-v0", "--algo chdp -f logs --env Goal-v0"),
        ("plot", "-f sb3_chdp/logs -e sb3_chdp/Goal-v0", "-a chdp -f sb3_chdp/logs -e sb3_chdp-Goal-v0"),
        ("plot", "-f a/b --env=lab/A-v0 -o x/y.png", "-a chdp -f a/b --env=lab-A-v0 -o x/y.png"),
        ("all_plots", "-f logs -e Goal-v0 -a hppo sb3:sac", "-f logs -e Goal-v0 -a hppo sac"),
        ("plot_from_file", "-i post.pkl", "-i post.pkl"),
    ],
)
def test_algorithm(command, arguments, prepared):
    assert prepare_arguments(command, arguments.split()) == prepared.split()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("-params gamma=0.9", "-params gamma=0.9: write KEY:VALUE, for example gamma:0.9"),
        ("-params gamma:1 action_layout:shared", "texts need quotes, -params \"action_layout:'shared'\""),
        ("-params learning_rate:lin_0.001", "texts need quotes, -params \"learning_rate:'lin_0.001'\""),
        ("-params learning_rate:lin_1e-3", "texts need quotes, -params \"learning_rate:'lin_1e-3'\""),
        ("-params policy_kwargs:dict(net_arch=[64", "no value of Python's"),
        ("--algo sb3:chdp", "sb3:chdp: chdp is of this package, leave out sb3:"),
        ("--algo=sb3:hppo", "sb3:hppo: hppo is of this package, leave out sb3:"),
        ("-conf nowhere.yml", "-conf: there is no file nowhere.yml"),
    ],
)
def test_slips(arguments, message):
    with pytest.raises(ArgumentsError, match=re.escape(message)):
        prepare_arguments("train", arguments.split())


def test_settings_that_are_sound():
    check_hyperparams(["-params", "gamma:0.9", "seed:None", "policy_kwargs:dict(net_arch=[64])", "layout:'shared'"])


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("Platfrom-v0", "unknown environment 'Platfrom-v0', did you mean Platform-v0? (--gym-packages names"),
        ("Qwx-v0", "unknown environment 'Qwx-v0' (--gym-packages names"),
        ("mine:Own-v0", "--env mine:Own-v0: write --env Own-v0 --gym-packages mine"),
        (None, "--env says on which environment"),
    ],
)
def test_unknown_environment(env_id, message):
    with pytest.raises(ArgumentsError, match=re.escape(message)):
        check_env(env_id)


def test_known_environment():
    check_env("Platform-v0")
    check_env("sb3_chdp/Platform-v0")


def test_environments_without_pictures():
    check_renders("Platform-v0")
    gym.register("Dark-v0", make_layout_env)
    gym.register("WithArguments-v0", "tests.hybrid_envs:LayoutEnv")
    check_renders("WithArguments-v0")
    with pytest.raises(ArgumentsError, match=r"Dark-v0 has the render modes \[\] .* pictures need 'rgb_array'"):
        check_renders("Dark-v0")


def test_modules(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "module_with_a_hole.py").write_text("import not_there_at_all")
    with pytest.raises(ArgumentsError, match="there is no module 'not_there_either'"):
        import_packages(["not_there_either"])
    with pytest.raises(ModuleNotFoundError, match="not_there_at_all"):
        import_packages(["module_with_a_hole"])


def test_options():
    arguments = "--env A --gym-packages a b -n 5 --gym-packages=c --algo=x".split()
    assert split_option(arguments, "--gym-packages") == ("--env A -n 5 --algo=x".split(), ["a", "b", "c"])
    assert option(arguments, "--algo") == "x" and option(arguments, "-n") == "5" and option(arguments, "-f") is None


def test_every_command_is_listed():
    from sb3_chdp import cli

    assert all(f"sb3-chdp {command}" in cli.__doc__ or f"| {command}" in cli.__doc__ for command in COMMANDS)
