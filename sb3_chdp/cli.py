"""
The command ``sb3-chdp``: rl_zoo3's scripts with the algorithms and environments of this package.

    sb3-chdp train --env Platform-v0 -P          train, with rl_zoo3's options; --algo is chdp by default
    sb3-chdp train --resume logs/chdp/Platform-v0_1    go on with a killed run that was started with --save-freq
    sb3-chdp optimize --env Goal-v0 --n-trials 50      tune hyperparameters with Optuna
    sb3-chdp enjoy --env Platform-v0 -f logs     watch a trained agent
    sb3-chdp record --env Platform-v0 -f logs    record a video of it
    sb3-chdp plot --env Platform-v0 -f logs -y success     learning curves
    sb3-chdp all_plots | plot_from_file | record_training   the other scripts of rl_zoo3
    sb3-chdp benchmark --envs MyEnv-v0 --gym-packages my_package --algos chdp hppo sb3:sac    compare algorithms
    sb3-chdp benchmark paper                     the published table once more
    sb3-chdp --version
"""

import importlib.util
import os
import runpy
import sys

from sb3_chdp import ALGORITHMS, __version__

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
BENCHMARK_REQUIRED = (*REQUIRED, "rliable", "submitit", "filelock")


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
    arguments = list(arguments)
    if command in ("plot", "all_plots"):
        # The scripts that read folders do not know how rl_zoo3 names that of an id with a slash
        arguments = [argument.replace("sb3_chdp/", "sb3_chdp-") for argument in arguments]
    short_name = ("-a",) if command == "plot" else ()
    if command in WITH_ALGO and _option(arguments, "--algo", *short_name) is None:
        arguments = ["--algo", next(iter(ALGORITHMS)), *arguments]
    if command == "optimize" and not {"-optimize", "--optimize-hyperparameters"} & set(arguments):
        arguments.append("--optimize-hyperparameters")
    algorithm = ALGORITHMS.get(_option(arguments, "--algo") or "")
    if command == "optimize" and algorithm is not None and algorithm.tuning is None:
        sys.exit(f"sb3-chdp optimize: {algorithm.name} has no Optuna sampler and cannot be tuned")
    if command in ("train", "optimize") and algorithm is not None:
        # In front, so that a -conf of the user wins; rl_zoo3 has the files of its own algorithms
        arguments = ["-conf", str(algorithm.hyperparams), *arguments]
    return arguments


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
    required = BENCHMARK_REQUIRED if command == "benchmark" else REQUIRED
    missing = [name for name in required if importlib.util.find_spec(name) is None]
    if missing:
        sys.exit(f"sb3-chdp {command} needs {', '.join(missing)}: pip install 'sb3-chdp[zoo]'")
    # As python -m does: --gym-packages finds modules of the folder in which the user is
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    if command == "benchmark":
        from sb3_chdp.benchmark.cli import main as benchmark

        sys.exit(benchmark(arguments))

    from sb3_chdp.zoo import register

    register()
    if command == "record":
        from stable_baselines3.common import vec_env

        from sb3_chdp.envs.recorder import FrameVideoRecorder

        vars(vec_env).update(VecVideoRecorder=FrameVideoRecorder)
    if command == "train":
        from sb3_chdp.zoo_resume import prepare_training

        # The arguments of a run that goes on are its own
        resumed = any(argument.partition("=")[0] == "--resume" for argument in arguments)
        try:
            arguments = prepare_training(arguments if resumed else prepare_arguments(command, arguments))
        except ValueError as error:
            sys.exit(f"sb3-chdp train: {error}")
    else:
        arguments = prepare_arguments(command, arguments)
    sys.argv = [f"sb3-chdp {command}", *arguments]
    runpy.run_module(SCRIPTS[command], run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
