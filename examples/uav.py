"""pyRDDLGym's UAV_Mixed: accelerate by -1, 0 or 1, and turn an aircraft, to a point in space."""

import pyRDDLGym
from compare import compare
from gymnasium.wrappers import FlattenObservation

from sb3_chdp import ScalarBoxes


def do_nothing(env):
    return {name: 0 if "acc" in name else [0.0] for name in env.action_space}


if __name__ == "__main__":
    # The simulator wants numbers where its space has boxes of one element, and its observations are numbers by name
    env = FlattenObservation(ScalarBoxes(pyRDDLGym.make("UAV_Mixed", "0")))
    compare(env, do_nothing, n_timesteps=20_000, name="uav")
