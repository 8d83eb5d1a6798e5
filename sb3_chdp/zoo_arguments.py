"""Arguments of the command line: what users need not say, and hints about what they said."""

import difflib
import importlib
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym

# rl_zoo3's default of train; the last run of it is looked for if no folder is named
LOGS = "logs"
STOCK = "sb3:"
HELP = {"-h", "--help"}


class Names(NamedTuple):
    """How a script spells its options, the first spelling being the one that is added."""

    folder: tuple[str, ...]
    algo: tuple[str, ...]
    env: tuple[str, ...]
    exp_id: tuple[str, ...] = ()


_MODEL = Names(("-f", "--folder"), ("--algo",), ("--env",), ("--exp-id",))
# Scripts that read a run which was trained before
READERS = {
    "enjoy": _MODEL,
    "record": _MODEL,
    "push_to_hub": _MODEL,
    "plot": Names(("-f", "--exp-folder"), ("-a", "--algo"), ("-e", "--env")),
    "all_plots": Names(("-f", "--exp-folders"), ("-a", "--algos"), ("-e", "--env")),
}


class ArgumentsError(ValueError):
    """What the user wrote cannot be done; the message says why."""


def option(arguments: list[str], *names: str) -> str | None:
    """:return: value of the first of the named options that is given, None if none is"""
    for i, argument in enumerate(arguments):
        name, _, value = argument.partition("=")
        if name in names:
            return value or (arguments[i + 1] if i + 1 < len(arguments) else "")
    return None


def split_option(arguments: list[str], name: str) -> tuple[list[str], list[str]]:
    """
    :param arguments: command line
    :param name: an option with any number of values
    :return: the other arguments, the values
    """
    rest, values, inside = [], [], False
    for argument in arguments:
        key, _, value = argument.partition("=")
        if key == name:
            inside = True
            values += [value] if value else []
        elif inside and not argument.startswith("-"):
            values.append(argument)
        else:
            inside = False
            rest.append(argument)
    return rest, values


def unknown(kind: str, name: str, known: Iterable[str], hint: str) -> str:
    """:return: message about a name that nobody knows, with the nearest one that somebody does"""
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.8)
    return f"unknown {kind} {name!r}{f', did you mean {close[0]}?' if close else ''} ({hint})"


def import_packages(packages: Iterable[str]) -> None:
    """
    Let the user's modules register their environments.

    :param packages: values of ``--gym-packages``
    :raises ArgumentsError: if there is no such module
    """
    for package in packages:
        try:
            importlib.import_module(package)
        except ModuleNotFoundError as error:
            # A module that is missing inside the user's is an error of the user's, with its traceback
            if error.name is None or not f"{package}.".startswith(f"{error.name}."):
                raise
            raise ArgumentsError(
                f"--gym-packages: there is no module {package!r} in the current folder or among the installed packages"
            ) from None


def check_hyperparams(arguments: list[str]) -> None:
    """
    :param arguments: command line
    :raises ArgumentsError: for a setting that is not ``KEY:VALUE`` with a value of Python's
    """
    from rl_zoo3 import utils

    names = ("-params", "--hyperparams")
    for setting in [setting for name in names for setting in split_option(arguments, name)[1]]:
        key, _, value = setting.partition(":")
        if not value:
            raise ArgumentsError(f"-params {setting}: write KEY:VALUE, for example gamma:0.9")
        try:
            eval(value, dict(vars(utils)))  # as rl_zoo3 does
        except (SyntaxError, NameError):
            raise ArgumentsError(
                f"-params {setting}: no value of Python's; texts need quotes, -params \"{key}:'{value}'\""
            ) from None


def check_env(env_id: str | None) -> None:
    """
    :param env_id: an environment, None if the user named none
    :raises ArgumentsError: if it is not registered
    """
    if not env_id:
        raise ArgumentsError("--env says on which environment")
    if env_id in gym.registry:
        return
    module, colon, name = env_id.partition(":")
    if colon:
        raise ArgumentsError(f"--env {env_id}: write --env {name} --gym-packages {module}")
    hint = "--gym-packages names the module that registers it"
    raise ArgumentsError(unknown("environment", env_id, gym.registry, hint))


def check_renders(env_id: str) -> None:
    """
    :param env_id: an environment that is registered
    :raises ArgumentsError: if no video can be made of it
    """
    try:
        env = gym.make(env_id)
    except Exception:
        return  # it needs the arguments of the run
    modes = env.unwrapped.metadata.get("render_modes", [])
    env.close()
    if "rgb_array" not in modes:
        raise ArgumentsError(
            f"{env_id} has the render modes {modes} in its metadata, and pictures need 'rgb_array'; push_to_hub does without "
            "them if you say --no-render"
        )


def complete(command: str, arguments: list[str]) -> list[str]:
    """
    Name the run that was trained last, of those that fit, in the folder ``logs`` if the user names no other one.

    :param command: a key of ``READERS``
    :param arguments: what the user wrote
    :return: arguments that name folder, algorithm, environment and number of the run
    :raises ArgumentsError: if there is no such run
    """
    names = READERS[command]
    folder, algo, env = (option(arguments, *of) for of in (names.folder, names.algo, names.env))
    is_plot = not names.exp_id
    exp_id = None if is_plot else option(arguments, *names.exp_id)
    if HELP & set(arguments) or (folder is not None and (command == "all_plots" or env is not None)):
        return arguments
    # Not the folders that a tuning leaves behind; those with checkpoints alone if the user asks for one
    any_file = any(argument.startswith("--load-") for argument in arguments)
    files = Path(folder or LOGS).glob(
        f"{(algo or '*').removeprefix(STOCK)}/{folder_name(env or '*')}_*/{'*.monitor.csv' if is_plot else '*.zip'}"
    )
    newest: tuple[float, Path] | None = None
    for file in files:
        env_name, _, number = file.parent.name.rpartition("_")
        # rl_zoo3 takes the last run for 0, the folder of the algorithm itself for -1
        is_meant = number.isdigit() and exp_id in (None, "0", "-1", number)
        if is_meant and (_has_episodes(file) if is_plot else any_file or file.stem == env_name):
            newest = max(newest or (0.0, file.parent), (file.stat().st_mtime, file.parent))
    if newest is None:
        kind = "run with a finished episode" if is_plot else "run" if any_file else "finished run"
        asked = {"of": algo, "on": env, "with --exp-id": exp_id}
        words = ["no", kind, *(f"{word} {value}" for word, value in asked.items() if value), f"in {folder or LOGS}"]
        raise ArgumentsError(f"{' '.join(words)}; -f names another folder")
    run = newest[1]
    env_name, _, number = run.name.rpartition("_")
    added = [] if folder else [names.folder[0], LOGS]
    if algo is None:
        added += [names.algo[0], run.parent.name]
    if env is None:
        added += [names.env[0], next((known for known in gym.registry if folder_name(known) == env_name), env_name)]
    if not is_plot and exp_id is None:
        added += [names.exp_id[0], number]
    return [*added, *arguments]


def _has_episodes(monitor: Path) -> bool:
    # Behind a line of JSON and the names of the columns
    with monitor.open() as file:
        return sum(1 for _ in zip(range(3), file, strict=False)) == 3


def with_folder_names(arguments: list[str]) -> list[str]:
    """:return: the arguments of a script that looks for folders, with environments named as their folders are"""
    named, inside = [], False
    for argument in arguments:
        inside = argument.partition("=")[0] in ("-e", "--env") or (inside and not argument.startswith("-"))
        named.append(folder_name(argument) if inside else argument)
    return named


def folder_name(env_id: str) -> str:
    """:return: an environment as rl_zoo3 names its folder"""
    return env_id.replace("/", "-")
