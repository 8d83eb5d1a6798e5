from sb3_chdp.pdqn_td3.pdqn_td3 import PDQNTD3
from sb3_chdp.pdqn_td3.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["PDQNTD3", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
