from sb3_chdp.hppo.hppo import HPPO
from sb3_chdp.hppo.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["HPPO", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
