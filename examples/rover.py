"""pyRDDLGym's MarsRover_ippc2023: push two rovers to the minerals, and harvest them or not."""

import pyRDDLGym
from compare import compare
from gymnasium.wrappers import FlattenObservation

from sb3_chdp import ScalarBoxes


def do_nothing(env):
    return {name: 0 if "harvest" in name else [0.0] for name in env.action_space}


if __name__ == "__main__":
    # The simulator wants numbers where its space has boxes of one element, and its observations are numbers by name
    env = FlattenObservation(ScalarBoxes(pyRDDLGym.make("MarsRover_ippc2023", "1")))
    compare(env, do_nothing, n_timesteps=30_000, name="rover")
