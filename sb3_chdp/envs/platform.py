"""Platform: a side-view platformer with three jumps and two enemies (Masson et al., 2016)."""

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces

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
TAKE_OFF_SPEED = (0.0, 35.0, 25.0)  # run, hop, leap
RUN_FRAMES = 20
RUN, HOP, LEAP = 0, 1, 2
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
    ## Description
    Run and jump over three platforms with an enemy on each of the first two, and reach the finish line at x = 1035.
    Every action is a macro-action of many frames of 0.05 s. Positions are pixels, y points up.

    ## Action space
    `Tuple(Discrete(3), Tuple(Box(0, 30), Box(0, 720), Box(0, 430)))`

    | k | action | parameter | lasts |
    |---|---|---|---|
    | 0 | run | acceleration of the 20 frames | 20 frames |
    | 1 | hop | length (high jump) | until the player stands on a platform |
    | 2 | leap | length (flat jump) | until the player stands on a platform |

    ## Observation space
    `Box(-1, 1, (9,))`: player x and velocity, active enemy's x and velocity, widths of the present and the next
    platform, gap between them, left edge of the present one, height difference (always -1), each scaled to [-1, 1].

    ## Rewards
    Progress in x divided by 1035. The rewards of an episode add up to x_final / 1035; 1 is success.

    ## Starting state
    At the left end of the first platform, always the same.

    ## Episode end
    Termination: finish line, a fall or an enemy (`info["outcome"]`: "finish", "fall", "enemy"). Truncation: 200 steps.
    `info` has `is_success`, `frames` (frames of the step) and, at the end, `outcome`.

    ## Arguments
    `noise=False` silences all perturbations inside a transition.

    ## Source
    Masson, Ranchod and Konidaris (2016), "Reinforcement Learning with Parameterized Actions"; original package
    gym-platform. Version 0: transitions equal the original's; observations scaled as its wrappers do.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 30}
    screen_size = (1035, 300)
    state_names = ("player_x", "player_y", "player_vx", "player_vy", "enemy1_x", "enemy1_dx", "enemy2_x", "enemy2_dx")

    def __init__(self, noise: bool = True, render_mode: str | None = None):
        super().__init__(noise, render_mode)
        self._set_action_space([[bounds] for bounds in PARAMETER_BOUNDS])
        self.observation_space = spaces.Box(-1.0, 1.0, (9,), dtype=np.float32)
        self._place_at_start()

    def _place_at_start(self) -> None:
        self.x, self.y, self.vx, self.vy = 0.0, GROUND, 0.0, 0.0
        self.enemies = [(left + width - PLAYER_WIDTH, -ENEMY_SPEED) for left, width in PLATFORMS[:2]]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self._place_at_start()
        if self.frame_callback is not None:
            self.frame_callback()
        return self._observation(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        k, (parameter,) = self._decode(action)
        low, high = PARAMETER_BOUNDS[k]
        reward, outcome, frames = self._simulate(k, min(max(parameter, low), high))
        info: dict[str, Any] = {"is_success": outcome == "finish", "frames": frames}
        if outcome:
            info["outcome"] = outcome
        return self._observation(), reward, bool(outcome), False, info

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
        frames = 0
        outcome = ""
        while True:
            frames += 1
            standing = y == GROUND and is_standing(x, y)
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
            if self.frame_callback is not None:
                self.x, self.y, self.vx, self.vy = x, y, vx, vy
                self.frame_callback()
            if x >= FINISH:
                outcome = "finish"
            elif y < GROUND:
                outcome = "fall"
            elif y < GROUND + PLAYER_HEIGHT and any(abs(x - enemy[0]) < PLAYER_WIDTH for enemy in self.enemies):
                outcome = "enemy"
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

    def get_state(self) -> np.ndarray:
        return np.array([self.x, self.y, self.vx, self.vy, *self.enemies[0], *self.enemies[1]])

    def set_state(self, state: np.ndarray) -> None:
        self.x, self.y, self.vx, self.vy, *enemies = self._checked_state(state)
        self.enemies = [(enemies[0], enemies[1]), (enemies[2], enemies[3])]

    def _draw(self, canvas: "Canvas") -> None:
        base = 50.0
        canvas.clear((214, 234, 248))
        for left, width in PLATFORMS:
            canvas.rectangle((left, base), (width, GROUND), (139, 94, 60))
            canvas.rectangle((left, base + GROUND - 6), (width, 6), (86, 152, 72))
        canvas.line((FINISH - 2, base + GROUND), (FINISH - 2, base + GROUND + 90), (40, 40, 40), 3)
        canvas.polygon([(FINISH - 3, 180.0), (FINISH - 3, 160.0), (FINISH - 28, 170.0)], (214, 57, 57))
        for enemy_x, _ in self.enemies:
            canvas.rectangle((enemy_x, base + GROUND), (PLAYER_WIDTH, PLAYER_HEIGHT), (110, 110, 110))
            canvas.rectangle((enemy_x, base + GROUND + 18), (PLAYER_WIDTH, 6), (200, 40, 40))
        canvas.rectangle((self.x, base + self.y), (PLAYER_WIDTH, PLAYER_HEIGHT), (118, 68, 164))
        canvas.rectangle((self.x + 11, base + self.y + 18), (6, 6), (255, 255, 255))
        canvas.text(f"x = {self.x:.0f} / {FINISH:.0f}", (10, 14))
