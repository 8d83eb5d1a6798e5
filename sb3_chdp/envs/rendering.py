"""A small drawing surface over pygame. Coordinates are pixels, y points up."""

import gymnasium as gym
import numpy as np

try:
    import pygame
except ImportError as error:
    raise gym.error.DependencyNotInstalled("Rendering needs pygame: pip install '.[render]' in a clone") from error

Colour = tuple[int, int, int]
Position = tuple[float, float]

INK, WHITE, GREY = (45, 45, 45), (255, 255, 255), (205, 205, 205)
BLUE, RED, ORANGE, GREEN = (38, 92, 190), (200, 50, 50), (222, 120, 20), (36, 140, 70)
# Everything is drawn larger and scaled down, which smooths edges
OVERSAMPLING = 2


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
            self._open()
            self.clock = pygame.time.Clock()
        self.surface = pygame.Surface((OVERSAMPLING * size[0], OVERSAMPLING * size[1]))
        self.fonts: dict[int, pygame.font.Font] = {}

    def _open(self) -> None:
        pygame.display.init()
        self.window = pygame.display.set_mode(self.size)

    def _pixel(self, position: Position) -> tuple[int, int]:
        # Far outside the picture pygame's integers would overflow
        x, y = (int(np.clip(round(OVERSAMPLING * value), -20_000, 20_000)) for value in position)
        return x, OVERSAMPLING * self.size[1] - y

    def clear(self, colour: Colour) -> None:
        self.surface.fill(colour)

    def rectangle(self, corner: Position, size: Position, colour: Colour, rounding: float = 0) -> None:
        """:param corner: lower left"""
        x, y = self._pixel((corner[0], corner[1] + size[1]))
        width, height = (round(OVERSAMPLING * value) for value in size)
        pygame.draw.rect(self.surface, colour, (x, y, width, height), border_radius=round(OVERSAMPLING * rounding))

    def line(self, start: Position, end: Position, colour: Colour, width: float) -> None:
        pygame.draw.line(self.surface, colour, self._pixel(start), self._pixel(end), round(OVERSAMPLING * width))

    def polygon(self, points: list[Position], colour: Colour) -> None:
        pygame.draw.polygon(self.surface, colour, [self._pixel(point) for point in points])

    def disc(self, centre: Position, radius: float, colour: Colour) -> None:
        pygame.draw.circle(self.surface, colour, self._pixel(centre), round(OVERSAMPLING * radius))

    def circle(self, centre: Position, radius: float, colour: Colour, width: float) -> None:
        pixels = round(OVERSAMPLING * radius), round(OVERSAMPLING * width)
        pygame.draw.circle(self.surface, colour, self._pixel(centre), *pixels)

    def arrow(self, start: Position, end: Position, colour: Colour) -> None:
        tail, tip = np.array(start), np.array(end)
        length = np.linalg.norm(tip - tail)
        if length < 1e-9:
            return
        along = (tip - tail) / length
        across = np.array([-along[1], along[0]])
        base = tip - 12 * along
        self.line(start, (base[0], base[1]), colour, 4)
        self.polygon([(x, y) for x, y in (tip, base + 7 * across, base - 7 * across)], colour)

    def text(self, text: str, position: Position, colour: Colour = INK, size: int = 22, centred: bool = False) -> None:
        """:param position: left end of the text, or its centre; on half of its height"""
        if size not in self.fonts:
            self.fonts[size] = pygame.font.Font(None, OVERSAMPLING * size)
        image = self.fonts[size].render(text, True, colour)
        x, y = self._pixel(position)
        self.surface.blit(image, (x - image.get_width() // 2 if centred else x, y - image.get_height() // 2))

    def banner(self, text: str, success: bool) -> None:
        """A line in the upper right corner that says how the episode ended."""
        x, y = self.size[0] - 208, self.size[1] - 31
        self.rectangle((x, y), (200, 28), GREEN if success else RED, rounding=8)
        self.text(text, (x + 100, y + 14), WHITE, 26, centred=True)

    def present(self, hold: bool = False) -> np.ndarray | None:
        """
        :param hold: show the picture in the window for half a second more
        :return: (height, width, 3) uint8 picture, None if it went to a window
        """
        picture = pygame.transform.smoothscale(self.surface, self.size)
        if self.window is None:
            return np.transpose(pygame.surfarray.array3d(picture), (1, 0, 2))
        if pygame.display.get_surface() is not self.window:
            # pygame has one window, which another environment has closed or taken
            self._open()
        self.window.blit(picture, (0, 0))
        for _ in range(1 + self.fps // 2 * hold):
            pygame.event.pump()
            pygame.display.flip()
            self.clock.tick(self.fps)
        return None

    def close(self) -> None:
        if self.window is not None:
            pygame.display.quit()
