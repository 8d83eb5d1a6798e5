"""Registration with rl_zoo3. Importing this module imports rl_zoo3, which patches Gymnasium."""

from pathlib import Path

from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS

from sb3_chdp.chdp import CHDP
from sb3_chdp.hhqn_td3 import HHQNTD3
from sb3_chdp.pa_td3 import PATD3
from sb3_chdp.samplers import (
    convert_chdp_params,
    convert_score_td3_params,
    sample_chdp_params,
    sample_score_td3_params,
)

HYPERPARAMS_FOLDER = Path(__file__).parent / "hyperparams"


def register() -> None:
    """Make the algorithms of this package known to every script of rl_zoo3, in this process."""
    for name, algorithm, sampler, converter in (
        ("chdp", CHDP, sample_chdp_params, convert_chdp_params),
        ("pa_td3", PATD3, sample_score_td3_params, convert_score_td3_params),
        ("hhqn_td3", HHQNTD3, sample_score_td3_params, convert_score_td3_params),
    ):
        ALGOS[name] = algorithm
        HYPERPARAMS_SAMPLER[name] = sampler
        HYPERPARAMS_CONVERTER[name] = converter
