"""hybrid-shoot: jam one of three enemies and shoot at a place, five times."""

import numpy as np
from compare import compare
from hybrid_shoot import HybridShootEnv


def shoot_at_the_centre(env):
    return 0, np.full(2, env.unwrapped.map_size / 2)


if __name__ == "__main__":
    compare(HybridShootEnv(), shoot_at_the_centre, n_timesteps=30_000, name="shoot")
