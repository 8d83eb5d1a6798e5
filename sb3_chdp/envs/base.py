"""What the environments share: decoding of actions, reset options, noise draws, states and pictures."""

from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_chdp.common.arguments import is_number

if TYPE_CHECKING:
    from sb3_chdp.envs.rendering import Canvas

# Frames after which a step of Goal is cut off; never seen
FRAME_LIMIT = 10_000


class HybridEnv(gym.Env[np.ndarray, Any]):
    """
    Base class of the environments with ``Tuple(Discrete(K), Tuple(Box_1, ..., Box_K))`` actions.

    :param noise: if False, every random perturbation inside a transition is zero (resets stay random)
    :param render_mode: None, "human" (a window that shows every frame inside a step) or "rgb_array"
    :raises ValueError: if ``render_mode`` is another one
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 30}
    action_space: spaces.Tuple
    observation_space: spaces.Box
    #: size of the picture in pixels
    screen_size: ClassVar[tuple[int, int]]
    #: keys that ``reset(options=...)`` understands
    option_names: ClassVar[tuple[str, ...]]
    #: the ``info["outcome"]`` that is success
    success_outcome: ClassVar[str]
    #: names of the discrete actions, for the picture
    action_names: ClassVar[tuple[str, ...]] = ()

    def __init__(self, noise: bool = True, render_mode: str | None = None):
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be None or one of {self.metadata['render_modes']}, got {render_mode!r}")
        self.noise = noise
        self.render_mode = render_mode
        self._canvas: Canvas | None = None
        self._pictures: list[np.ndarray] | None = None
        self._pictures_wanted = False
        # For the picture only
        self._action: tuple[int, list[float]] | None = None
        self._outcome = ""

    def _set_action_space(self, bounds: list[list[tuple[float, float]]]) -> None:
        """:param bounds: for every discrete action the (low, high) of its parameters"""
        # One Box object per distinct set of bounds would share its generator: every action gets its own
        boxes = []
        for action_bounds in bounds:
            low, high = np.array(action_bounds, dtype=np.float32).reshape(-1, 2).T
            boxes.append(spaces.Box(low, high, dtype=np.float32))
        self.action_space = spaces.Tuple((spaces.Discrete(len(bounds)), spaces.Tuple(boxes)))
        self._n_parameters = [len(action_bounds) for action_bounds in bounds]

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """
        Start an episode.

        :param seed: seed of all that is random; None goes on with the stream
        :param options: where the episode starts, see the environment. An option does not change the random stream
        :return: observation and an empty info
        :raises ValueError: for an unknown option or a bad value
        """
        options = options or {}
        for name in options:
            if name not in self.option_names:
                raise ValueError(f"options[{name!r}] is not known, reset understands {', '.join(self.option_names)}")
        super().reset(seed=seed)
        self._start(options)
        self._action = None
        self._frame_done("")
        return self._observation(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        Take one action, which may last many frames.

        :param action: (k, (parameters of action 0, ..., parameters of action K - 1)); only those of action k count
        :return: observation, reward, terminated, truncated, info; ``info`` has ``is_success``, ``frames`` (of this step)
            and at a termination ``outcome``
        :raises ValueError: if k is not an action, or its parameters have the wrong size or are not finite
        """
        self._action = k, parameters = self._decode(action)
        if not self._pictures_wanted:
            self._pictures = None
        self._pictures_wanted = False
        reward, outcome, frames = self._advance(k, parameters)
        info: dict[str, Any] = {"is_success": outcome == self.success_outcome, "frames": frames}
        self._outcome = outcome
        if outcome:
            info["outcome"] = outcome
            return self._observation(), reward, True, False, info
        return self._observation(), reward, False, frames >= FRAME_LIMIT, info

    def _decode(self, action: Any) -> tuple[int, list[float]]:
        """:return: k and the parameters of action k"""
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

    def get_state(self) -> dict[str, Any]:
        """
        All that decides the future of the episode, given the actions.

        :return: the simulator's quantities by name, and ``np_random``, the state of the generator; can be pickled
        """
        return {**self._simulator_state(), "np_random": self.np_random.bit_generator.state}

    def set_state(self, state: dict[str, Any]) -> np.ndarray:
        """
        Go on from a state: the same actions then lead to the same steps. What the state does not name stays as it is.

        :param state: a result of ``get_state()``, or some of its entries
        :return: the observation there
        :raises ValueError: for an unknown name or a quantity that is not finite
        """
        present = self.get_state()
        if unknown := sorted(set(state) - set(present)):
            raise ValueError(f"state must have keys of get_state() ({', '.join(present)}), got {', '.join(unknown)}")
        new = {**present, **state}
        generator_state = new.pop("np_random")
        for name, value in new.items():
            if not is_number(value):
                raise ValueError(f"state[{name!r}] must be a finite number, got {value!r}")
        self.np_random.bit_generator.state = generator_state
        self._set_simulator_state({name: float(value) for name, value in new.items()})
        self._action, self._outcome = None, ""
        return self._observation()

    def __getstate__(self) -> dict[str, Any]:
        # Surfaces of pygame cannot be copied
        return {**self.__dict__, "_canvas": None}

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """:return: (height, width, 3) uint8 picture of the present frame; None if it went to a window"""
        if self.render_mode is None:
            gym.logger.warn("render() does nothing without a render_mode: gym.make(id, render_mode='rgb_array')")
            return None
        if self._canvas is None:
            # pygame is an optional dependency, imported when it is needed
            from sb3_chdp.envs.rendering import Canvas

            self._canvas = Canvas(self.screen_size, self.render_mode, self.metadata["render_fps"])
        self._draw(self._canvas)
        if self._outcome:
            success = self._outcome == self.success_outcome
            self._canvas.banner(f"{'success' if success else 'failed'}: {self._outcome}", success)
        return self._canvas.present(hold=bool(self._outcome))

    def render_frames(self) -> list[np.ndarray]:
        """
        Pictures of all frames since the last call, those inside the step too. The first call gives the present one.

        Frames are drawn for the step that follows a call, and no longer. The last one of an episode is repeated for half a
        second, so that a video shows how it ended.

        :return: (height, width, 3) uint8 pictures, ``metadata["render_fps"]`` a second
        :raises ValueError: if ``render_mode`` is not "rgb_array"
        """
        if self.render_mode != "rgb_array":
            raise ValueError(f"render_mode must be 'rgb_array' for render_frames(), got {self.render_mode!r}")
        pictures = self._pictures
        if pictures is None:
            pictures = [self._picture()]
        self._pictures, self._pictures_wanted = [], True
        return pictures

    def _picture(self) -> np.ndarray:
        picture = self.render()
        assert picture is not None
        return picture

    @property
    def _is_watched(self) -> bool:
        return self.render_mode == "human" or self._pictures is not None

    def _frame_done(self, outcome: str) -> None:
        """Show a frame to whoever watches; to be called after each, its outcome known."""
        self._outcome = outcome
        if self._pictures is not None:
            self._pictures += [self._picture()] * (1 + self.metadata["render_fps"] // 2 * bool(outcome))
        if self.render_mode == "human":
            self.render()

    def _action_text(self) -> str:
        """:return: name and parameters of the last action"""
        if self._action is None:
            return ""
        k, parameters = self._action
        return f"{self.action_names[k]} {', '.join(f'{value:.4g}' for value in parameters)}"

    def close(self) -> None:
        if self._canvas is not None:
            self._canvas.close()
            self._canvas = None

    def _start(self, options: dict[str, Any]) -> None:
        """Put the simulator at the start of an episode."""
        raise NotImplementedError

    def _advance(self, k: int, parameters: list[float]) -> tuple[float, str, int]:
        """
        Run the frames of one step.

        :return: reward, outcome ("" while the episode goes on), number of frames
        """
        raise NotImplementedError

    def _observation(self) -> np.ndarray:
        raise NotImplementedError

    def _simulator_state(self) -> dict[str, float]:
        raise NotImplementedError

    def _set_simulator_state(self, state: dict[str, float]) -> None:
        raise NotImplementedError

    def _draw(self, canvas: "Canvas") -> None:
        raise NotImplementedError
