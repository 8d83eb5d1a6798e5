"""Registration with rl_zoo3. Importing this module imports rl_zoo3, which patches Gymnasium."""

from pathlib import Path

from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS

from sb3_chdp.chdp import CHDP
from sb3_chdp.samplers import convert_chdp_params, sample_chdp_params

HYPERPARAMS_FOLDER = Path(__file__).parent / "hyperparams"


def register() -> None:
    """Make the algorithms of this package known to every script of rl_zoo3, in this process."""
    ALGOS["chdp"] = CHDP
    HYPERPARAMS_SAMPLER["chdp"] = sample_chdp_params
    HYPERPARAMS_CONVERTER["chdp"] = convert_chdp_params
