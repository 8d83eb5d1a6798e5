"""rl_zoo3's plots as a picture, on machines without a display too."""

import os
import warnings
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import ClassVar

import matplotlib
from matplotlib import pyplot as plt
from matplotlib.backend_bases import FigureCanvasBase

from sb3_chdp.zoo_arguments import ArgumentsError, option, split_option

OUTPUT = ("-o", "--output")
# What all_plots calls its figures
RESULTS = "Results "
NO_EVALUATIONS = "the runs have no evaluations; train with --eval-freq"
NO_EPISODES = "perhaps fewer episodes than -w, 100 by default"
HEADLESS = matplotlib.get_backend().lower() == "agg"


def take_output(command: str, arguments: list[str]) -> tuple[list[str], Path | None]:
    """
    :param command: ``plot`` or ``all_plots``
    :param arguments: what the user wrote
    :return: arguments for rl_zoo3's script, and the picture that ``-o`` names
    :raises ArgumentsError: for a file that is no picture
    """
    output = option(arguments, *OUTPUT)
    if output is None:
        return arguments, None
    kinds = FigureCanvasBase.get_supported_filetypes()
    if Path(output).suffix[1:] not in kinds:
        if command == "all_plots":
            # A table of numbers for plot_from_file
            return [*arguments, "--no-display"] if HEADLESS else arguments, None
        raise ArgumentsError(f"-o {output}: the name of a picture ends in {', '.join(f'.{kind}' for kind in sorted(kinds))}")
    for name in OUTPUT:
        arguments, _ = split_option(arguments, name)
    matplotlib.use("Agg")
    return arguments, Path(output)


class _Run(str):
    """Name of a run's folder. rl_zoo3 looks for the environment in it: that of Goal-v0 is not a part of HardGoal-v0."""

    is_exact: ClassVar[set[str]]

    def __contains__(self, env: object) -> bool:
        return self.rpartition("_")[0] == env if env in self.is_exact else super().__contains__(str(env))


def tell_runs_apart(module: ModuleType) -> None:
    """
    Let a script of rl_zoo3 find the runs of the environments that are named, and no others, if there are any.

    :param module: the script, which lists folders with ``os.listdir`` or ``os.scandir``
    """

    def runs(names: list[str]) -> list[str]:
        exact = type("Run", (_Run,), {"is_exact": {name.rpartition("_")[0] for name in names}})
        return [exact(name) for name in names]

    def listdir(path: str) -> list[str]:
        return runs(os.listdir(path))

    def scandir(path: str) -> list[SimpleNamespace]:
        entries = list(os.scandir(path))
        names = runs([entry.name for entry in entries])
        return [
            SimpleNamespace(name=n, path=e.path, stat=e.stat, is_dir=e.is_dir) for n, e in zip(names, entries, strict=True)
        ]

    vars(module).update(os=SimpleNamespace(path=os.path, listdir=listdir, scandir=scandir))


def show_as(path: Path | None) -> None:
    """
    Have ``plt.show`` write all figures: into the file itself, or several beside it, with their names.

    :param path: the picture; None shows them as ever
    :raises ArgumentsError: without a picture and without a display
    """
    if path is None:
        if HEADLESS:
            raise ArgumentsError("there is no display to show it on; -o FILE.png writes it into a file")
        return

    def save() -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        labels = plt.get_figlabels()
        for label in labels:
            figure = plt.figure(label)
            if not any(axes.lines for axes in figure.axes):
                reason = NO_EVALUATIONS if label.startswith(RESULTS) else NO_EPISODES
                raise ArgumentsError(f"{label}: nothing to plot, {reason}")
            name = label.removeprefix(RESULTS).replace("/", "-")
            picture = path if len(labels) == 1 else path.with_stem(f"{path.stem}-{name}")
            figure.savefig(picture)
            print(f"Saving to {picture}")

    warnings.filterwarnings("ignore", "No artists with labels")
    vars(plt).update(show=save)
