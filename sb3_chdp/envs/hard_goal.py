"""Hard Goal: Goal with eleven actions (Li et al., 2022)."""

import numpy as np

from sb3_chdp.envs.goal import GOAL_HALF_WIDTH, KICK_TO, PARAMETER_BOUNDS, SHOOT_LEFT, SHOOT_RIGHT, GoalEnv

# The bound with which the original scales the height of a shot
FLOAT32_GOAL_HALF_WIDTH = float(np.float32(GOAL_HALF_WIDTH))


class HardGoalEnv(GoalEnv):
    """
    Goal with ten shoot actions, each aiming at one of five segments of the goal mouth (twice the same five).

    ## Action space
    `Tuple(Discrete(11), Tuple(Box([0, -15], [40, 15]), Box(-1, 1), ..., Box(-1, 1)))`: 0 is Goal's kick-to; 1 to 5 and 6 to
    10 shoot, the parameter moves the aim within the action's segment, from its upper end at -1 to its lower end at 1.

    ## Arguments
    `fixed_intervals=True` makes the third segment [-0.2, 0.2] of the mouth. By default it is the single point 0.2, as in
    all published scripts, so that actions 3 and 8 ignore their parameter.

    ## Source
    Li et al. (2022), "HyAR: Addressing Discrete-Continuous Action RL via Hybrid Action Representation". All else is Goal's.
    """

    def __init__(self, fixed_intervals: bool = False, noise: bool = True, render_mode: str | None = None):
        super().__init__(noise, render_mode)
        self._set_action_space([list(PARAMETER_BOUNDS[KICK_TO])] + [[(-1.0, 1.0)]] * 10)
        middle = (-0.2, 0.2) if fixed_intervals else (0.2, 0.2)
        self.intervals = ((-1.0, -0.6), (-0.6, -0.2), middle, (0.2, 0.6), (0.6, 1.0))

    def _to_goal_action(self, k: int, parameters: list[float]) -> tuple[int, list[float]]:
        if k == KICK_TO:
            return KICK_TO, parameters
        low, high = self.intervals[(k - 1) % 5]
        scaled = (low + high) / 2 - parameters[0] * (high - low) / 2
        return (SHOOT_LEFT if k <= 5 else SHOOT_RIGHT), [FLOAT32_GOAL_HALF_WIDTH * scaled]
