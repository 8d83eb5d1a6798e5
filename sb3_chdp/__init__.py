from pathlib import Path
from typing import Any

from sb3_chdp import envs  # registers the environments
from sb3_chdp.common.spaces import HybridActionSpec
from sb3_chdp.env_checker import check_hybrid_env
from sb3_chdp.registry import ALGORITHMS
from sb3_chdp.wrappers import FlattenHybridAction, ScalarBoxes

__version__ = Path(__file__).with_name("version.txt").read_text().strip()

_ALGORITHMS = {algorithm.class_name: algorithm for algorithm in ALGORITHMS.values()}

__all__ = ["ALGORITHMS", "FlattenHybridAction", "HybridActionSpec", "ScalarBoxes", "check_hybrid_env", "envs"]
__all__ += list(_ALGORITHMS)


# The classes of the algorithms. Type checkers see them where they are written: from sb3_chdp.chdp import CHDP
def __getattr__(name: str) -> Any:
    if name not in _ALGORITHMS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = _ALGORITHMS[name].load_class()
    return globals()[name]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
