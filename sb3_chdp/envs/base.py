"""What the five environments share: action decoding, noise draws and rendering."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces

if TYPE_CHECKING:
    from sb3_chdp.envs.rendering import Canvas

HybridEnvAction = tuple[int, tuple[np.ndarray, ...]]


class HybridEnv(gym.Env[np.ndarray, Any]):
    """
    Base class of the environments with ``Tuple(Discrete(K), Tuple(Box_1, ..., Box_K))`` actions.

    :param noise: if False, every random perturbation inside a transition is zero (resets stay random)
    :param render_mode: None, "human" or "rgb_array"
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 30}
    action_space: spaces.Tuple
    observation_space: spaces.Box
    #: size of the picture in pixels
    screen_size: ClassVar[tuple[int, int]]
    #: names of the columns of ``get_state()``
    state_names: ClassVar[tuple[str, ...]]

    def __init__(self, noise: bool = True, render_mode: str | None = None):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None or one of {self.metadata['render_modes']}, got {render_mode!r}")
        self.noise = noise
        self.render_mode = render_mode
        self._canvas: Canvas | None = None
        # Called after resets and after every frame inside a step: a window shows them all
        self.frame_callback: Callable[[], Any] | None = self.render if render_mode == "human" else None

    def _set_action_space(self, bounds: list[list[tuple[float, float]]]) -> None:
        """:param bounds: for every discrete action the (low, high) of its parameters"""
        # One Box object per distinct set of bounds would share its generator: every action gets its own
        boxes = []
        for action_bounds in bounds:
            low, high = np.array(action_bounds, dtype=np.float32).reshape(-1, 2).T
            boxes.append(spaces.Box(low, high, dtype=np.float32))
        self.action_space = spaces.Tuple((spaces.Discrete(len(bounds)), spaces.Tuple(boxes)))
        self._n_parameters = [len(action_bounds) for action_bounds in bounds]

    def _decode(self, action: Any) -> tuple[int, list[float]]:
        """
        :param action: (k, (parameters of action 0, ..., parameters of action K - 1))
        :return: k and the parameters of action k
        :raises ValueError: if k is not an action, or its parameters have the wrong size or are not finite
        """
        try:
            k = int(action[0])
            parameters = [float(value) for value in action[1][k]]
        except (TypeError, IndexError) as error:
            raise ValueError(
                f"action must be (k, (parameters_0, ..., parameters_K-1)) as in action_space, got {action!r}"
            ) from error
        # A finite sum of finite numbers is the cheapest test: x - x is 0 only for finite x
        if k < 0 or len(parameters) != self._n_parameters[k] or any(value - value != 0.0 for value in parameters):
            raise ValueError(f"action must be in the action space; got k={k} with parameters {parameters}")
        return k, parameters

    def _normals(self, n: int) -> list[float]:
        """:return: n standard normal draws, zeros without noise"""
        return self.np_random.standard_normal(n).tolist() if self.noise else [0.0] * n

    def _uniforms(self, n: int) -> list[float]:
        """:return: n draws from U(-1, 1), zeros without noise"""
        return self.np_random.uniform(-1.0, 1.0, n).tolist() if self.noise else [0.0] * n

    def get_state(self) -> np.ndarray:
        """:return: the full simulator state, float64, columns as in ``state_names``"""
        raise NotImplementedError

    def set_state(self, state: np.ndarray) -> None:
        """
        Put the simulator into a state.

        :param state: vector with the columns ``state_names``
        """
        raise NotImplementedError

    def _checked_state(self, state: np.ndarray) -> list[float]:
        values = np.asarray(state, dtype=np.float64)
        if values.shape != (len(self.state_names),):
            raise ValueError(f"state must have the columns {self.state_names}, got an array of shape {values.shape}")
        return values.tolist()

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        if self.render_mode is None:
            gym.logger.warn("render() does nothing without a render_mode: gym.make(id, render_mode='rgb_array')")
            return None
        if self._canvas is None:
            # pygame is an optional dependency, imported when it is needed
            from sb3_chdp.envs.rendering import Canvas

            self._canvas = Canvas(self.screen_size, self.render_mode, self.metadata["render_fps"])
        self._draw(self._canvas)
        return self._canvas.present()

    def _draw(self, canvas: "Canvas") -> None:
        raise NotImplementedError

    def close(self) -> None:
        if self._canvas is not None:
            self._canvas.close()
            self._canvas = None
