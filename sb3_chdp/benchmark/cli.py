"""
sb3-chdp benchmark: which algorithm is best on your environment?

    sb3-chdp benchmark --envs MyEnv-v0 --gym-packages my_package --algos chdp hppo sb3:sac --seeds 0 1 2 --steps 50000
    sb3-chdp benchmark paper              the published table, with its seeds, trained with today's code
    sb3-chdp benchmark report --out DIR   tables and figures of what is there, without training

Every algorithm is trained by rl_zoo3 with the settings of its YAML file. Tables and learning curves end up in --out. The same
command goes on where it was interrupted, and adds what is new: seeds, algorithms, environments.
"""

import argparse
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from rich.console import Console
from rich.live import Live
from rich.markup import escape

from sb3_chdp.benchmark import figures, jobs, paper, tables
from sb3_chdp.benchmark.overview import Overview
from sb3_chdp.benchmark.results import ResultsError, read_results
from sb3_chdp.benchmark.runs import Run
from sb3_chdp.benchmark.statistics import scores_of
from sb3_chdp.registry import ALGORITHMS
from sb3_chdp.zoo_arguments import STOCK, ArgumentsError, check_hyperparams, import_packages, unknown

SLURM = "--slurm-"


def make_parser() -> argparse.ArgumentParser:
    """:return: the parser of the command line"""
    from rl_zoo3.utils import StoreDict

    parser = argparse.ArgumentParser(
        prog="sb3-chdp benchmark", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add = parser.add_argument
    add("what", nargs="?", choices=["run", "paper", "report"], default="run", help=argparse.SUPPRESS)
    add("--envs", nargs="+", metavar="ENV", help="environments")
    add("--algos", nargs="+", metavar="ALGO", help=f"{', '.join(ALGORITHMS)}, or sb3:NAME for SB3's own on flat actions")
    add("--seeds", nargs="+", type=int, help="a run each (default: 0 1 2)")
    add("--steps", type=int, help="environment steps of a run (default: those of the YAML files)")
    add("--gym-packages", nargs="+", default=[], help="modules that register environments")
    add("--out", type=Path, help="folder of results (default: logs/benchmark, logs/paper)")
    add("--jobs", type=int, help="runs at a time (default: 1, with Slurm as many as it allows)")
    add("-params", "--hyperparams", nargs="+", action=StoreDict, default={}, help="override hyperparameters, as in train")
    add("--conf-folder", help="folder with YAML files of your own, <algorithm>.yml, for the algorithms that have one there")
    add("--eval-episodes", type=int, help="episodes of each of the 30 evaluations of a run (default: 20; 100 with paper)")
    add("--checkpoint-interval", type=float, default=180, metavar="SECONDS", help="between two checkpoints (default: 180)")
    add("--restart", action="store_true", help="train anew the runs that were started with other settings")
    add("--cluster", choices=jobs.CLUSTERS, default="local", help="processes of this machine, or jobs of Slurm")
    add("--threads", type=int, default=1, help="cores of a run (default: 1, fastest for small networks)")
    add("--gpus", type=int, default=0, help="GPUs of a run (default: 0)")
    parser.epilog = f"With --cluster slurm: {SLURM}partition, {SLURM}time (minutes), {SLURM}mem, ...: submitit's parameters"
    return parser


def parse(arguments: list[str]) -> tuple[argparse.Namespace, dict[str, Any]]:
    """
    :param arguments: command line
    :return: arguments, and parameters for submitit
    """
    parser = make_parser()
    rest, options = [], {}
    words = iter(arguments)
    for word in words:
        if not word.startswith(SLURM):
            rest.append(word)
            continue
        name, _, value = word.partition("=")
        options[name[2:].replace("-", "_")] = yaml.safe_load(value or next(words, ""))
    check_hyperparams(rest)
    args = parser.parse_args(rest)
    if options and args.cluster != "slurm":
        parser.error(f"{SLURM}... needs --cluster slurm")
    if args.what == "run" and not (args.envs and args.algos):
        parser.error("--envs and --algos say what to compare")
    if (args.jobs or 1) < 1 or (args.eval_episodes or 1) < 1:
        parser.error("--jobs and --eval-episodes must be at least 1")
    if args.conf_folder is not None and not list(Path(args.conf_folder).glob("*.yml")):
        parser.error(f"--conf-folder: there is no YAML file in {args.conf_folder}")
    args.out = args.out or Path("logs") / ("paper" if args.what == "paper" else "benchmark")
    check_names(parser, args)
    return args, options


def check_names(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Refuse algorithms and environments that nobody knows, with a hint."""
    from rl_zoo3.utils import ALGOS

    import_packages(args.gym_packages)
    known_algos = [*ALGORITHMS, *(STOCK + name for name in ALGOS)]
    for kind, names, known, hint in (
        ("algorithm", args.algos, known_algos, f"known are {', '.join(known_algos)}"),
        ("environment", args.envs, list(gym.registry), "--gym-packages names the module that registers it"),
    ):
        for name in names or []:
            if name not in known:
                parser.error(unknown(kind, name, known, hint))


def make_runs(args: argparse.Namespace) -> list[Run]:
    """:return: the runs that the command line asks for, seed by seed: the first comparison is there early"""
    common: dict[str, Any] = dict(
        conf_folder=args.conf_folder,
        gym_packages=tuple(args.gym_packages),
        threads=args.threads,
        checkpoint_interval=args.checkpoint_interval,
    )
    steps = {} if args.steps is None else {"n_timesteps": args.steps}
    overrides = {**args.hyperparams, **steps}
    evaluation: dict[str, Any] = {} if args.eval_episodes is None else {"eval_episodes": args.eval_episodes}
    if args.what == "paper":
        runs = paper.published_runs(str(args.out), **common)
        wanted = ((args.envs, "env_id"), (args.algos, "algo"), (args.seeds, "seed"))
        runs = [run for run in runs if all(not chosen or getattr(run, key) in chosen for chosen, key in wanted)]
        if not runs:
            raise ArgumentsError("no run of the published table has such an environment, algorithm and seed, see protocol.yml")
        # A shorter training may end before the first of the published evaluations
        changes: dict[str, Any] = {**evaluation, **({} if args.steps is None else {"eval_freq": None})}
        return [replace(run, overrides={**run.overrides, **overrides}, **changes) for run in runs]
    return [
        Run(algo, algo, env, seed, str(args.out), overrides=overrides, **evaluation, **common)
        for seed in (args.seeds or (0, 1, 2))
        for env in args.envs
        for algo in args.algos
    ]


def train_all(runs: list[Run], args: argparse.Namespace, options: dict[str, Any], console: Console) -> list[str]:
    """
    :param runs: what to train
    :param args: command line
    :param options: parameters for submitit
    :param console: where the overview is shown
    :return: a line per run that failed
    :raises ResultsError: if a run was started with other settings
    """
    from sb3_chdp.benchmark.manager import settings_of
    from sb3_chdp.benchmark.training import forget

    settings: dict[tuple[str, str], dict[str, str]] = {}
    for run in runs:
        # The settings are those of all seeds
        key = (run.name, run.env_id)
        settings[key] = settings.get(key) or settings_of(run)
        try:
            run.check_settings(settings[key])
        except ResultsError:
            if not args.restart:
                raise
            forget(run)
    steps = [int(float(settings[run.name, run.env_id]["n_timesteps"])) for run in runs]
    overview = Overview(runs, steps)
    unfinished = [run for run in runs if not run.is_complete]
    console.print(f"{len(runs)} runs, {len(runs) - len(unfinished)} of them finished before")
    if not unfinished:
        return []
    executor = jobs.make_executor(args.cluster, args.out / "jobs", args.threads, args.gpus, args.jobs, options)
    queue = jobs.Queue(unfinished, executor, args.cluster, args.jobs or 1)
    failures = []
    try:
        with Live(overview.table(), console=console, refresh_per_second=1) as live:
            while queue.waiting or queue.running:
                queue.submit()
                time.sleep(1)
                for run, line, failed in queue.collect():
                    # Messages have brackets that are no markup
                    live.console.print(f"[red]failed: {escape(line)}" if failed else escape(line), highlight=False)
                    if failed:
                        failures.append(line)
                        overview.failed.add(str(run.folder))
                live.update(overview.table())
    finally:
        queue.cancel()
    console.print()
    return failures


def write_report(
    out: Path, algos: list[str], columns: Mapping[str, tables.Column] | None = None, with_paper: bool = False
) -> str:
    """
    Write ``report.md`` and the figures.

    :param out: folder of results
    :param algos: algorithms to name first; the first is compared with the others
    :param columns: further columns of the table
    :param with_paper: show the paper's figures beside the scores
    :return: the tables
    """
    results = read_results(out)
    scores = scores_of(results)
    rows = tables.order(scores["row"], algos)
    envs = tables.order(scores["env"], [])
    text = tables.report(scores, rows, envs, columns)
    for x, name in (("timesteps", "curves_steps.png"), ("minutes", "curves_minutes.png")):
        figures.plot_curves(results, scores, rows, envs, x, out / name)
    figures.plot_scores(scores, rows, envs, out / "scores.png", paper.paper_mean if with_paper else None)
    alternatives = {"curves_steps": "Curves over steps", "curves_minutes": "Curves over minutes", "scores": "Scores"}
    pictures = "\n\n".join(f"![{alternative}]({name}.png)" for name, alternative in alternatives.items())
    (out / "report.md").write_text(f"{text}\n\n{pictures}\n")
    return text


def main(arguments: list[str]) -> int:
    """
    :param arguments: what stands behind ``sb3-chdp benchmark``
    :return: 0, or 1 if runs failed
    :raises ArgumentsError: for a module of ``--gym-packages`` or a run of the published table that there is not
    """
    args, options = parse(arguments)
    console = Console()
    failures: list[str] = []
    try:
        if args.what != "report":
            failures = train_all(make_runs(args), args, options, console)
        is_paper = args.what == "paper"
        columns = {"paper": paper.paper_column} if is_paper else None
        print(write_report(args.out, args.algos or list(ALGORITHMS), columns, is_paper))
        print(f"\nTables and figures: {args.out}/report.md")
    except ResultsError as error:
        print(f"sb3-chdp benchmark: {error}")
        return 1
    for line in failures:
        print(f"failed: {line}")
    return int(bool(failures))
