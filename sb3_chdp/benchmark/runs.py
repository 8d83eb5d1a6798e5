"""What a run is: one algorithm on one environment with one seed, and where its files lie."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from sb3_chdp.benchmark.results import ResultsError, Row, differences, read_meta, read_rows
from sb3_chdp.registry import ALGORITHMS
from sb3_chdp.zoo_arguments import STOCK

# Evaluations of a run, evenly spaced
N_EVALUATIONS = 30


def file_name(name: str) -> str:
    """:return: a name of an algorithm or environment as the name of a folder"""
    return name.replace(":", "_").replace("/", "-")


def display_name(row: str) -> str:
    """:return: the name of a row in tables and figures"""
    if row in ALGORITHMS:
        return ALGORITHMS[row].display_name
    return f"{row.removeprefix(STOCK).upper()}, flattened" if row.startswith(STOCK) else row.replace("_", " ")


@dataclass(frozen=True)
class Run:
    """
    :param name: row of the table: the algorithm, or the name of a variant of it
    :param algo: name of an algorithm, ``sb3:NAME`` for SB3's own behind :class:`FlattenHybridAction`
    :param env_id: environment
    :param seed: seed of the model and of the training environments
    :param out: folder of the results
    :param overrides: hyperparameters that differ from the YAML file; ``n_timesteps`` is one
    :param conf_folder: folder with YAML files of the user's own, ``<algorithm>.yml``
    :param gym_packages: modules that register environments
    :param eval_episodes: episodes of an evaluation
    :param eval_freq: environment steps between two evaluations, a thirtieth of the training if None
    :param threads: threads of PyTorch
    :param checkpoint_interval: wall-clock seconds between two checkpoints
    """

    name: str
    algo: str
    env_id: str
    seed: int
    out: str
    overrides: dict[str, Any] = field(default_factory=dict)
    conf_folder: str | None = None
    gym_packages: tuple[str, ...] = ()
    eval_episodes: int = 20
    eval_freq: int | None = None
    threads: int = 1
    checkpoint_interval: float = 180.0

    @property
    def folder(self) -> Path:
        """:return: what belongs to this run alone: rl_zoo3's log folder, checkpoint, lock"""
        return Path(self.out) / file_name(self.name) / file_name(self.env_id) / f"seed_{self.seed}"

    @property
    def csv(self) -> Path:
        """:return: its evaluations"""
        return self.folder.with_suffix(".csv")

    @property
    def json(self) -> Path:
        """:return: its settings, there once it is finished"""
        return self.folder.with_suffix(".json")

    @property
    def started(self) -> Path:
        """:return: its settings while it is not finished"""
        return self.folder / "started.json"

    @property
    def checkpoints(self) -> Path:
        """:return: folder of its checkpoints while it is not finished"""
        return self.folder / "checkpoints"

    @property
    def is_complete(self) -> bool:
        """:return: whether it is finished"""
        return self.json.exists()

    def rows(self) -> list[Row]:
        """:return: its evaluations so far"""
        return read_rows(self.csv) if self.csv.exists() else []

    def evaluation_step(self, index: int, n_timesteps: int) -> int:
        """
        :return: environment step of an evaluation, counted from 1; without ``eval_freq`` the last one is at the end of the
            training
        """
        return index * self.eval_freq if self.eval_freq else max(index * n_timesteps // N_EVALUATIONS, index)

    def description(self) -> dict[str, Any]:
        """:return: what the JSON says about it, without where it was trained"""
        described = asdict(self)
        for key in ("out", "gym_packages", "conf_folder", "checkpoint_interval"):
            del described[key]
        return described

    def check_settings(self, settings: dict[str, Any]) -> None:
        """
        :param settings: hyperparameters that it would be trained with now
        :raises ResultsError: if it was started with others
        """
        path = self.json if self.is_complete else self.started
        if not path.exists():
            return
        before = read_meta(path)
        changed = differences(before["settings"], settings)
        changed += differences(
            *({key: of.get(key) for key in ("eval_freq", "eval_episodes")} for of in (before, asdict(self)))
        )
        if changed:
            raise ResultsError(
                f"{self.folder} was started with other settings ({', '.join(changed)}): go on with the former ones, take"
                " another --out, or train it anew with --restart"
            )
