"""Registration with rl_zoo3. Importing this module imports rl_zoo3, which patches Gymnasium."""

from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS

from sb3_chdp.registry import ALGORITHMS


def register() -> None:
    """Make the algorithms of this package known to every script of rl_zoo3, in this process."""
    for name, algorithm in ALGORITHMS.items():
        ALGOS[name] = algorithm.load_class()
        tuning = algorithm.load_tuning()
        if tuning is not None:
            HYPERPARAMS_SAMPLER[name], HYPERPARAMS_CONVERTER[name] = tuning
