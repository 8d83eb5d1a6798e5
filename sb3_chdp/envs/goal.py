"""Goal: one attacker, one keeper, half a soccer pitch (Masson et al., 2016)."""

from collections.abc import Iterator
from math import atan2, cos, hypot, pi, sin
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from gymnasium import spaces

from sb3_chdp.common.arguments import is_number
from sb3_chdp.envs.base import FRAME_LIMIT, HybridEnv
from sb3_chdp.envs.soccer import (
    AREA_DEPTH,
    AREA_HALF_WIDTH,
    BALL_DECAY,
    BALL_RADIUS,
    CATCHABLE,
    GOAL_DEPTH,
    GOAL_HALF_WIDTH,
    KICKABLE,
    PITCH_HALF_WIDTH,
    PITCH_LENGTH,
    PLAYER_DECAY,
    PLAYER_RADIUS,
    Body,
    collide,
    control_keeper,
    control_player,
    distance_to_goal,
)

if TYPE_CHECKING:
    from sb3_chdp.envs.rendering import Canvas

RESTING_SPEED = 0.1
STEP_LIMIT = 100
KICK_TO, SHOOT_LEFT, SHOOT_RIGHT = 0, 1, 2
PARAMETER_BOUNDS = (((0.0, 40.0), (-15.0, 15.0)), ((-7.01, 7.01),), ((-7.01, 7.01),))

# The original scales its features with float32 bounds
_LOW = np.array([0, -15, -1, -1, -pi, 0, -15, -1, -1, -pi, 0, -15, -3, -3, -1, -1, -7.01], dtype=np.float32)
_HIGH = np.array([20, 15, 1, 1, pi, 20, 15, 1, 1, pi, 20, 15, 3, 3, 1, 1, 14.02], dtype=np.float32)
_SCALE = 2.0 / (_HIGH - _LOW).astype(np.float64)
_SHIFT = _LOW.astype(np.float64)
# Player and keeper, then the ball, then the steps taken
_STATE_NAMES = (
    *(f"{who}_{what}" for who in ("player", "goalie") for what in ("x", "y", "vx", "vy", "orientation")),
    *("ball_x", "ball_y", "ball_vx", "ball_vy", "time"),
)


class GoalEnv(HybridEnv):
    """
    A player must put the ball past a keeper into the goal at the right end of a half pitch.

    An action lasts many frames. The unit is a metre, speeds are metres per frame; x is the distance from the middle line
    towards the goal at x = 20, y is -15 to 15.

    ## Action space

    `Tuple(Discrete(3), Tuple(Box([0, -15], [40, 15]), Box(-7.01, 7.01), Box(-7.01, 7.01)))`

    | k | action | parameters | range | lasts |
    |---|---|---|---|---|
    | 0 | kick-to | x and y of the place to kick to | 0 to 40, -15 to 15 | until the ball rests at the player |
    | 1, 2 | shoot, twice the same | y at which the ball is to cross the goal line | -7.01 to 7.01 | until the episode ends |

    As in the original, kick-to takes its first parameter for y too, and the second has no effect. Parameters out of range are
    clipped.

    ## Observation space

    `Box(-inf, inf, (17,))`, every quantity scaled to about [-1, 1] and not clipped

    | index | quantity | low, high before scaling |
    |---|---|---|
    | 0 to 4 | player: x, y, velocity x, y, heading | 0, 20; -15, 15; -1, 1; -1, 1; -pi, pi |
    | 5 to 9 | the same of the keeper | |
    | 10 to 13 | ball: x, y, velocity x, y | 0, 20; -15, 15; -3, 3; -3, 3 |
    | 14, 15 | unit vector from keeper to ball | -1, 1 |
    | 16 | where the line from the keeper through the ball meets the goal line | -7.01, 14.02 |

    ## Rewards

    50 for a goal, minus the ball's distance to the goal when the episode ends otherwise, 0 before.

    ## Starting state

    The player on x = 0 at a height uniform in [-15, 15], the ball before it, the keeper between ball and goal.

    ## Episode end

    Termination: `info["outcome"]` is "goal" (success), "caught" by the keeper, "out" of the pitch, or "timeout" at step 100,
    which the original takes for an end like the others. Truncation: a step of 10,000 frames, never seen.

    ## Arguments

    | argument | default | meaning |
    |---|---|---|
    | `noise` | True | False silences all perturbations inside a transition |
    | `render_mode` | None | None, "human" or "rgb_array" |

    ## Reset options

    | key | meaning | accepted |
    |---|---|---|
    | `start` | height y at which the player starts | -15 to 15 |

    ## Version history

    * v0: transitions equal those of the original package gym-goal, its oddities included.

    ## Source

    Masson, Ranchod and Konidaris (2016), "Reinforcement Learning with Parameterized Actions".
    """

    screen_size = (480, 640)
    option_names = ("start",)
    success_outcome = "goal"
    action_names: ClassVar[tuple[str, ...]] = ("kick-to", "shoot", "shoot")

    def __init__(self, noise: bool = True, render_mode: str | None = None):
        super().__init__(noise, render_mode)
        self._set_action_space([list(bounds) for bounds in PARAMETER_BOUNDS])
        self.observation_space = spaces.Box(-np.inf, np.inf, (17,), dtype=np.float32)
        self.player, self.keeper, self.ball = Body(PLAYER_RADIUS), Body(PLAYER_RADIUS), Body(BALL_RADIUS)
        self.time = 0
        self._aim: tuple[float, float] | None = None

    def _start(self, options: dict[str, Any]) -> None:
        player_y = options.get("start", 0.0)
        if not (is_number(player_y) and abs(player_y) <= PITCH_HALF_WIDTH):
            raise ValueError(f"options['start'] must be a height from -15 to 15, got {player_y!r}")
        drawn = self.np_random.uniform(-PITCH_HALF_WIDTH, PITCH_HALF_WIDTH)
        player_y = float(player_y) if "start" in options else drawn
        heading = atan2(-player_y, PITCH_LENGTH)
        reach = KICKABLE - 1e-12
        ball_x, ball_y = reach * cos(heading), player_y + reach * sin(heading)
        keeper_x = PITCH_LENGTH - AREA_DEPTH
        keeper_y = ball_y * AREA_DEPTH / (PITCH_LENGTH - ball_x)
        keeper_heading = atan2(ball_y - keeper_y, ball_x - keeper_x)
        self._set_values([0, player_y, 0, 0, heading, keeper_x, keeper_y, 0, 0, keeper_heading, ball_x, ball_y, 0, 0, 0])

    def _advance(self, k: int, parameters: list[float]) -> tuple[float, str, int]:
        k, parameters = self._to_goal_action(k, parameters)
        self.time += 1
        frames = 0
        if self.time >= STEP_LIMIT:
            outcome = "timeout"
            if self._is_watched:
                self._frame_done(outcome)
        else:
            value, (low, high) = parameters[0], PARAMETER_BOUNDS[k][0]
            value = min(max(value, low), high)
            self._aim = (value, value) if k == KICK_TO else (PITCH_LENGTH + BALL_RADIUS, value)
            outcome, frames = self._simulate(k, self._aim)
        reward = 0.0
        if outcome:
            reward = 50.0 if outcome == "goal" else -distance_to_goal(self.ball.x, self.ball.y)
        return reward, outcome, frames

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
        is_watched = self._is_watched
        for frame in range(1, FRAME_LIMIT + 1):
            control_player(player, ball, target, draws)
            control_keeper(keeper, ball, draws)
            player.move(PLAYER_DECAY)
            keeper.move(PLAYER_DECAY)
            ball.move(BALL_DECAY)
            collide(player, keeper)
            collide(player, ball)
            collide(keeper, ball)
            outcome = self._outcome_of_frame()
            if is_watched:
                self._frame_done(outcome)
            if outcome:
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

    def _outcome_of_frame(self) -> str:
        bx, by = self.ball.x, self.ball.y
        if PITCH_LENGTH <= bx <= PITCH_LENGTH + GOAL_DEPTH and abs(by) <= GOAL_HALF_WIDTH:
            return "goal"
        if hypot(bx - self.keeper.x, by - self.keeper.y) < CATCHABLE:
            return "caught"
        return "" if 0.0 <= bx <= PITCH_LENGTH and abs(by) <= PITCH_HALF_WIDTH else "out"

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
        features = np.array([*self._values()[:14], dx / distance, dy / distance, projection])
        return ((features - _SHIFT) * _SCALE - 1.0).astype(np.float32)

    def _values(self) -> list[float]:
        """:return: the quantities of the state, in the order of their names"""
        bodies = [v for b in (self.player, self.keeper) for v in (b.x, b.y, b.vx, b.vy, b.heading)]
        return [*bodies, self.ball.x, self.ball.y, self.ball.vx, self.ball.vy, self.time]

    def _set_values(self, values: list[float]) -> None:
        for body, (x, y, vx, vy, heading) in ((self.player, values[:5]), (self.keeper, values[5:10])):
            body.x, body.y, body.vx, body.vy, body.heading = x, y, vx, vy, heading
        self.ball.x, self.ball.y, self.ball.vx, self.ball.vy = values[10:14]
        self.time = int(values[14])
        self._aim = None

    def _simulator_state(self) -> dict[str, float]:
        return dict(zip(_STATE_NAMES, self._values(), strict=True))

    def _set_simulator_state(self, state: dict[str, float]) -> None:
        self._set_values([state[name] for name in _STATE_NAMES])

    def _draw(self, canvas: "Canvas") -> None:
        from sb3_chdp.envs.rendering import BLUE, INK, RED, WHITE

        unit = 20.0

        def at(x: float, y: float) -> tuple[float, float]:
            # y grows downwards on the pitch, upwards on the canvas
            return (x + 0.8) * unit, (PITCH_HALF_WIDTH - y + 0.3) * unit

        canvas.clear((150, 196, 140))
        for y in (-PITCH_HALF_WIDTH, PITCH_HALF_WIDTH):
            canvas.line(at(0, y), at(PITCH_LENGTH, y), WHITE, 2)
        for x in (0.0, PITCH_LENGTH):
            canvas.line(at(x, -PITCH_HALF_WIDTH), at(x, PITCH_HALF_WIDTH), WHITE, 2)
        edge = PITCH_LENGTH - AREA_DEPTH
        for y in (-AREA_HALF_WIDTH, AREA_HALF_WIDTH):
            canvas.line(at(edge, y), at(PITCH_LENGTH, y), WHITE, 2)
        canvas.line(at(edge, -AREA_HALF_WIDTH), at(edge, AREA_HALF_WIDTH), WHITE, 2)
        # at() turns y over: the goal's lower left corner is at its largest y
        canvas.rectangle(at(PITCH_LENGTH, GOAL_HALF_WIDTH), (GOAL_DEPTH * unit, 2 * GOAL_HALF_WIDTH * unit), (225, 235, 222))
        for y in (-GOAL_HALF_WIDTH, GOAL_HALF_WIDTH):
            canvas.line(at(PITCH_LENGTH, y), at(PITCH_LENGTH + GOAL_DEPTH, y), INK, 4)
        if self._aim is not None:
            x, y = at(*self._aim)
            for dx, dy in ((6, 6), (6, -6)):
                canvas.line((x - dx, y - dy), (x + dx, y + dy), BLUE, 2)
        for body, colour, reach in ((self.player, BLUE, KICKABLE), (self.keeper, RED, CATCHABLE)):
            centre = at(body.x, body.y)
            canvas.disc(centre, body.radius * unit, colour)
            canvas.circle(centre, reach * unit, colour, 1)
            nose = at(body.x + body.radius * cos(body.heading), body.y + body.radius * sin(body.heading))
            canvas.line(centre, nose, WHITE, 2)
        ball = at(self.ball.x, self.ball.y)
        canvas.disc(ball, BALL_RADIUS * unit + 1.5, INK)
        canvas.disc(ball, BALL_RADIUS * unit - 1, WHITE)
        canvas.text(f"step {self.time}   {self._action_text()}", (16, 624))
