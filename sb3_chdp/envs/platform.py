"""Platform: a side-view platformer with three jumps and two enemies (Masson et al., 2016)."""

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

from sb3_chdp.common.arguments import is_number
from sb3_chdp.envs.base import HybridEnv

if TYPE_CHECKING:
    from sb3_chdp.envs.rendering import Canvas

DT = 0.05
GRAVITY = 9.8
PLATFORMS = ((0.0, 250.0), (475.0, 275.0), (985.0, 50.0))  # left edge, width
FINISH = 1035.0
GROUND = 40.0
PLAYER_WIDTH, PLAYER_HEIGHT = 20.0, 30.0
MAX_AX, MAX_AY = 600.0, 4000.0
MAX_VX, MAX_VX_STANDING, MAX_VY = 100.0, 70.0, 200.0
DECAY = 0.99
ENEMY_SPEED = 30.0
SPEED_NOISE = 0.5 * DT
# Where the player stands on a platform, clear of its enemy's place at the start
STARTS = ((0.0, 210.0), (455.0, 710.0), (965.0, 1034.0))
RUN = 0  # of run, hop, leap
TAKE_OFF_SPEED = (0.0, 35.0, 25.0)
RUN_FRAMES = 20
PARAMETER_BOUNDS = ((0.0, 30.0), (0.0, 720.0), (0.0, 430.0))

# (w1, w2, gap, left edge) of the platform that the observation calls current, already scaled to [-1, 1]
_PLATFORM_FEATURES = tuple(
    (2 * w1 / 275 - 1, 2 * w2 / 275 - 1, 2 * gap / 235 - 1, 2 * left / FINISH - 1)
    for w1, w2, gap, left in ((250, 275, 225, 0), (275, 50, 235, 475), (50, 0, 0, 985))
)


def is_standing(x: float, y: float) -> bool:
    """Whether the player's feet are exactly on one of the platforms."""
    return y == GROUND and ((-20.0 <= x <= 250.0) or (-20.0 <= x - 475.0 <= 275.0) or (-20.0 <= x - 985.0 <= 50.0))


def separate(x: float, y: float, vx: float, vy: float) -> tuple[float, float, float, float]:
    """Push the player out of every platform that it overlaps, along the shorter way."""
    for left, width in PLATFORMS:
        if not (left - PLAYER_WIDTH < x < left + width and -PLAYER_HEIGHT < y < GROUND):
            continue
        new_x = left - PLAYER_WIDTH if x < left else left + width if x > left + width - PLAYER_WIDTH else x
        new_y = -PLAYER_HEIGHT if y < 0.0 else GROUND if y > GROUND - PLAYER_HEIGHT else y
        if new_x != x and (new_y == y or abs(x - new_x) < abs(y - new_y)):
            x = new_x
        else:
            vy, y = 0.0, new_y
        vx = 0.0
    return x, y, vx, vy


class PlatformEnv(HybridEnv):
    """
    Run and jump over three platforms with an enemy on each of the first two, and reach the finish line.

    An action lasts many frames of 0.05 s. Positions are pixels, y points up; the finish line is at x = 1035.

    ## Action space

    `Tuple(Discrete(3), Tuple(Box(0, 30), Box(0, 720), Box(0, 430)))`

    | k | action | parameter | range | lasts |
    |---|---|---|---|---|
    | 0 | run | acceleration | 0 to 30 | 20 frames |
    | 1 | hop | length (high jump) | 0 to 720 | until the player stands on a platform |
    | 2 | leap | length (flat jump) | 0 to 430 | until the player stands on a platform |

    Parameters out of range are clipped.

    ## Observation space

    `Box(-1, 1, (9,))`, every quantity scaled to [-1, 1]

    | index | quantity | low, high before scaling |
    |---|---|---|
    | 0 | player's x | -20, 1035 |
    | 1 | player's velocity x | 0, 100 |
    | 2 | x of the enemy of the present platform | 0, 1035 |
    | 3 | its velocity | -30, 30 |
    | 4, 5 | widths of the present and the next platform | 0, 275 |
    | 6 | gap between them | 0, 235 |
    | 7 | left edge of the present one | 0, 1035 |
    | 8 | difference of their heights, always -1 | |

    ## Rewards

    Progress in x divided by 1035. The rewards of an episode that starts at 0 add up to x_final / 1035; 1 is success.

    ## Starting state

    At the left end of the first platform, the enemies at the right ends of theirs; always the same.

    ## Episode end

    Termination: `info["outcome"]` is "finish" (success), "fall" or "enemy". Truncation: 200 steps.

    ## Arguments

    | argument | default | meaning |
    |---|---|---|
    | `noise` | True | False silences all perturbations inside a transition |
    | `render_mode` | None | None, "human" or "rgb_array" |

    ## Reset options

    | key | meaning | accepted |
    |---|---|---|
    | `start` | x at which the player stands | 0 to 210, 455 to 710 or 965 to 1034: on a platform, clear of its enemy |

    ## Version history

    * v0: transitions equal those of the original package gym-platform; observations are scaled as its wrappers do.

    ## Source

    Masson, Ranchod and Konidaris (2016), "Reinforcement Learning with Parameterized Actions".
    """

    screen_size = (800, 240)
    option_names = ("start",)
    success_outcome = "finish"
    action_names = ("run", "hop", "leap")

    def __init__(self, noise: bool = True, render_mode: str | None = None):
        super().__init__(noise, render_mode)
        self._set_action_space([[bounds] for bounds in PARAMETER_BOUNDS])
        self.observation_space = spaces.Box(-1.0, 1.0, (9,), dtype=np.float32)
        self._place_at(0.0)

    def _place_at(self, x: float) -> None:
        self.x, self.y, self.vx, self.vy = x, GROUND, 0.0, 0.0
        self.enemies = [(left + width - PLAYER_WIDTH, -ENEMY_SPEED) for left, width in PLATFORMS[:2]]

    def _start(self, options: dict[str, Any]) -> None:
        x = options.get("start", 0.0)
        if not is_number(x) or not any(low <= x <= high for low, high in STARTS):
            ranges = ", ".join(f"{low:g} to {high:g}" for low, high in STARTS)
            raise ValueError(f"options['start'] must be an x at which the player can stand ({ranges}), got {x!r}")
        self._place_at(float(x))

    def _advance(self, k: int, parameters: list[float]) -> tuple[float, str, int]:
        low, high = PARAMETER_BOUNDS[k]
        return self._simulate(k, min(max(parameters[0], low), high))

    def _simulate(self, k: int, parameter: float) -> tuple[float, str, int]:
        """
        Run the frames of one step.

        :param k: discrete action
        :param parameter: its parameter in native units, inside the bounds
        :return: reward, outcome ("" while the episode goes on), number of frames
        """
        x, y, vx, vy = self.x, self.y, self.vx, self.vy
        x_start = x
        take_off = TAKE_OFF_SPEED[k]
        air_time = 2 * take_off / GRAVITY + 1
        # Two draws per frame, player and enemy; most jumps end within 150 frames
        block = 2 * RUN_FRAMES if k == RUN else 300
        draws = iter(self._normals(block))
        gravity_step = -GRAVITY * DT
        is_watched = self._is_watched
        frames = 0
        outcome = ""
        while True:
            frames += 1
            standing = is_standing(x, y)
            if not standing:
                vy += gravity_step
            elif k == RUN:
                vx += min(parameter / DT, MAX_AX) * DT
            else:
                z1, z2 = self._normals(2)
                speed_change = min(max(parameter / air_time - vx, -MAX_AX), 200.0 - take_off)
                vx += min(max((speed_change - abs(z1)) / DT, -MAX_AX), MAX_AX) * DT
                vy += min(max((take_off - abs(z2)) / DT, -MAX_AY), MAX_AY) * DT
            noise = next(draws, None)
            if noise is None:
                draws = iter(self._normals(block))
                noise = next(draws)
            vx -= abs(SPEED_NOISE * noise)
            max_vx = MAX_VX_STANDING if standing else MAX_VX
            vx = 0.0 if vx < 0.0 else max_vx if vx > max_vx else vx
            vy = -MAX_VY if vy < -MAX_VY else MAX_VY if vy > MAX_VY else vy

            active = 1 if x > 475.0 else 0
            x += vx * DT
            x = 0.0 if x < 0.0 else FINISH if x > FINISH else x
            y += vy * DT
            vx *= DECAY

            enemy_x, enemy_dx = self.enemies[active]
            low, high = (475.0, 730.0) if active else (0.0, 230.0)
            if not low < enemy_x < high:
                enemy_dx = -enemy_dx
            enemy_dx += SPEED_NOISE * next(draws)
            enemy_dx = -ENEMY_SPEED if enemy_dx < -ENEMY_SPEED else ENEMY_SPEED if enemy_dx > ENEMY_SPEED else enemy_dx
            enemy_x += enemy_dx * DT
            enemy_x = low if enemy_x < low else high if enemy_x > high else enemy_x
            self.enemies[active] = (enemy_x, enemy_dx)

            if y < GROUND:
                x, y, vx, vy = separate(x, y, vx, vy)
            if x >= FINISH:
                outcome = "finish"
            elif y < GROUND:
                outcome = "fall"
            elif y < GROUND + PLAYER_HEIGHT and any(abs(x - enemy[0]) < PLAYER_WIDTH for enemy in self.enemies):
                outcome = "enemy"
            if is_watched:
                self.x, self.y, self.vx, self.vy = x, y, vx, vy
                self._frame_done(outcome)
            if outcome or (frames == RUN_FRAMES if k == RUN else is_standing(x, y)):
                break
        self.x, self.y, self.vx, self.vy = x, y, vx, vy
        return (x - x_start) / FINISH, outcome, frames

    def _observation(self) -> np.ndarray:
        x = self.x
        enemy_x, enemy_dx = self.enemies[1 if x > 475.0 else 0]
        platform = _PLATFORM_FEATURES[0 if x < 475.0 else 1 if x < 985.0 else 2]
        return np.array(
            [
                2 * (x + 20) / 1055 - 1,
                2 * self.vx / 100 - 1,
                2 * enemy_x / FINISH - 1,
                2 * (enemy_dx + 30) / 60 - 1,
                *platform,
                -1.0,
            ],
            dtype=np.float32,
        )

    def _simulator_state(self) -> dict[str, float]:
        (enemy1_x, enemy1_dx), (enemy2_x, enemy2_dx) = self.enemies
        return {
            "player_x": self.x,
            "player_y": self.y,
            "player_vx": self.vx,
            "player_vy": self.vy,
            "enemy1_x": enemy1_x,
            "enemy1_dx": enemy1_dx,
            "enemy2_x": enemy2_x,
            "enemy2_dx": enemy2_dx,
        }

    def _set_simulator_state(self, state: dict[str, float]) -> None:
        self.x, self.y, self.vx, self.vy = (state[f"player_{name}"] for name in ("x", "y", "vx", "vy"))
        self.enemies = [(state[f"enemy{i}_x"], state[f"enemy{i}_dx"]) for i in (1, 2)]

    def _draw(self, canvas: "Canvas") -> None:
        from sb3_chdp.envs.rendering import GREY, INK, RED, WHITE

        scale, margin, base = 0.74, 12.0, 30.0

        def box(x: float, y: float, width: float, height: float, colour: tuple[int, int, int], rounding: float = 0) -> None:
            canvas.rectangle((margin + scale * x, base + scale * y), (scale * width, scale * height), colour, rounding)

        canvas.clear((214, 234, 248))
        for left, width in PLATFORMS:
            box(left, -30, width, GROUND + 30, (139, 94, 60))
            box(left, GROUND - 8, width, 8, (86, 152, 72))
        pole = margin + scale * (FINISH - 2)
        canvas.line((pole, base + scale * GROUND), (pole, base + scale * 130), INK, 3)
        canvas.polygon([(pole - 1, base + scale * y) for y in (130, 104)] + [(pole - 24, base + scale * 117)], RED)
        for enemy_x, _ in self.enemies:
            box(enemy_x, GROUND, PLAYER_WIDTH, PLAYER_HEIGHT, (90, 90, 90), 3)
            box(enemy_x, GROUND + 17, PLAYER_WIDTH, 7, RED)
        box(self.x, self.y, PLAYER_WIDTH, PLAYER_HEIGHT, (118, 68, 164), 3)
        box(self.x + 11, self.y + 17, 7, 7, WHITE, 3)
        canvas.text(f"x {self.x:.0f} of {FINISH:.0f}", (margin, 190))
        canvas.rectangle((150, 186), (638, 8), GREY, 4)
        canvas.rectangle((150, 186), (638 * self.x / FINISH, 8), (118, 68, 164), 4)
        canvas.text(self._action_text(), (margin, 220))
