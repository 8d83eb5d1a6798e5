"""
The algorithms of this package: one line each, which everything else reads (command line, rl_zoo3, benchmark, tests, docs).

Nothing is imported before it is used: the package works without rl_zoo3 and Optuna.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

# Of the algorithms without a file of their own
DEFAULT_HYPERPARAMS = "default.yml"
HYPERPARAMS_FOLDER = Path(__file__).parent / "hyperparams"


@dataclass(frozen=True)
class Algorithm:
    """
    :param name: name for ``--algo``, and of the file in ``hyperparams`` if there is one
    :param display_name: name in tables and figures
    :param class_path: module and name of the class, with a dot between them
    :param tuning: module with the Optuna sampler ``sample_params`` and the converter of its trials ``convert_params``,
        both in the form that rl_zoo3 expects; an algorithm without one cannot be tuned
    """

    name: str
    display_name: str
    class_path: str
    tuning: str | None = None

    @property
    def class_name(self) -> str:
        """:return: name of the class, as in ``from sb3_chdp import NAME``"""
        return self.class_path.rpartition(".")[2]

    def load_class(self) -> type[Any]:
        """:return: the class"""
        module, _, name = self.class_path.rpartition(".")
        loaded: type[Any] = getattr(import_module(module), name)
        return loaded

    def load_tuning(self) -> tuple[Callable[..., dict[str, Any]], Callable[..., dict[str, Any]]] | None:
        """:return: sampler and converter, None for an algorithm without them"""
        if self.tuning is None:
            return None
        module = import_module(self.tuning)
        return module.sample_params, module.convert_params

    @property
    def hyperparams(self) -> Path:
        """:return: YAML file of the hyperparameters"""
        own = HYPERPARAMS_FOLDER / f"{self.name}.yml"
        return own if own.is_file() else HYPERPARAMS_FOLDER / DEFAULT_HYPERPARAMS


_LINES = (
    Algorithm("chdp", "CHDP", "sb3_chdp.chdp.CHDP", "sb3_chdp.chdp.tuning"),
    Algorithm("chdp_paper", "CHDP as published", "sb3_chdp.chdp.PaperCHDP"),
    Algorithm("hppo", "HPPO", "sb3_chdp.hppo.HPPO", "sb3_chdp.hppo.tuning"),
    Algorithm("pa_td3", "PA-TD3", "sb3_chdp.pa_td3.PATD3", "sb3_chdp.common.td3_tuning"),
    Algorithm("pdqn_td3", "PDQN-TD3", "sb3_chdp.pdqn_td3.PDQNTD3", "sb3_chdp.pdqn_td3.tuning"),
    Algorithm("hhqn_td3", "HHQN-TD3", "sb3_chdp.hhqn_td3.HHQNTD3", "sb3_chdp.common.td3_tuning"),
    Algorithm("hyar_td3", "HyAR-TD3", "sb3_chdp.hyar_td3.HyARTD3", "sb3_chdp.hyar_td3.tuning"),
)
ALGORITHMS = {algorithm.name: algorithm for algorithm in _LINES}
"""Name to algorithm, in the order of tables and figures"""
