from sb3_chdp.hhqn_td3.hhqn_td3 import HHQNTD3
from sb3_chdp.hhqn_td3.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["HHQNTD3", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
