"""
The command ``sb3-chdp``: rl_zoo3's scripts with the algorithms and environments of this package.

    sb3-chdp train --env Platform-v0 -P          train, with rl_zoo3's options; --algo is chdp by default
    sb3-chdp train --env MyEnv-v0 --gym-packages my_module    the same on an environment that my_module.py registers
    sb3-chdp train --algo sb3:sac --env Platform-v0    SB3's own algorithms, on flat actions
    sb3-chdp train --resume logs/chdp/Platform-v0_1    go on with a killed run that was started with --save-freq
    sb3-chdp optimize --env Goal-v0 --n-trials 50      tune hyperparameters with Optuna
    sb3-chdp enjoy                               watch the agent that was trained last, of those in the folder logs
    sb3-chdp enjoy --env Platform-v0 -f benchmarks/models    watch a published one
    sb3-chdp record                              record a video of the last one
    sb3-chdp plot -y success -o curve.png        learning curves; without -o in a window
    sb3-chdp all_plots | plot_from_file          the other scripts of rl_zoo3
    sb3-chdp push_to_hub -orga me                publish the last one on the Hugging Face Hub
    sb3-chdp load_from_hub -orga me --env Platform-v0    download it
    sb3-chdp benchmark --envs MyEnv-v0 --gym-packages my_module --algos chdp hppo sb3:sac    compare algorithms
    sb3-chdp benchmark paper                     the published table once more
    sb3-chdp --version

--gym-packages works with every command.
"""

import importlib
import importlib.util
import os
import runpy
import sys

from sb3_chdp import ALGORITHMS, __version__
from sb3_chdp.zoo_arguments import (
    HELP,
    READERS,
    STOCK,
    ArgumentsError,
    check_env,
    check_hyperparams,
    check_renders,
    complete,
    import_packages,
    option,
    split_option,
    unknown,
    with_folder_names,
)

# Module, and function in it; without one the module is run as a script
SCRIPTS = {
    "train": ("rl_zoo3.train", "train"),
    "optimize": ("rl_zoo3.train", "train"),
    "enjoy": ("rl_zoo3.enjoy", "enjoy"),
    "record": ("rl_zoo3.record_video", None),
    "plot": ("rl_zoo3.plots.plot_train", "plot_train"),
    "all_plots": ("rl_zoo3.plots.all_plots", "all_plots"),
    "plot_from_file": ("rl_zoo3.plots.plot_from_file", "plot_from_file"),
    "push_to_hub": ("sb3_chdp.hub.push", "main"),
    "load_from_hub": ("sb3_chdp.hub.load", "main"),
}
COMMANDS = (*SCRIPTS, "benchmark")
# Scripts that import the modules of --gym-packages themselves, and note them among a run's arguments
IMPORTERS = ("train", "optimize", "enjoy")
# Scripts that play a model, and those that load one
PLAYERS = ("enjoy", "record", "push_to_hub")
LOADERS = ("train", *PLAYERS)
# Environment variables of which Linux has one where a window can be shown
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
# What rl_zoo3 2.9.2 imports, declared by it or not
REQUIRED = ("rl_zoo3", "requests", "pandas", "tensorboard")
BENCHMARK_REQUIRED = (*REQUIRED, "rliable", "submitit", "filelock")


def prepare_arguments(command: str, arguments: list[str]) -> list[str]:
    """
    :param command: a key of ``SCRIPTS``
    :param arguments: what the user wrote behind it
    :return: the arguments for rl_zoo3's script
    :raises ArgumentsError: if the command does not work with them
    """
    if HELP & set(arguments):
        return arguments
    if command in READERS:
        arguments = complete(command, arguments)
    for name in ALGORITHMS:
        if any(argument.rpartition("=")[2] == STOCK + name for argument in arguments):
            raise ArgumentsError(f"{STOCK}{name}: {name} is of this package, leave out {STOCK}")
    check_hyperparams(arguments)
    config = option(arguments, "-conf", "--conf-file")
    if config is not None and config.endswith(".yml") and not os.path.isfile(config):
        raise ArgumentsError(f"-conf: there is no file {config}")
    arguments = [argument.removeprefix(STOCK).replace(f"={STOCK}", "=", 1) for argument in arguments]
    if command in ("plot", "all_plots"):
        # The scripts that read folders do not know how rl_zoo3 names that of an id with a slash
        arguments = with_folder_names(arguments)
    algo_names = READERS[command].algo if command in READERS else ("--algo",)
    if command != "plot_from_file" and option(arguments, *algo_names) is None:
        arguments = [algo_names[0], next(iter(ALGORITHMS)), *arguments]
    if command == "optimize" and not {"-optimize", "--optimize-hyperparameters"} & set(arguments):
        arguments = [*arguments, "--optimize-hyperparameters"]
    algorithm = ALGORITHMS.get(option(arguments, "--algo") or "")
    if command == "optimize" and algorithm is not None and algorithm.tuning is None:
        raise ArgumentsError(f"{algorithm.name} has no Optuna sampler and cannot be tuned")
    if command in ("train", "optimize") and algorithm is not None:
        # In front, so that a -conf of the user wins; rl_zoo3 has the files of its own algorithms
        arguments = ["-conf", str(algorithm.hyperparams), *arguments]
    return arguments


def run_script(command: str, arguments: list[str]) -> None:
    """
    Run a script of rl_zoo3, or of this package, as the process's own.

    :param command: a key of ``SCRIPTS``
    :param arguments: what the user wrote behind it
    :raises ArgumentsError: if the command does not work with them
    """
    from sb3_chdp.zoo import play_with_masks, register, trust_own_runs

    register()
    if command in LOADERS:
        trust_own_runs()
    if command in PLAYERS:
        play_with_masks()
    others, packages = split_option(arguments, "--gym-packages")
    import_packages(packages)
    if command not in IMPORTERS:
        arguments = others
    if command == "train":
        from sb3_chdp.zoo_resume import prepare_training

        # The arguments of a run that goes on are its own
        resumed = any(argument.partition("=")[0] == "--resume" for argument in arguments)
        arguments = prepare_training(arguments if resumed else prepare_arguments(command, arguments))
        import_packages(split_option(arguments, "--gym-packages")[1])
    else:
        arguments = prepare_arguments(command, arguments)
    if command in ("plot", "all_plots"):
        from sb3_chdp.zoo_plots import show_as, take_output, tell_runs_apart

        arguments, picture = take_output(command, arguments)
        if not ({"--no-display"} | HELP) & set(arguments):
            show_as(picture)
    elif command != "plot_from_file" and not HELP & set(arguments):
        check_env(option(arguments, "--env"))
        if command == "record" or (command == "push_to_hub" and "--no-render" not in arguments):
            check_renders(option(arguments, "--env") or "")
    if command == "enjoy" and not {"--no-render", *HELP} & set(arguments) and not has_display():
        raise ArgumentsError("there is no display to show it on; --no-render gives numbers, sb3-chdp record a video")
    if command == "record":
        from stable_baselines3.common import vec_env

        from sb3_chdp.envs.recorder import FrameVideoRecorder

        vars(vec_env).update(VecVideoRecorder=FrameVideoRecorder)
    sys.argv = [f"sb3-chdp {command}", *arguments]
    module, function = SCRIPTS[command]
    if command in ("plot", "all_plots"):
        tell_runs_apart(importlib.import_module(module))
    if function is None:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    else:
        getattr(importlib.import_module(module), function)()


def has_display() -> bool:
    """:return: whether a window can be shown; SDL's dummy counts as one"""
    return sys.platform != "linux" or any(os.environ.get(name) for name in DISPLAYS)


def main() -> None:
    """Entry point of ``sb3-chdp`` and ``python -m sb3_chdp``."""
    if len(sys.argv) < 2 or sys.argv[1] in HELP:
        print(__doc__.replace("``", "").strip())
        return
    if sys.argv[1] == "--version":
        print(f"sb3_chdp {__version__}")
        return
    command, arguments = sys.argv[1], sys.argv[2:]
    if command not in COMMANDS:
        hint = f"known are {', '.join(COMMANDS)}"
        sys.exit(f"sb3-chdp: {unknown('command', command, COMMANDS, hint)}")
    required = BENCHMARK_REQUIRED if command == "benchmark" else REQUIRED
    missing = [name for name in required if importlib.util.find_spec(name) is None]
    if missing:
        sys.exit(f"sb3-chdp {command} needs {', '.join(missing)}: pip install '.[zoo]' in a clone of this package")
    # As python -m does: --gym-packages finds modules of the folder in which the user is
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        if command == "benchmark":
            from sb3_chdp.benchmark.cli import main as benchmark

            sys.exit(benchmark(arguments))
        run_script(command, arguments)
    except ArgumentsError as error:
        sys.exit(f"sb3-chdp {command}: {error}")


if __name__ == "__main__":
    main()
