from sb3_chdp.pa_td3.pa_td3 import PATD3
from sb3_chdp.pa_td3.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["PATD3", "CnnPolicy", "MlpPolicy", "MultiInputPolicy"]
