from sb3_chdp.chdp.chdp import CHDP
from sb3_chdp.chdp.paper import PaperCHDP
from sb3_chdp.chdp.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__all__ = ["CHDP", "CnnPolicy", "MlpPolicy", "MultiInputPolicy", "PaperCHDP"]
