"""The dynamics of Goal and Hard Goal: players, ball, collisions, and how both players run (Masson et al., 2016)."""

from collections.abc import Iterator
from math import atan2, cos, hypot, pi, sin

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


def control_player(player: Body, ball: Body, target: tuple[float, float], draws: Iterator[float]) -> None:
    """Kick the ball towards the target, or run after it."""
    dx, dy = ball.x - player.x, ball.y - player.y
    distance, bearing = hypot(dx, dy), atan2(dy, dx)
    if distance <= KICKABLE:
        ax = (1 - BALL_DECAY) * (target[0] - player.x) - ball.vx
        ay = (1 - BALL_DECAY) * (target[1] - player.y) - ball.vy
        efficiency = 1 - 0.25 * abs(wrap(bearing - player.heading)) / pi - 0.25 * distance / KICKABLE
        power = min(hypot(ax, ay) / (efficiency * BALL_MOTION[0]), MAX_POWER) * efficiency
        heading = player.heading + (atan2(ay, ax) - player.heading)  # rounded as the original's
        ball.accelerate(power, heading, BALL_MOTION, draws)
    elif abs(wrap(player.heading - bearing)) < pi / 8:
        player.accelerate(10.0, player.heading, PLAYER_MOTION, draws)
    else:
        player.heading += wrap(bearing - player.heading) / (1 + 5 * hypot(player.vx, player.vy))


def control_keeper(keeper: Body, ball: Body, draws: Iterator[float]) -> None:
    """Intercept a ball that is going into the goal, or go to where the ball will rest."""
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
