"""Catch Point: steer a point mass to a target and catch it (Fan et al., 2019)."""

from math import cos, pi, sin
from typing import TYPE_CHECKING, Any

from sb3_chdp.envs.point_mass import BONUS, CAPTURE_DISTANCE_SQUARED, FORCE, Point, PointMassEnv

if TYPE_CHECKING:
    from sb3_chdp.envs.rendering import Canvas

MOVE, CATCH = 0, 1
MISSES_ALLOWED = 11


class CatchPointEnv(PointMassEnv):
    """
    Steer a point mass to a target and catch it there. The step after the eleventh catch that misses ends the episode.

    The mass is 1, the damping 0.25, a step is a frame of 0.1 seconds. Transitions have no noise.

    ## Action space

    `Tuple(Discrete(2), Tuple(Box(-1, 1), Box(shape=(0,))))`

    | k | action | parameter | range |
    |---|---|---|---|
    | 0 | move: push with force 2 | direction in half turns, from +y towards +x | -1 to 1 |
    | 1 | catch: glide, and catch within 0.2 | none | |

    ## Observation space

    `Box(-inf, inf, (4,))`

    | index | quantity |
    |---|---|
    | 0, 1 | velocity x, y |
    | 2, 3 | target minus position x, y |

    ## Rewards

    Minus the squared distance to the target; 20 more for a catch. 0 on the step on which the misses end the episode.

    ## Starting state

    Agent at rest and target, both uniform in [-1, 1]^2.

    ## Episode end

    Termination: a catch (`info["outcome"]` is "catch", success), or the step after the eleventh miss ("misses").
    Truncation: 25 steps.

    ## Arguments

    | argument | default | meaning |
    |---|---|---|
    | `start` | None | (x, y) at which the agent starts; None draws it |
    | `target` | None | (x, y) of the target; None draws it |
    | `noise` | True | without effect, nothing is random but the start |
    | `render_mode` | None | None, "human" or "rgb_array" |

    ## Reset options

    | key | meaning | accepted |
    |---|---|---|
    | `start` | (x, y) at which the agent starts | two finite numbers |
    | `target` | (x, y) of the target | two finite numbers |

    ## Version history

    * v0: transitions equal those of the HyAR repository's version.

    ## Source

    Fan et al. (2019), "Hybrid Actor-Critic Reinforcement Learning in Parameterized Action Space".
    """

    success_outcome = "catch"
    action_names = ("move", "catch")

    def __init__(
        self, start: Point | None = None, target: Point | None = None, noise: bool = True, render_mode: str | None = None
    ):
        super().__init__(start, target, noise, render_mode)
        self._set_action_space([[(-1.0, 1.0)], []])
        self.misses = 0

    def _start(self, options: dict[str, Any]) -> None:
        super()._start(options)
        self.misses = 0

    def _advance(self, k: int, parameters: list[float]) -> tuple[float, str, int]:
        if k == MOVE:
            angle = pi * parameters[0]
            distance_squared = self._push(FORCE * sin(angle), FORCE * cos(angle))
        else:
            distance_squared = self._push(0.0, 0.0)
        if self.misses >= MISSES_ALLOWED:
            return self._result(0.0, "misses")
        if k == CATCH and distance_squared <= CAPTURE_DISTANCE_SQUARED:
            return self._result(BONUS - distance_squared, "catch")
        self.misses += k == CATCH
        return self._result(-distance_squared, "")

    def _simulator_state(self) -> dict[str, float]:
        return {**super()._simulator_state(), "misses": self.misses}

    def _set_simulator_state(self, state: dict[str, float]) -> None:
        super()._set_simulator_state(state)
        self.misses = int(state["misses"])

    def _draw(self, canvas: "Canvas") -> None:
        super()._draw(canvas)
        canvas.text(self._action_text(), (20, 92))
        canvas.text(f"misses {self.misses} of {MISSES_ALLOWED}", (20, 30))
        from sb3_chdp.envs.rendering import GREY, ORANGE

        for miss in range(MISSES_ALLOWED):
            canvas.disc((160 + 18 * miss, 30), 6, ORANGE if miss < self.misses else GREY)
