from pathlib import Path

from sb3_chdp import envs  # registers the environments
from sb3_chdp.chdp import CHDP
from sb3_chdp.common.spaces import HybridActionSpec
from sb3_chdp.env_checker import check_hybrid_env
from sb3_chdp.hhqn_td3 import HHQNTD3
from sb3_chdp.hppo import HPPO
from sb3_chdp.hyar_td3 import HyARTD3
from sb3_chdp.pa_td3 import PATD3
from sb3_chdp.pdqn_td3 import PDQNTD3
from sb3_chdp.wrappers import FlattenHybridAction

__version__ = Path(__file__).with_name("version.txt").read_text().strip()

__all__ = [
    "CHDP",
    "HHQNTD3",
    "HPPO",
    "PATD3",
    "PDQNTD3",
    "FlattenHybridAction",
    "HyARTD3",
    "HybridActionSpec",
    "check_hybrid_env",
    "envs",
]
