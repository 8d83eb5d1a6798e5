from pathlib import Path

import sb3_chdp.envs
