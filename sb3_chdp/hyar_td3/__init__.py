from sb3_chdp.hyar_td3.hyar_td3 import HyARTD3
from sb3_chdp.hyar_td3.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["CnnPolicy", "HyARTD3", "MlpPolicy", "MultiInputPolicy"]
