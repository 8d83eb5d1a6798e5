"""Hard Goal: Goal with eleven actions (Li et al., 2022)."""

import numpy as np

from sb3_chdp.envs.goal import KICK_TO, PARAMETER_BOUNDS, SHOOT_LEFT, SHOOT_RIGHT, GoalEnv
from sb3_chdp.envs.soccer import GOAL_HALF_WIDTH

# The bound with which the original scales the height of a shot
FLOAT32_GOAL_HALF_WIDTH = float(np.float32(GOAL_HALF_WIDTH))


class HardGoalEnv(GoalEnv):
    """
    Goal with ten shoot actions, each aiming at one of five segments of the goal mouth (twice the same five).

    What is not said here is as in [Goal](goal.md).

    ## Action space

    `Tuple(Discrete(11), Tuple(Box([0, -15], [40, 15]), Box(-1, 1), ..., Box(-1, 1)))`

    | k | action | parameter | range |
    |---|---|---|---|
    | 0 | Goal's kick-to | see there | 0 to 40, -15 to 15 |
    | 1 to 5 | shoot at segment k | where in it: -1 is its upper end, 1 its lower end | -1 to 1 |
    | 6 to 10 | shoot at segment k - 5 | the same | -1 to 1 |

    In units of the mouth's half width of 7.01 the segments are [-1, -0.6], [-0.6, -0.2], the point 0.2, [0.2, 0.6] and
    [0.6, 1]. The third is a point, as in all published scripts, so that actions 3 and 8 ignore their parameter.

    ## Arguments

    | argument | default | meaning |
    |---|---|---|
    | `fixed_intervals` | False | True makes the third segment [-0.2, 0.2] |
    | `noise` | True | False silences all perturbations inside a transition |
    | `render_mode` | None | None, "human" or "rgb_array" |

    ## Version history

    * v0: transitions equal those of the HyAR repository's version.

    ## Source

    Li et al. (2022), "HyAR: Addressing Discrete-Continuous Action RL via Hybrid Action Representation".
    """

    action_names = ("kick-to", *(f"shoot at {(k - 1) % 5 + 1}:" for k in range(1, 11)))

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
