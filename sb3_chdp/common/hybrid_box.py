"""Flat spaces of the rows that buffers and networks see instead of the user's actions."""

from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_chdp.common.rows import RowLayout
from sb3_chdp.common.spaces import HybridActionSpec


class HybridBox(spaces.Box):
    """
    The flat space ``[k | scaled parameters | latent]`` that buffers and networks see instead of the native one.

    :param native: the user's action space
    :param layout: see :class:`HybridActionSpec`
    :param latent_dim: width of what an algorithm stores behind the parameters
    """

    def __init__(self, native: spaces.Space[Any], layout: str = "auto", latent_dim: int = 0):
        self.native = native
        self.spec = HybridActionSpec(native, layout)
        self.latent_dim = latent_dim
        self.columns = self._make_columns()
        high = np.ones(self.columns.width, dtype=np.float32)
        low = -high
        if "discrete_actions" in self.columns:
            self.columns.view(low, "discrete_actions")[:] = 0
            self.columns.view(high, "discrete_actions")[:] = self.spec.n_discrete_actions - 1
        if "masks" in self.columns:
            self.columns.view(low, "masks")[:] = 0
        super().__init__(low, high, dtype=np.float32)

    def _make_columns(self) -> RowLayout:
        return RowLayout(discrete_actions=1, parameters=self.spec.max_parameters, latents=self.latent_dim)

    def to_native(self, rows: np.ndarray) -> list[Any]:
        """:return: n native actions of (n, columns) rows"""
        return self.spec.to_native_batch(rows)

    def sample_rows(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """:return: (n, columns) rows of uniformly random actions; the latents are for the algorithm to fill in"""
        rows, columns = self.spec.sample_rows(rng, n), self.spec.columns
        choices, parameters = columns.discrete_actions(rows), columns.view(rows, "parameters")
        return self.columns.pack(discrete_actions=choices, parameters=parameters).astype(np.float32)

    def sample(self, mask: None = None, probability: None = None) -> np.ndarray:
        """:return: (columns,) row of a uniformly random action, see :meth:`sample_rows`"""
        return self.sample_rows(self.np_random, 1)[0]

    def contains(self, x: Any) -> bool:
        """Whether x is a row inside the bounds; the index of the discrete action has to be a whole number."""
        if not super().contains(x):
            return False
        return "scores" in self.columns or bool(self.columns.view(x, "discrete_actions") == self.columns.discrete_actions(x))

    def add_noise(self, rows: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """
        :param rows: (n, columns) rows
        :param noise: (n, Pmax) noise on the scaled parameters
        :return: the rows with noisy parameters, clipped, padding still 0
        """
        rows = rows.copy()
        parameters = self.columns.view(rows, "parameters")
        parameters[:] = np.clip(parameters + noise, -1, 1) * self.spec.mask[self.columns.discrete_actions(rows)]
        return rows

    def __repr__(self) -> str:
        return f"{type(self).__name__} of {self.native}"

    def __eq__(self, other: Any) -> bool:
        return type(self) is type(other) and self.__reduce__() == other.__reduce__()

    def __reduce__(self) -> tuple[Any, ...]:
        # The tables of the spec follow from the native space
        return type(self), (self.native, self.spec.layout, self.latent_dim)


class ConcatenatedBox(HybridBox):
    """
    The space of rows ``[k | scaled parameters of all actions | masks]``, for algorithms that put out the parameters of
    all actions at once.

    :param native: the user's action space
    :param layout: see :class:`HybridActionSpec`
    :param with_masks: whether there are K columns for which discrete actions were allowed (1) or not (0)
    """

    def __init__(self, native: spaces.Space[Any], layout: str = "auto", with_masks: bool = False):
        self.with_masks = with_masks
        super().__init__(native, layout)

    def _make_columns(self) -> RowLayout:
        masks = {"masks": self.spec.n_discrete_actions} if self.with_masks else {}
        return RowLayout(discrete_actions=1, parameters=self.spec.n_parameters, **masks)

    def to_native(self, rows: np.ndarray) -> list[Any]:
        choices, parameters = self.columns.discrete_actions(rows), self.columns.view(rows, "parameters")
        return self.spec.to_native_batch(self.spec.own_parameters(choices, parameters))

    def sample_rows(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """:return: (n, columns) rows, k uniform over the actions, all parameters uniform in [-1, 1]"""
        choices = rng.integers(self.spec.n_discrete_actions, size=n)
        parameters = rng.uniform(-1.0, 1.0, (n, self.spec.n_parameters))
        masks = {"masks": np.ones((n, self.spec.n_discrete_actions))} if self.with_masks else {}
        return self.columns.pack(discrete_actions=choices, parameters=parameters, **masks).astype(np.float32)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.native, self.spec.layout, self.with_masks)


class ScoreBox(ConcatenatedBox):
    """
    The space [-1, 1]^(K + P) of rows ``[scores | scaled parameters of all actions]``, for algorithms whose actor gives a
    score to every discrete action, of which the highest decides.

    :param native: the user's action space
    :param layout: see :class:`HybridActionSpec`
    """

    def __init__(self, native: spaces.Space[Any], layout: str = "auto"):
        super().__init__(native, layout)

    def _make_columns(self) -> RowLayout:
        return RowLayout(scores=self.spec.n_discrete_actions, parameters=self.spec.n_parameters)

    def sample_rows(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """:return: (n, K + P) uniform scores and parameters; every discrete action is as likely as the others"""
        return rng.uniform(-1.0, 1.0, (n, self.columns.width)).astype(np.float32)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.native, self.spec.layout)
