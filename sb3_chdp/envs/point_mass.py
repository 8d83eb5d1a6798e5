"""The dynamics that Catch Point and Hard Move share: a point mass is pushed to a target."""

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
# Of the picture: the field with the square [-1, 1]^2, and a panel below it
FIELD, PANEL, UNIT = 480, 120, 190.0

Point = tuple[float, float]


def checked_point(name: str, value: Any) -> Point:
    """
    :param name: what the error calls it
    :param value: what the user gave
    :return: two coordinates
    :raises ValueError: if they are not two finite numbers
    """
    point = np.asarray(value)
    if point.shape != (2,) or point.dtype.kind not in "fiu" or not np.isfinite(point).all():
        raise ValueError(f"{name} must be two finite coordinates, got {value!r}")
    return float(point[0]), float(point[1])


class PointMassEnv(HybridEnv):
    """
    A point of mass 1 with damping 0.25, in frames of 0.1 seconds. Transitions have no noise; a step is a frame.

    :param start: where the agent starts, uniform in [-1, 1]^2 if None
    :param target: where the target lies, uniform in [-1, 1]^2 if None
    :param noise: accepted as in the other environments, without effect
    :param render_mode: None, "human" or "rgb_array"
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 10}
    screen_size = (FIELD, FIELD + PANEL)
    option_names: ClassVar[tuple[str, ...]] = ("start", "target")

    def __init__(
        self, start: Point | None = None, target: Point | None = None, noise: bool = True, render_mode: str | None = None
    ):
        super().__init__(noise, render_mode)
        self.start = None if start is None else checked_point("start", start)
        self.target = None if target is None else checked_point("target", target)
        self.observation_space = spaces.Box(-np.inf, np.inf, (4,), dtype=np.float32)
        self.x = self.y = self.vx = self.vy = self.target_x = self.target_y = 0.0
        self._force: Point = (0.0, 0.0)

    def _start(self, options: dict[str, Any]) -> None:
        points = {"start": self.start, "target": self.target}
        points.update({name: checked_point(f"options[{name!r}]", value) for name, value in options.items()})
        x, y, target_x, target_y = self.np_random.uniform(-1.0, 1.0, 4).tolist()
        self.x, self.y = points["start"] or (x, y)
        self.target_x, self.target_y = points["target"] or (target_x, target_y)
        self.vx = self.vy = 0.0
        self._force = (0.0, 0.0)

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

    def _result(self, reward: float, outcome: str) -> tuple[float, str, int]:
        """:return: what a step of a single frame gives"""
        if self._is_watched:
            self._frame_done(outcome)
        return reward, outcome, 1

    def _observation(self) -> np.ndarray:
        return np.array([self.vx, self.vy, self.target_x - self.x, self.target_y - self.y], dtype=np.float32)

    def _simulator_state(self) -> dict[str, float]:
        return {
            "agent_x": self.x,
            "agent_y": self.y,
            "agent_vx": self.vx,
            "agent_vy": self.vy,
            "target_x": self.target_x,
            "target_y": self.target_y,
        }

    def _set_simulator_state(self, state: dict[str, float]) -> None:
        self.x, self.y, self.vx, self.vy = (state[f"agent_{name}"] for name in ("x", "y", "vx", "vy"))
        self.target_x, self.target_y = state["target_x"], state["target_y"]
        self._force = (0.0, 0.0)

    def _draw(self, canvas: "Canvas") -> None:
        from sb3_chdp.envs.rendering import BLUE, GREY, INK, RED, WHITE

        def at(x: float, y: float) -> Point:
            return FIELD / 2 + UNIT * x, PANEL + FIELD / 2 + UNIT * y

        canvas.clear(WHITE)
        corners = [at(-1, -1), at(1, -1), at(1, 1), at(-1, 1)]
        for i in range(4):
            canvas.line(corners[i - 1], corners[i], GREY, 1)
        target, agent = at(self.target_x, self.target_y), at(self.x, self.y)
        canvas.disc(target, 0.04 * UNIT, RED)
        canvas.circle(target, CAPTURE_RADIUS * UNIT, RED, 2)
        canvas.disc(agent, 0.06 * UNIT, INK)
        fx, fy = self._force
        canvas.arrow(agent, (agent[0] + 40 * fx, agent[1] + 40 * fy), BLUE)
        # The panel last: it hides what lies below the field
        canvas.rectangle((0, 0), (FIELD, PANEL), (240, 242, 245))
        distance = np.hypot(self.x - self.target_x, self.y - self.target_y)
        canvas.text(f"distance {distance:.2f} (goal: {CAPTURE_RADIUS:g})", (150, 92))
        canvas.text(f"speed {np.hypot(self.vx, self.vy):.2f}", (150, 68))
