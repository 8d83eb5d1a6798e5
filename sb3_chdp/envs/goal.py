"""Goal: one attacker, one keeper, half a soccer pitch (Masson et al., 2016)."""

from collections.abc import Iterator
from math import atan2, cos, hypot, pi, sin
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from sb3_chdp.envs.base import HybridEnv

if TYPE_CHECKING:
    from sb3_chdp.envs.rendering import Canvas

PITCH_LENGTH, PITCH_HALF_WIDTH = 20.0, 15.0
GOAL_HALF_WIDTH, GOAL_DEPTH = 7.01, 2.44
AREA_DEPTH, AREA_HALF_WIDTH = 5.5, 9.16
PLAYER_RADIUS, BALL_RADIUS = 0.9, 0.4
KICKABLE, CATCHABLE = 1.6, 2.0
PLAYER_DECAY, BALL_DECAY = 0.4, 0.94
# (power rate, bound on acceleration and speed, noise level)
PLAYER_MOTION = (0.006, 1.0, 0.1)
BALL_MOTION = (0.027, 2.7, 0.05)
MAX_POWER = 100.0
RESTING_SPEED = 0.1
STEP_LIMIT, FRAME_LIMIT = 100, 10_000
KICK_TO, SHOOT_LEFT, SHOOT_RIGHT = 0, 1, 2
PARAMETER_BOUNDS = (((0.0, 40.0), (-15.0, 15.0)), ((-7.01, 7.01),), ((-7.01, 7.01),))

# The original scales its features with float32 bounds
_LOW = np.array([0, -15, -1, -1, -pi, 0, -15, -1, -1, -pi, 0, -15, -3, -3, -1, -1, -7.01], dtype=np.float32)
_HIGH = np.array([20, 15, 1, 1, pi, 20, 15, 1, 1, pi, 20, 15, 3, 3, 1, 1, 14.02], dtype=np.float32)
_SCALE = 2.0 / (_HIGH - _LOW).astype(np.float64)
_SHIFT = _LOW.astype(np.float64)


def wrap(angle: float) -> float:
    """:return: the angle moved into [-pi, pi] by multiples of 2 pi"""
    while angle > pi:
        angle -= 2 * pi
    while angle < -pi:
        angle += 2 * pi
    return angle


def distance_to_goal(bx: float, by: float) -> float:
    """:return: distance of the ball to the goal, with the original's wrong sign beyond the goal line on the low side"""
    if bx < PITCH_LENGTH:
        if abs(by) <= GOAL_HALF_WIDTH:
            return PITCH_LENGTH - bx
        return hypot(PITCH_LENGTH - bx, (GOAL_HALF_WIDTH if by > 0 else -GOAL_HALF_WIDTH) - by)
    if by > GOAL_HALF_WIDTH:
        return by - GOAL_HALF_WIDTH
    return 0.0 if by >= -GOAL_HALF_WIDTH else GOAL_HALF_WIDTH - by


class Body:
    """Position and velocity of a disc; the player and the keeper have a heading as well."""

    __slots__ = ("heading", "radius", "vx", "vy", "x", "y")

    def __init__(self, radius: float):
        self.radius = radius
        self.x = self.y = self.vx = self.vy = self.heading = 0.0

    def accelerate(self, power: float, heading: float, motion: tuple[float, float, float], draws: Iterator[float]) -> None:
        """
        Add noisy acceleration to the velocity.

        :param power: dash or kick power
        :param heading: its direction in radians; the noise is a factor on this angle
        :param motion: power rate, bound, noise level
        :param draws: U(-1, 1) draws, three are taken
        """
        rate, bound, level = motion
        heading += level * next(draws) * heading
        spread = level * hypot(self.vx, self.vy)
        ax = power * rate * cos(heading) + spread * next(draws)
        ay = power * rate * sin(heading) + spread * next(draws)
        vx = self.vx + (-bound if ax < -bound else bound if ax > bound else ax)
        vy = self.vy + (-bound if ay < -bound else bound if ay > bound else ay)
        self.vx = -bound if vx < -bound else bound if vx > bound else vx
        self.vy = -bound if vy < -bound else bound if vy > bound else vy

    def move(self, decay: float) -> None:
        self.x += self.vx
        self.y += self.vy
        self.vx *= decay
        self.vy *= decay


def collide(first: Body, second: Body) -> None:
    """Push two overlapping discs apart and reverse both velocities."""
    dx, dy = second.x - first.x, second.y - first.y
    reach = first.radius + second.radius
    if abs(dx) >= reach or abs(dy) >= reach or hypot(dx, dy) >= reach:
        return
    half = (reach - hypot(dx, dy)) / 2
    forward, backward = atan2(dy, dx), atan2(-dy, -dx)
    first.x += half * cos(backward)
    first.y += half * sin(backward)
    second.x += half * cos(forward)
    second.y += half * sin(forward)
    for body in (first, second):
        body.vx, body.vy = -body.vx, -body.vy


class GoalEnv(HybridEnv):
    """
    ## Description
    A player must put the ball past a keeper into the goal at the right end of a half pitch. Every action is a
    macro-action of many frames. Unit: metre; speeds are metres per frame.

    ## Action space
    `Tuple(Discrete(3), Tuple(Box([0, -15], [40, 15]), Box(-7.01, 7.01), Box(-7.01, 7.01)))`

    | k | action | parameters | lasts |
    |---|---|---|---|
    | 0 | kick-to | target x (used for y too; the second parameter has no effect, as in the original) | until the ball rests |
    | 1, 2 | shoot | height on the goal line | until the episode ends |

    ## Observation space
    `Box(-inf, inf, (17,))`: position, velocity and heading of player and keeper, position and velocity of the ball, unit
    vector from keeper to ball, projection of the keeper on the goal line; scaled to about [-1, 1], not clipped.

    ## Rewards
    50 for a goal, minus the ball's distance to the goal when the episode ends otherwise, 0 before.

    ## Starting state
    The player on x = 0 at a height uniform in [-15, 15], the ball before it, the keeper between ball and goal.

    ## Episode end
    Termination: `info["outcome"]` is "goal", "caught", "out" or "timeout" (step 100, which the original treats as terminal).
    Truncation: a step of 10,000 frames, never seen. `info` has `is_success` and `frames`.

    ## Arguments
    `noise=False` silences all perturbations inside a transition.

    ## Source
    Masson, Ranchod and Konidaris (2016), "Reinforcement Learning with Parameterized Actions"; original package gym-goal.
    Version 0: transitions equal the original's, oddities included.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 30}
    screen_size = (448, 600)
    state_names = tuple(
        [f"{who}_{what}" for who in ("player", "goalie") for what in ("x", "y", "vx", "vy", "orientation")]
        + ["ball_x", "ball_y", "ball_vx", "ball_vy", "time"]
    )

    def __init__(self, noise: bool = True, render_mode: str | None = None):
        super().__init__(noise, render_mode)
        self._set_action_space([list(bounds) for bounds in PARAMETER_BOUNDS])
        self.observation_space = spaces.Box(-np.inf, np.inf, (17,), dtype=np.float32)
        self.player, self.keeper, self.ball = Body(PLAYER_RADIUS), Body(PLAYER_RADIUS), Body(BALL_RADIUS)
        self.time = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self._place_at_start(self.np_random.uniform(-PITCH_HALF_WIDTH, PITCH_HALF_WIDTH))
        if self.frame_callback is not None:
            self.frame_callback()
        return self._observation(), {}

    def _place_at_start(self, player_y: float) -> None:
        heading = atan2(-player_y, PITCH_LENGTH)
        reach = KICKABLE - 1e-12
        ball_x, ball_y = reach * cos(heading), player_y + reach * sin(heading)
        keeper_x = PITCH_LENGTH - AREA_DEPTH
        keeper_y = ball_y * AREA_DEPTH / (PITCH_LENGTH - ball_x)
        keeper_heading = atan2(ball_y - keeper_y, ball_x - keeper_x)
        self.set_state(
            np.array([0, player_y, 0, 0, heading, keeper_x, keeper_y, 0, 0, keeper_heading, ball_x, ball_y, 0, 0, 0])
        )

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        k, parameters = self._decode(action)
        k, parameters = self._to_goal_action(k, parameters)
        self.time += 1
        frames = 0
        if self.time >= STEP_LIMIT:
            outcome = "timeout"
        else:
            value, (low, high) = parameters[0], PARAMETER_BOUNDS[k][0]
            value = min(max(value, low), high)
            target = (value, value) if k == KICK_TO else (PITCH_LENGTH + BALL_RADIUS, value)
            outcome, frames = self._simulate(k, target)
        reward = 0.0
        if outcome:
            reward = 50.0 if outcome == "goal" else -distance_to_goal(self.ball.x, self.ball.y)
        info: dict[str, Any] = {"is_success": outcome == "goal", "frames": frames}
        if outcome:
            info["outcome"] = outcome
        return self._observation(), reward, bool(outcome), frames >= FRAME_LIMIT and not outcome, info

    def _to_goal_action(self, k: int, parameters: list[float]) -> tuple[int, list[float]]:
        """:return: kick-to or shoot, and its parameters in native units, not yet clipped"""
        return k, parameters

    def _simulate(self, k: int, target: tuple[float, float]) -> tuple[str, int]:
        """
        Run the frames of one step.

        :param k: kick-to or shoot
        :param target: where the ball shall go
        :return: outcome ("" while the episode goes on), number of frames
        """
        player, keeper, ball = self.player, self.keeper, self.ball
        draws = self._draws()
        for frame in range(1, FRAME_LIMIT + 1):
            self._control_player(target, draws)
            self._control_keeper(draws)
            player.move(PLAYER_DECAY)
            keeper.move(PLAYER_DECAY)
            ball.move(BALL_DECAY)
            collide(player, keeper)
            collide(player, ball)
            collide(keeper, ball)
            if self.frame_callback is not None:
                self.frame_callback()
            if outcome := self._outcome():
                return outcome, frame
            if (
                k == KICK_TO
                and hypot(ball.vx, ball.vy) <= RESTING_SPEED
                and hypot(ball.x - player.x, ball.y - player.y) <= KICKABLE
            ):
                return "", frame
        return "", FRAME_LIMIT

    def _draws(self) -> Iterator[float]:
        while True:
            yield from self._uniforms(96)

    def _outcome(self) -> str:
        bx, by = self.ball.x, self.ball.y
        if PITCH_LENGTH <= bx <= PITCH_LENGTH + GOAL_DEPTH and abs(by) <= GOAL_HALF_WIDTH:
            return "goal"
        if hypot(bx - self.keeper.x, by - self.keeper.y) < CATCHABLE:
            return "caught"
        return "" if 0.0 <= bx <= PITCH_LENGTH and abs(by) <= PITCH_HALF_WIDTH else "out"

    def _control_player(self, target: tuple[float, float], draws: Iterator[float]) -> None:
        """Kick the ball towards the target, or run after it."""
        player, ball = self.player, self.ball
        dx, dy = ball.x - player.x, ball.y - player.y
        distance, bearing = hypot(dx, dy), atan2(dy, dx)
        if distance <= KICKABLE:
            ax = (1 - BALL_DECAY) * (target[0] - player.x) - ball.vx
            ay = (1 - BALL_DECAY) * (target[1] - player.y) - ball.vy
            efficiency = 1 - 0.25 * abs(wrap(bearing - player.heading)) / pi - 0.25 * distance / KICKABLE
            power = min(hypot(ax, ay) / (efficiency * BALL_MOTION[0]), MAX_POWER) * efficiency
            heading = player.heading + (atan2(ay, ax) - player.heading)
            ball.accelerate(power, heading, BALL_MOTION, draws)
        elif abs(wrap(player.heading - bearing)) < pi / 8:
            player.accelerate(10.0, player.heading, PLAYER_MOTION, draws)
        else:
            player.heading += wrap(bearing - player.heading) / (1 + 5 * hypot(player.vx, player.vy))

    def _control_keeper(self, draws: Iterator[float]) -> None:
        """Intercept a ball that is going into the goal, or go to where the ball will rest."""
        keeper, ball = self.keeper, self.ball
        rest_x, rest_y = ball.x + ball.vx / (1 - BALL_DECAY), ball.y + ball.vy / (1 - BALL_DECAY)
        run = rest_x - ball.x
        slope = (rest_y - ball.y) / run if run != 0.0 else 0.0
        offset = ball.y - slope * ball.x
        if rest_x > PITCH_LENGTH and slope != 0.0 and abs(slope * PITCH_LENGTH + offset) <= GOAL_HALF_WIDTH + 2:
            # Foot of the perpendicular from the keeper on the ball's line
            normal = -1 / slope
            x = (keeper.y - normal * keeper.x - offset) / (slope - normal)
            y = slope * x + offset
            power = 20.0
        else:
            x, y, power = rest_x, rest_y, 8.0
        keeper.heading = atan2(y - keeper.y, x - keeper.x)
        keeper.accelerate(power, keeper.heading, PLAYER_MOTION, draws)

    def _observation(self) -> np.ndarray:
        keeper, ball = self.keeper, self.ball
        dx, dy = ball.x - keeper.x, ball.y - keeper.y
        distance = hypot(dx, dy) or 1.0
        if dx == 0.0:
            projection = -GOAL_HALF_WIDTH if keeper.y < ball.y else GOAL_HALF_WIDTH
        else:
            slope = dy / dx
            # The upper clip at the full goal width is the original's
            projection = min(max(PITCH_LENGTH * slope + ball.y - slope * ball.x, -GOAL_HALF_WIDTH), 2 * GOAL_HALF_WIDTH)
        features = np.array([*self._state()[:14], dx / distance, dy / distance, projection])
        return ((features - _SHIFT) * _SCALE - 1.0).astype(np.float32)

    def _state(self) -> list[float]:
        bodies = [v for b in (self.player, self.keeper) for v in (b.x, b.y, b.vx, b.vy, b.heading)]
        return [*bodies, self.ball.x, self.ball.y, self.ball.vx, self.ball.vy, float(self.time)]

    def get_state(self) -> np.ndarray:
        return np.array(self._state())

    def set_state(self, state: np.ndarray) -> None:
        values = self._checked_state(state)
        for body, (x, y, vx, vy, heading) in ((self.player, values[:5]), (self.keeper, values[5:10])):
            body.x, body.y, body.vx, body.vy, body.heading = x, y, vx, vy, heading
        self.ball.x, self.ball.y, self.ball.vx, self.ball.vy = values[10:14]
        self.time = int(values[14])

    def _draw(self, canvas: "Canvas") -> None:
        unit = 20.0

        def at(x: float, y: float) -> tuple[float, float]:
            # y grows downwards on the pitch, upwards on the canvas
            return x * unit, (PITCH_HALF_WIDTH - y) * unit

        canvas.clear((0, 125, 0))
        white = (255, 255, 255)
        edge = PITCH_LENGTH - AREA_DEPTH
        canvas.line(at(20, -15), at(20, 15), white, 2)
        for y in (-AREA_HALF_WIDTH, AREA_HALF_WIDTH):
            canvas.line(at(edge, y), at(20, y), white, 2)
        canvas.line(at(edge, -AREA_HALF_WIDTH), at(edge, AREA_HALF_WIDTH), white, 2)
        for y in (-GOAL_HALF_WIDTH, GOAL_HALF_WIDTH):
            canvas.line(at(20, y), at(20 + GOAL_DEPTH, y), white, 4)
        for body, colour, reach in ((self.player, white, KICKABLE), (self.keeper, (220, 40, 40), CATCHABLE)):
            centre = at(body.x, body.y)
            canvas.disc(centre, body.radius * unit, colour)
            canvas.circle(centre, reach * unit, colour, 1)
            nose = at(body.x + body.radius * cos(body.heading), body.y + body.radius * sin(body.heading))
            canvas.line(centre, nose, (0, 0, 0), 2)
        canvas.disc(at(self.ball.x, self.ball.y), BALL_RADIUS * unit, (0, 0, 0))
