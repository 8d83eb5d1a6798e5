"""
The command ``sb3-chdp``: rl_zoo3's scripts with the algorithms and environments of this package.

    sb3-chdp train --env Platform-v0 -P          train, with rl_zoo3's options; --algo is chdp by default
    sb3-chdp optimize --env Goal-v0 --n-trials 50      tune hyperparameters with Optuna
    sb3-chdp enjoy --env Platform-v0 -f logs     watch a trained agent
    sb3-chdp record --env Platform-v0 -f logs    record a video of it
    sb3-chdp plot --env Platform-v0 -f logs -y success     learning curves
    sb3-chdp all_plots | plot_from_file | record_training   the other scripts of rl_zoo3
    sb3-chdp benchmark main --jobs 2             reproduce the paper's tables (in a clone of the repository)
    sb3-chdp --version
"""

import importlib.util
import runpy
import subprocess
import sys
from pathlib import Path

from sb3_chdp import __version__

SCRIPTS = {
    "train": "rl_zoo3.train",
    "optimize": "rl_zoo3.train",
    "enjoy": "rl_zoo3.enjoy",
    "record": "rl_zoo3.record_video",
    "record_training": "rl_zoo3.record_training",
    "plot": "rl_zoo3.plots.plot_train",
    "all_plots": "rl_zoo3.plots.all_plots",
    "plot_from_file": "rl_zoo3.plots.plot_from_file",
}
# Scripts for which one algorithm is named by --algo
WITH_ALGO = ("train", "optimize", "enjoy", "record", "record_training", "plot")
# What rl_zoo3 2.9.2 imports, declared by it or not
REQUIRED = ("rl_zoo3", "requests", "pandas", "tensorboard")
BENCHMARK = Path(__file__).parent.parent / "benchmarks" / "reproduce.py"


def _option(arguments: list[str], *names: str) -> str | None:
    """:return: value of the first of the named options that is given, None if none is"""
    for i, argument in enumerate(arguments):
        name, _, value = argument.partition("=")
        if name in names:
            return value or (arguments[i + 1] if i + 1 < len(arguments) else "")
    return None


def prepare_arguments(command: str, arguments: list[str]) -> list[str]:
    """
    :param command: a key of ``SCRIPTS``
    :param arguments: what the user wrote behind it
    :return: the arguments for rl_zoo3's script
    """
    from sb3_chdp.zoo import HYPERPARAMS_FOLDER

    arguments = list(arguments)
    if command in ("plot", "all_plots"):
        # The scripts that read folders do not know how rl_zoo3 names that of an id with a slash
        arguments = [argument.replace("sb3_chdp/", "sb3_chdp-") for argument in arguments]
    short_name = ("-a",) if command == "plot" else ()
    if command in WITH_ALGO and _option(arguments, "--algo", *short_name) is None:
        arguments = ["--algo", "chdp", *arguments]
    if command == "optimize" and not {"-optimize", "--optimize-hyperparameters"} & set(arguments):
        arguments.append("--optimize-hyperparameters")
    if command in ("train", "optimize"):
        config = HYPERPARAMS_FOLDER / f"{_option(arguments, '--algo')}.yml"
        # In front, so that a -conf of the user wins; rl_zoo3 has the files of its own algorithms
        if config.is_file():
            arguments = ["-conf", str(config), *arguments]
    return arguments


def run_benchmark(arguments: list[str]) -> None:
    """Run ``benchmarks/reproduce.py``, which is not part of the package."""
    if not BENCHMARK.is_file():
        sys.exit("sb3-chdp benchmark works in a clone of the repository: it writes to its folder benchmarks")
    # As a script, so that its worker processes find it
    sys.exit(subprocess.run([sys.executable, str(BENCHMARK), *arguments]).returncode)


def main() -> None:
    """Entry point of ``sb3-chdp`` and ``python -m sb3_chdp``."""
    if len(sys.argv) < 2 or sys.argv[1] in ("-h", "--help"):
        print(__doc__)
        return
    if sys.argv[1] == "--version":
        print(f"sb3_chdp {__version__}")
        return
    command, arguments = sys.argv[1], sys.argv[2:]
    if command not in (*SCRIPTS, "benchmark"):
        sys.exit(f"sb3-chdp: unknown command {command!r}, choose from {', '.join(SCRIPTS)}, benchmark")
    if command == "benchmark":
        run_benchmark(arguments)
        return
    missing = [name for name in REQUIRED if importlib.util.find_spec(name) is None]
    if missing:
        sys.exit(f"sb3-chdp {command} needs {', '.join(missing)}: pip install 'sb3-chdp[zoo]'")

    from sb3_chdp.zoo import register

    register()
    if command == "record":
        from stable_baselines3.common import vec_env

        from sb3_chdp.envs.recorder import FrameVideoRecorder

        vec_env.VecVideoRecorder = FrameVideoRecorder  # type: ignore[misc]
    sys.argv = [f"sb3-chdp {command}", *prepare_arguments(command, arguments)]
    runpy.run_module(SCRIPTS[command], run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
