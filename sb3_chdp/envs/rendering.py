"""A small drawing surface over pygame. Coordinates are pixels, y points up."""

from typing import Any

import gymnasium as gym
import numpy as np

try:
    import pygame
    from pygame import gfxdraw
except ImportError as error:
    raise gym.error.DependencyNotInstalled("Rendering needs pygame: pip install 'sb3-chdp[render]'") from error

Colour = tuple[int, int, int]
Position = tuple[float, float]


class Canvas:
    """
    :param size: width and height in pixels
    :param render_mode: "human" opens a window, "rgb_array" draws in memory
    :param fps: pictures per second of the window
    """

    def __init__(self, size: tuple[int, int], render_mode: str, fps: int):
        self.size, self.fps = size, fps
        self.window: pygame.Surface | None = None
        pygame.font.init()
        if render_mode == "human":
            pygame.display.init()
            self.window = pygame.display.set_mode(size)
            self.clock = pygame.time.Clock()
        self.surface = pygame.Surface(size)
        self.font = pygame.font.Font(None, 24)

    def _pixel(self, position: Position) -> tuple[int, int]:
        # Far outside the picture gfxdraw's 16-bit coordinates would overflow
        x, y = (int(np.clip(round(value), -10_000, 10_000)) for value in position)
        return x, self.size[1] - y

    def clear(self, colour: Colour) -> None:
        self.surface.fill(colour)

    def rectangle(self, corner: Position, size: Position, colour: Colour) -> None:
        """:param corner: lower left"""
        x, y = self._pixel((corner[0], corner[1] + size[1]))
        pygame.draw.rect(self.surface, colour, (x, y, round(size[0]), round(size[1])))

    def line(self, start: Position, end: Position, colour: Colour, width: int) -> None:
        pygame.draw.line(self.surface, colour, self._pixel(start), self._pixel(end), width)

    def polygon(self, points: list[Position], colour: Colour) -> None:
        pixels: Any = [self._pixel(point) for point in points]
        gfxdraw.filled_polygon(self.surface, pixels, colour)
        gfxdraw.aapolygon(self.surface, pixels, colour)

    def disc(self, centre: Position, radius: float, colour: Colour) -> None:
        x, y = self._pixel(centre)
        gfxdraw.filled_circle(self.surface, x, y, round(radius), colour)
        gfxdraw.aacircle(self.surface, x, y, round(radius), colour)

    def circle(self, centre: Position, radius: float, colour: Colour, width: int) -> None:
        pygame.draw.circle(self.surface, colour, self._pixel(centre), round(radius), width)

    def arrow(self, start: Position, end: Position, colour: Colour) -> None:
        self.line(start, end, colour, 4)
        tail, tip = np.array(start), np.array(end)
        length = np.linalg.norm(tip - tail)
        if length > 1e-9:
            along = (tip - tail) / length
            across = np.array([-along[1], along[0]])
            base = tip - 12 * along
            points = [tuple(point) for point in (tip + 4 * along, base + 7 * across, base - 7 * across)]
            self.polygon(points, colour)

    def text(self, text: str, corner: Position) -> None:
        """:param corner: lower left"""
        image = self.font.render(text, True, (30, 30, 30))
        x, y = self._pixel(corner)
        self.surface.blit(image, (x, y - image.get_height()))

    def present(self) -> np.ndarray | None:
        """:return: (height, width, 3) uint8 picture, None if it went to a window"""
        if self.window is None:
            return np.transpose(pygame.surfarray.array3d(self.surface), (1, 0, 2))
        self.window.blit(self.surface, (0, 0))
        pygame.event.pump()
        pygame.display.flip()
        self.clock.tick(self.fps)
        return None

    def close(self) -> None:
        if self.window is not None:
            pygame.display.quit()
