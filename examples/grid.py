"""grid2op's case14: switch a line, rearrange a substation, and set what six generators give, every five minutes."""

import grid2op
import numpy as np
from compare import compare
from grid2op.gym_compat import BoxGymActSpace, BoxGymObsSpace, GymEnv, MultiDiscreteActSpace
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from lightsim2grid import LightSimBackend

OBSERVED = ["rho", "gen_p", "load_p", "line_status", "topo_vect", "time_before_cooldown_line", "time_before_cooldown_sub"]


class Operations(spaces.Dict):
    """What the rules allow at a time, one line and one substation, and 7,339 combinations of them; the rest is numbers."""

    def __init__(self, actions):
        super().__init__(
            switch=MultiDiscreteActSpace(actions, attr_to_keep=["one_line_set", "one_sub_set"]),
            generators=BoxGymActSpace(actions, attr_to_keep=["curtail", "redispatch"]),
        )

    def from_gym(self, action):
        return self["switch"].from_gym(action["switch"]) + self["generators"].from_gym(action["generators"])

    def close(self):  # of GymEnv
        pass


def do_nothing(env):
    # Curtailment of 1 lets a generator give all that it has
    return {"switch": np.zeros(2, np.int64), "generators": np.array([1, 1, 1, 0, 0, 0], np.float32)}


if __name__ == "__main__":
    grid = grid2op.make("l2rpn_case14_sandbox", test=True, backend=LightSimBackend())
    env = GymEnv(grid)
    env.observation_space = BoxGymObsSpace(grid.observation_space, attr_to_keep=OBSERVED)
    env.action_space = Operations(grid.action_space)
    compare(TimeLimit(env, 100), do_nothing, n_timesteps=20_000, name="grid")
