"""Hard Move: a point mass with n actuators, of which every step switches on a subset (Li et al., 2022)."""

from functools import lru_cache
from math import cos, pi, sin
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from sb3_chdp.envs.point_mass import BONUS, CAPTURE_DISTANCE_SQUARED, FORCE, PANEL, Point, PointMassEnv

if TYPE_CHECKING:
    from sb3_chdp.envs.rendering import Canvas


def _directions(n_actuators: int) -> np.ndarray:
    """:return: (n, 2) unit vectors of the actuators, to three decimals"""
    angles = 2 * np.pi * np.arange(n_actuators) / n_actuators
    return np.round(np.stack([np.cos(angles), np.sin(angles)], axis=1), 3)


@lru_cache
def motion_table(n_actuators: int) -> np.ndarray:
    """
    :param n_actuators: number n of actuators
    :return: (2^n, 2) motion of every subset of actuators, the longest of length 1; actuator 0 is the highest bit
    """
    subsets = (np.arange(2**n_actuators)[:, None] >> np.arange(n_actuators)[::-1]) & 1
    motions = subsets @ _directions(n_actuators)
    motions = motions / np.linalg.norm(motions, axis=1).max()
    motions.setflags(write=False)
    return motions


@lru_cache
def unit_motions(n_actuators: int) -> np.ndarray:
    """
    :param n_actuators: number n of actuators
    :return: (n, 2) motion of every actuator; with all that point to one side the sum has length 1, and no subset's is longer
    """
    directions = _directions(n_actuators)
    # The longest sum is of all directions within a quarter turn of its own
    middles = 2 * np.pi * np.arange(4 * n_actuators) / (4 * n_actuators)
    towards = directions @ np.stack([np.cos(middles), np.sin(middles)])
    sums = (towards > 1e-9).T @ directions
    motions = directions / np.linalg.norm(sums, axis=1).max()
    motions.setflags(write=False)
    return motions


class HardMoveEnv(PointMassEnv):
    """
    Move a point mass to a target with n actuators around it, of which every step switches on any subset.

    Registered for n = 4, 6, 8 and 10 as `HardMove4-v0` to `HardMove10-v0`, factored for n = 10, 12, 16 and 20 as
    `FactoredHardMove10-v0` to `FactoredHardMove20-v0`, and as `HardMove-v0` with the arguments `n_actuators` and `factored`.
    The mass is 1, the damping 0.25, a step is a frame of 0.1 seconds. Transitions have no noise.

    ## Action space

    `Tuple(Discrete(2^n), Tuple(Box(-1, 1), ..., Box(-1, 1)))`

    | k | action | parameter | range |
    |---|---|---|---|
    | 0 to 2^n - 1 | push with a subset of the actuators | strength, backwards if negative | -1 to 1 |

    With `factored=True`: `Tuple(MultiBinary(n), Box(-1, 1, (1,)))`, which actuators are on, and the strength.

    The bits of k say which actuators are on, actuator 0 is the highest. Actuator i pushes at the angle 2 pi i / n from +x. The
    force is twice the strength times `motion_table(n)[k]`, the sum of the subset's directions, scaled so that the longest sum
    has length 1.

    ## Observation space

    `Box(-inf, inf, (4,))`

    | index | quantity |
    |---|---|
    | 0, 1 | velocity x, y |
    | 2, 3 | target minus position x, y |

    ## Rewards

    Minus the squared distance to the target; 20 more within 0.2 of it.

    ## Starting state

    Agent at rest and target, both uniform in [-1, 1]^2.

    ## Episode end

    Termination: within 0.2 of the target (`info["outcome"]` is "reached", success). Truncation: 30 steps.

    ## Arguments

    | argument | default | meaning |
    |---|---|---|
    | `n_actuators` | 4 | number n of actuators, 2 to 16, or more if factored |
    | `start` | None | (x, y) at which the agent starts; None draws it |
    | `target` | None | (x, y) of the target; None draws it |
    | `noise` | True | without effect, nothing is random but the start |
    | `render_mode` | None | None, "human" or "rgb_array" |
    | `factored` | False | whether an action says of every actuator whether it is on, instead of numbering subsets |

    ## Reset options

    | key | meaning | accepted |
    |---|---|---|
    | `start` | (x, y) at which the agent starts | two finite numbers |
    | `target` | (x, y) of the target | two finite numbers |

    ## Version history

    * v0: transitions equal those of the HyAR repository's version.

    ## Source

    Li et al. (2022), "HyAR: Addressing Discrete-Continuous Action RL via Hybrid Action Representation".
    """

    success_outcome = "reached"

    def __init__(
        self,
        n_actuators: int = 4,
        start: Point | None = None,
        target: Point | None = None,
        noise: bool = True,
        render_mode: str | None = None,
        factored: bool = False,
    ):
        if n_actuators < 2 or (n_actuators > 16 and not factored):
            raise ValueError(f"n_actuators must be between 2 and 16, or more than that if factored=True, got {n_actuators}")
        super().__init__(start, target, noise, render_mode)
        self.n_actuators = n_actuators
        self.factored = factored
        if factored:
            self._motions = unit_motions(n_actuators).tolist()
            self.action_space = spaces.Tuple((spaces.MultiBinary(n_actuators), spaces.Box(-1.0, 1.0, (1,), np.float32)))
        else:
            self._motions = motion_table(n_actuators).tolist()
            self._set_action_space([[(-1.0, 1.0)]] * len(self._motions))

    def _decode(self, action: Any) -> tuple[int, list[float]]:
        if not self.factored:
            return super()._decode(action)
        try:
            bits = [int(bit) for bit in action[0]]
            (strength,) = (float(value) for value in action[1])
        except (TypeError, IndexError, ValueError) as error:
            raise ValueError(f"action must be (n bits, (strength,)) as in action_space, got {action!r}") from error
        if len(bits) != self.n_actuators or not set(bits) <= {0, 1} or strength - strength != 0.0:
            raise ValueError(f"action must be in the action space; got the bits {bits} with the strength {strength}")
        return int("".join(map(str, bits)), 2), [strength]

    def _motion_of(self, subset: int) -> Point:
        if not self.factored:
            x, y = self._motions[subset]
            return x, y
        active = [motion for i, motion in enumerate(reversed(self._motions)) if subset >> i & 1]
        return sum(x for x, _ in active), sum(y for _, y in active)

    def _advance(self, k: int, parameters: list[float]) -> tuple[float, str, int]:
        # k has active actuators as its bits, actuator 0 the highest
        motion_x, motion_y = self._motion_of(k)
        (strength,) = parameters
        distance_squared = self._push(FORCE * strength * motion_x, FORCE * strength * motion_y)
        if distance_squared <= CAPTURE_DISTANCE_SQUARED:
            return self._result(BONUS - distance_squared, "reached")
        return self._result(-distance_squared, "")

    def _draw(self, canvas: "Canvas") -> None:
        from sb3_chdp.envs.rendering import BLUE, GREY, INK, ORANGE, WHITE

        super()._draw(canvas)
        subset, (strength,) = self._action or (0, [0.0])
        # Blue pushes outwards, orange backwards
        colour = BLUE if strength >= 0 else ORANGE
        centre = PANEL / 2
        for actuator in range(self.n_actuators):
            angle = 2 * pi * actuator / self.n_actuators
            position = (centre + 5 + 44 * cos(angle), centre + 44 * sin(angle))
            active = bool(subset >> (self.n_actuators - 1 - actuator) & 1)
            canvas.disc(position, 11 if self.n_actuators <= 10 else 8, colour if active else GREY)
            canvas.text(str(actuator), position, WHITE if active else INK, 20, centred=True)
        if self._action is not None:
            canvas.text(f"subset {subset} of {2**self.n_actuators}", (150, 44))
            canvas.text(f"strength {strength:+.2f}", (150, 20))
            canvas.rectangle((300, 16), (160, 8), GREY, 4)
            length = 80 * min(abs(strength), 1.0)
            canvas.rectangle((380 if strength >= 0 else 380 - length, 16), (length, 8), colour, 4)
