"""Flat spaces of the rows that buffers and networks see instead of the user's actions."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_chdp.common.rows import BITS, MASK_PARTS, RowLayout
from sb3_chdp.common.spaces import HybridActionSpec

# Score of allowed discrete actions at least; that of others is -1
LOWEST_ALLOWED = -0.999
# SB3 wants bounds that are finite
FLOAT32_MAX = np.finfo(np.float32).max


class HybridBox(spaces.Box):
    """
    The flat space ``[k | scaled parameters | latent]`` that buffers and networks see instead of the native one.

    :param native: the user's action space
    :param layout: see :class:`HybridActionSpec`
    :param stored_latent_dim: width of what an algorithm stores behind the parameters
    :param state_parts: what else the rows hold, of ``MASK_PARTS`` and ``RETURN_PARTS``
    """

    def __init__(
        self, native: spaces.Space[Any], layout: str = "auto", stored_latent_dim: int = 0, state_parts: tuple[str, ...] = ()
    ):
        self.native = native
        self.spec = HybridActionSpec(native, layout)
        self.stored_latent_dim = stored_latent_dim
        self.state_parts = tuple(state_parts)
        radices = self.spec.radices
        mask_width = -(-sum(radices) // BITS)
        widths = {part: mask_width if part in MASK_PARTS else 1 for part in self.state_parts}
        self.columns = RowLayout(radices, **self._widths(), **widths)
        high = np.ones(self.columns.width, dtype=np.float32)
        low = -high
        if "discrete_actions" in self.columns:
            self.columns.view(low, "discrete_actions")[:] = 0
            self.columns.view(high, "discrete_actions")[:] = np.array(self.spec.radices) - 1
        for part in self.state_parts:
            bounds = (0, 2**BITS - 1) if part in MASK_PARTS else (-FLOAT32_MAX, FLOAT32_MAX)
            self.columns.view(low, part)[:], self.columns.view(high, part)[:] = bounds
        super().__init__(low, high, dtype=np.float32)

    def _widths(self) -> dict[str, int]:
        """:return: columns of an action by name"""
        return dict(
            discrete_actions=len(self.spec.radices), parameters=self.spec.max_parameters, latents=self.stored_latent_dim
        )

    def to_native(self, rows: np.ndarray) -> list[Any]:
        """:return: n native actions of (n, columns) rows"""
        return self.spec.to_native_batch(rows)

    def sample_rows(self, rng: np.random.Generator, n: int, masks: np.ndarray | None = None) -> np.ndarray:
        """
        :param rng: random generator
        :param n: number of rows
        :param masks: (n, sum of the radices) False for values that may not be taken
        :return: (n, columns) rows of uniformly random actions; the latents are for the algorithm to fill in
        """
        rows, columns = self.spec.sample_rows(rng, n, masks), self.spec.columns
        choices, parameters = columns.discrete_actions(rows), columns.view(rows, "parameters")
        return self.columns.pack(discrete_actions=choices, parameters=parameters).astype(np.float32)

    def sample(self, mask: None = None, probability: None = None) -> np.ndarray:
        """:return: (columns,) row of a uniformly random action, see :meth:`sample_rows`"""
        return self.sample_rows(self.np_random, 1)[0]

    def contains(self, x: Any) -> bool:
        """Whether x is a row inside the bounds; the index of the discrete action has to be a whole number."""
        if not super().contains(x):
            return False
        return "scores" in self.columns or bool(
            (self.columns.view(x, "discrete_actions") == self.columns.discrete_actions(x)).all()
        )

    def add_noise(self, rows: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """
        :param rows: (n, columns) rows
        :param noise: (n, Pmax) noise on the scaled parameters
        :return: the rows with noisy parameters, clipped, padding still 0
        """
        rows = rows.copy()
        parameters = self.columns.view(rows, "parameters")
        options = self.spec.options_of(self.columns.discrete_actions(rows))
        parameters[:] = np.clip(parameters + noise, -1, 1) * self.spec.parameter_mask[options]
        return rows

    def __repr__(self) -> str:
        return f"{type(self).__name__} of {self.native}"

    def __eq__(self, other: Any) -> bool:
        return type(self) is type(other) and self.__reduce__()[:2] == other.__reduce__()[:2]

    def __reduce__(self) -> tuple[Any, ...]:
        # The tables of the spec follow from the native space
        arguments = (self.native, self.spec.layout, self.stored_latent_dim, self.state_parts)
        return type(self), arguments, {"_np_random": self._np_random}


class ConcatenatedBox(HybridBox):
    """
    The space of rows ``[k | scaled parameters of all actions]``, for algorithms that put out the parameters of all actions
    at once.

    :param native: the user's action space
    :param layout: see :class:`HybridActionSpec`
    :param state_parts: see :class:`HybridBox`
    """

    def __init__(self, native: spaces.Space[Any], layout: str = "auto", state_parts: tuple[str, ...] = ()):
        super().__init__(native, layout, state_parts=state_parts)

    def _widths(self) -> dict[str, int]:
        return dict(discrete_actions=len(self.spec.radices), parameters=self.spec.n_parameters)

    def to_native(self, rows: np.ndarray) -> list[Any]:
        choices, parameters = self.columns.discrete_actions(rows), self.columns.view(rows, "parameters")
        return self.spec.to_native_batch(self.spec.own_parameters(choices, parameters))

    def sample_rows(self, rng: np.random.Generator, n: int, masks: np.ndarray | None = None) -> np.ndarray:
        """:return: (n, columns) rows, k uniform over the actions, all parameters uniform in [-1, 1]"""
        choices = self.spec.sample_choices(rng, n, masks)
        parameters = rng.uniform(-1.0, 1.0, (n, self.spec.n_parameters))
        return self.columns.pack(discrete_actions=choices, parameters=parameters).astype(np.float32)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.native, self.spec.layout, self.state_parts), {"_np_random": self._np_random}


class ScoreBox(ConcatenatedBox):
    """
    The space of rows ``[scores | scaled parameters of all actions]``, all in [-1, 1], for algorithms whose actor gives a score
    to every discrete action, of which the highest decides; in a factored space to every value of every choice, and the highest
    of each decides.

    The arguments are those of :class:`ConcatenatedBox`.
    """

    def _widths(self) -> dict[str, int]:
        return dict(scores=sum(self.spec.radices), parameters=self.spec.n_parameters)

    def sample_rows(self, rng: np.random.Generator, n: int, masks: np.ndarray | None = None) -> np.ndarray:
        """:return: (n, columns) uniform scores and parameters; every discrete action is as likely as the others"""
        actions = rng.uniform(-1.0, 1.0, (n, self.columns.action_width)).astype(np.float32)
        if masks is not None:
            actions = self.mask_scores(th.as_tensor(actions), th.as_tensor(masks)).numpy()
        rows = np.zeros((n, self.columns.width), dtype=np.float32)
        rows[:, : self.columns.action_width] = actions
        return rows

    def mask_scores(self, outputs: th.Tensor, masks: th.Tensor) -> th.Tensor:
        """
        :param outputs: (B, K + P) scores and parameters, or rows
        :param masks: (B, number of scores) False for what may not be taken
        :return: the same with the lowest score, -1, for these, and higher ones for all others
        """
        scores = self.columns.view(outputs, "scores")
        # The gradient of a score at the lower end is kept, or it could not get away from there
        lifted = scores + (scores.clamp(min=LOWEST_ALLOWED) - scores).detach()
        scores = th.where(masks, lifted, -1.0)
        return th.cat([scores, outputs[:, scores.shape[1] :]], dim=1)
