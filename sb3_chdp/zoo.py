"""Registration with rl_zoo3. Importing this module imports rl_zoo3, which patches Gymnasium."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import rl_zoo3.exp_manager
from rl_zoo3.hyperparams_opt import (
    HYPERPARAMS_CONVERTER,
    HYPERPARAMS_SAMPLER,
    convert_onpolicy_params,
    sample_ppo_params,
)
from rl_zoo3.utils import ALGOS

import sb3_chdp
from sb3_chdp import CHDP, HHQNTD3, HPPO, PATD3, PDQNTD3, HyARTD3, samplers

HYPERPARAMS_FOLDER = Path(__file__).parent / "hyperparams"


TD3_CONVERTER = samplers.convert_hybrid_td3_params
# Name for --algo: class, Optuna sampler, converter of its trials
ZOO: dict[str, tuple[type, Callable[..., dict[str, Any]], Callable[..., dict[str, Any]]]] = {
    "chdp": (CHDP, samplers.sample_chdp_params, samplers.convert_chdp_params),
    "hppo": (HPPO, sample_ppo_params, convert_onpolicy_params),
    "pa_td3": (PATD3, samplers.sample_hybrid_td3_params, TD3_CONVERTER),
    "pdqn_td3": (PDQNTD3, samplers.sample_pdqn_td3_params, TD3_CONVERTER),
    "hhqn_td3": (HHQNTD3, samplers.sample_hybrid_td3_params, TD3_CONVERTER),
    "hyar_td3": (HyARTD3, samplers.sample_hyar_td3_params, TD3_CONVERTER),
}


def register() -> None:
    """Make the algorithms of this package known to every script of rl_zoo3, in this process."""
    for name, (algorithm, sampler, converter) in ZOO.items():
        ALGOS[name] = algorithm
        HYPERPARAMS_SAMPLER[name] = sampler
        HYPERPARAMS_CONVERTER[name] = converter
    # rl_zoo3 evaluates replay_buffer_class and the like among its own imports: YAML files may name classes of this package
    rl_zoo3.exp_manager.sb3_chdp = sb3_chdp  # type: ignore[attr-defined]
