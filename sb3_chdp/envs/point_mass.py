"""Catch Point and Hard Move: a point mass is pushed to a target (Fan et al., 2019; Li et al., 2022)."""

from functools import lru_cache
from math import cos, pi, sin
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from gymnasium import spaces

from sb3_chdp.envs.base import HybridEnv

if TYPE_CHECKING:
    from sb3_chdp.envs.rendering import Canvas

DT, DAMPING, FORCE = 0.1, 0.25, 2.0
CAPTURE_RADIUS = 0.2
CAPTURE_DISTANCE_SQUARED = CAPTURE_RADIUS**2
BONUS = 20.0
# A reward above this is only possible with the bonus
SUCCESS_REWARD = 4.0
MOVE, CATCH = 0, 1
MISSES_ALLOWED = 11

Point = tuple[float, float]


class PointMassEnv(HybridEnv):
    """
    The dynamics that Catch Point and Hard Move share: mass 1, time step 0.1, damping 0.25, no noise.

    :param start: where the agent starts, uniform in [-1, 1]^2 if None
    :param target: where the target lies, uniform in [-1, 1]^2 if None
    :param noise: accepted for uniformity; these transitions have none
    :param render_mode: None, "human" or "rgb_array"
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 10}
    screen_size = (700, 700)
    state_names: ClassVar[tuple[str, ...]] = ("agent_x", "agent_y", "agent_vx", "agent_vy", "target_x", "target_y")

    def __init__(
        self, start: Point | None = None, target: Point | None = None, noise: bool = True, render_mode: str | None = None
    ):
        super().__init__(noise, render_mode)
        for name, point in (("start", start), ("target", target)):
            if point is not None and (np.shape(point) != (2,) or not np.isfinite(point).all()):
                raise ValueError(f"{name} must be None or two finite coordinates, got {point!r}")
        self.observation_space = spaces.Box(-np.inf, np.inf, (4,), dtype=np.float32)
        self.start, self.target_position = start, target
        self.x = self.y = self.vx = self.vy = self.target_x = self.target_y = 0.0
        self._force: Point = (0.0, 0.0)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        x, y, target_x, target_y = self.np_random.uniform(-1.0, 1.0, 4).tolist()
        self.x, self.y = (x, y) if self.start is None else map(float, self.start)
        self.target_x, self.target_y = (
            (target_x, target_y) if self.target_position is None else map(float, self.target_position)
        )
        self.vx = self.vy = 0.0
        self._force = (0.0, 0.0)
        if self.frame_callback is not None:
            self.frame_callback()
        return self._observation(), {}

    def _push(self, fx: float, fy: float) -> float:
        """
        Advance by one frame.

        :return: squared distance to the target afterwards
        """
        self._force = (fx, fy)
        self.vx = (1 - DAMPING) * self.vx + DT * fx
        self.vy = (1 - DAMPING) * self.vy + DT * fy
        self.x += DT * self.vx
        self.y += DT * self.vy
        return (self.x - self.target_x) ** 2 + (self.y - self.target_y) ** 2

    def _result(self, reward: float, terminated: bool) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        if self.frame_callback is not None:
            self.frame_callback()
        return self._observation(), reward, terminated, False, {"is_success": reward > SUCCESS_REWARD, "frames": 1}

    def _observation(self) -> np.ndarray:
        return np.array([self.vx, self.vy, self.target_x - self.x, self.target_y - self.y], dtype=np.float32)

    def get_state(self) -> np.ndarray:
        return np.array([self.x, self.y, self.vx, self.vy, self.target_x, self.target_y])

    def set_state(self, state: np.ndarray) -> None:
        self.x, self.y, self.vx, self.vy, self.target_x, self.target_y = self._checked_state(state)[:6]

    def _draw(self, canvas: "Canvas") -> None:
        def at(x: float, y: float) -> Point:
            return 350 * (1 + x), 350 * (1 + y)

        canvas.clear((255, 255, 255))
        target = at(self.target_x, self.target_y)
        canvas.disc(target, 350 * 0.05, (191, 64, 64))
        canvas.circle(target, 350 * CAPTURE_RADIUS, (191, 64, 64), 2)
        agent = at(self.x, self.y)
        canvas.disc(agent, 350 * 0.05, (140, 140, 140))
        fx, fy = self._force
        if fx or fy:
            canvas.arrow(agent, (agent[0] + 45 * fx, agent[1] + 45 * fy), (40, 90, 180))


class CatchPointEnv(PointMassEnv):
    """
    ## Description
    Steer a point mass to a target and catch it there.

    ## Action space
    `Tuple(Discrete(2), Tuple(Box(-1, 1), Box(shape=(0,))))`: 0 pushes with force 2 in the direction pi times the parameter,
    measured from +y towards +x; 1 glides and tries to catch, without a parameter.

    ## Observation space
    `Box(-inf, inf, (4,))`: velocity, target minus position.

    ## Rewards
    Minus the squared distance to the target; 20 more for a catch within 0.2. 0 on the step that the misses end.

    ## Starting state
    Agent at rest and target, both uniform in [-1, 1]^2.

    ## Episode end
    Termination: a catch, or any step after 11 misses. Truncation: 25 steps. `info` has `is_success` and `frames`.

    ## Arguments
    `start`, `target`: fixed coordinates instead of random ones. `noise` has no effect, the dynamics are deterministic.

    ## Source
    Fan et al. (2019), "Hybrid Actor-Critic Reinforcement Learning in Parameterized Action Space"; version of the HyAR
    repository. Version 0: transitions equal the original's.
    """

    state_names = (*PointMassEnv.state_names, "misses")

    def __init__(
        self, start: Point | None = None, target: Point | None = None, noise: bool = True, render_mode: str | None = None
    ):
        super().__init__(start, target, noise, render_mode)
        self._set_action_space([[(-1.0, 1.0)], []])
        self.misses = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        self.misses = 0
        return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        k, parameters = self._decode(action)
        if k == MOVE:
            angle = pi * parameters[0]
            distance_squared = self._push(FORCE * sin(angle), FORCE * cos(angle))
        else:
            distance_squared = self._push(0.0, 0.0)
        if self.misses >= MISSES_ALLOWED:
            return self._result(0.0, True)
        if k == CATCH and distance_squared <= CAPTURE_DISTANCE_SQUARED:
            return self._result(BONUS - distance_squared, True)
        self.misses += k == CATCH
        return self._result(-distance_squared, False)

    def get_state(self) -> np.ndarray:
        return np.append(super().get_state(), self.misses)

    def set_state(self, state: np.ndarray) -> None:
        super().set_state(state)
        self.misses = int(state[6])

    def _draw(self, canvas: "Canvas") -> None:
        super()._draw(canvas)
        canvas.text(f"misses {self.misses} / {MISSES_ALLOWED}", (10, 670))


@lru_cache
def motion_table(n_actuators: int) -> np.ndarray:
    """
    :param n_actuators: number n of actuators
    :return: (2^n, 2) motion of every subset of actuators, the longest of length 1; actuator 0 is the highest bit
    """
    angles = 2 * np.pi * np.arange(n_actuators) / n_actuators
    directions = np.round(np.stack([np.cos(angles), np.sin(angles)], axis=1), 3)
    subsets = (np.arange(2**n_actuators)[:, None] >> np.arange(n_actuators)[::-1]) & 1
    motions = subsets @ directions
    motions = motions / np.linalg.norm(motions, axis=1).max()
    motions.setflags(write=False)
    return motions


class HardMoveEnv(PointMassEnv):
    """
    ## Description
    Move a point mass to a target with n actuators around it, of which every step switches on any subset.

    ## Action space
    `Tuple(Discrete(2^n), Tuple(Box(-1, 1), ...))`: subset k of the actuators (actuator 0 is the highest bit of k) pushes
    with twice the parameter times `motion_table(n)[k]`; a negative parameter pushes backwards.

    ## Observation space
    `Box(-inf, inf, (4,))`: velocity, target minus position.

    ## Rewards
    Minus the squared distance to the target; 20 more within 0.2 of it.

    ## Starting state
    Agent at rest and target, both uniform in [-1, 1]^2.

    ## Episode end
    Termination: within 0.2 of the target. Truncation: 30 steps. `info` has `is_success` and `frames`.

    ## Arguments
    `n_actuators` (default 4); `start`, `target`: fixed coordinates instead of random ones. `noise` has no effect.

    ## Source
    Li et al. (2022), "HyAR: Addressing Discrete-Continuous Action RL via Hybrid Action Representation". Version 0:
    transitions equal the original's.
    """

    def __init__(
        self,
        n_actuators: int = 4,
        start: Point | None = None,
        target: Point | None = None,
        noise: bool = True,
        render_mode: str | None = None,
    ):
        if not 2 <= n_actuators <= 16:
            raise ValueError(f"n_actuators must be between 2 and 16, got {n_actuators}")
        super().__init__(start, target, noise, render_mode)
        self.n_actuators = n_actuators
        self._motions = motion_table(n_actuators).tolist()
        self._set_action_space([[(-1.0, 1.0)]] * len(self._motions))
        self._last_subset = 0

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        k, (strength,) = self._decode(action)
        self._last_subset = k
        motion_x, motion_y = self._motions[k]
        distance_squared = self._push(FORCE * strength * motion_x, FORCE * strength * motion_y)
        captured = distance_squared <= CAPTURE_DISTANCE_SQUARED
        return self._result(BONUS - distance_squared if captured else -distance_squared, captured)

    def _draw(self, canvas: "Canvas") -> None:
        super()._draw(canvas)
        for actuator in range(self.n_actuators):
            angle = 2 * pi * actuator / self.n_actuators
            position = (60 + 38 * cos(angle), 60 + 38 * sin(angle))
            if self._last_subset >> (self.n_actuators - 1 - actuator) & 1:
                canvas.disc(position, 9, (40, 90, 180))
            else:
                canvas.circle(position, 9, (40, 90, 180), 2)
