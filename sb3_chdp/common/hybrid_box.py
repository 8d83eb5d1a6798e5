"""Flat spaces of the rows that buffers and networks see instead of the user's actions."""

from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_chdp.common.spaces import HybridActionSpec


class HybridBox(spaces.Box):
    """
    The flat space ``[k | scaled parameters | latent]`` that buffers and networks see instead of the native one.

    :param native: the user's action space
    :param layout: see :class:`HybridActionSpec`
    :param latent_dim: width of what an algorithm stores behind the parameters
    """

    def __init__(self, native: spaces.Space, layout: str = "auto", latent_dim: int = 0):
        self.native = native
        self.spec = HybridActionSpec(native, layout)
        self.latent_dim = latent_dim
        high = np.ones(self.spec.row_size + latent_dim, dtype=np.float32)
        low = -high
        low[0], high[0] = 0, self.spec.n_discrete_actions - 1
        super().__init__(low, high, dtype=np.float32)

    def to_native(self, rows: np.ndarray) -> list[Any]:
        """:return: n native actions of (n, columns) rows"""
        return self.spec.to_native_batch(rows)

    def sample_rows(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """:return: (n, columns) rows of uniformly random actions; the latents are for the algorithm to fill in"""
        rows = np.zeros((n, *self.shape), dtype=np.float32)
        rows[:, : self.spec.row_size] = self.spec.sample_rows(rng, n)
        return rows

    def add_noise(self, rows: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """
        :param rows: (n, columns) rows
        :param noise: (n, Pmax) noise on the scaled parameters
        :return: the rows with noisy parameters, clipped, padding still 0
        """
        columns = slice(1, self.spec.row_size)
        rows = rows.copy()
        rows[:, columns] = np.clip(rows[:, columns] + noise, -1, 1) * self.spec.mask[rows[:, 0].astype(int)]
        return rows

    def __eq__(self, other: Any) -> bool:
        return type(self) is type(other) and self.__reduce__() == other.__reduce__()

    def __reduce__(self) -> tuple[Any, ...]:
        # The tables of the spec follow from the native space
        return type(self), (self.native, self.spec.layout, self.latent_dim)


class ConcatenatedBox(HybridBox):
    """
    The space of rows ``[k | scaled parameters of all actions | latent]``, for algorithms that put out the parameters of
    all actions at once.

    :param native: the user's action space
    :param layout: see :class:`HybridActionSpec`
    :param latent_dim: width of what an algorithm stores behind the parameters
    """

    def __init__(self, native: spaces.Space, layout: str = "auto", latent_dim: int = 0):
        super().__init__(native, layout, latent_dim)
        self.parameter_columns = slice(1, 1 + self.spec.n_parameters)
        high = np.ones(self.parameter_columns.stop + latent_dim, dtype=np.float32)
        low = -high
        low[0], high[0] = 0, self.spec.n_discrete_actions - 1
        spaces.Box.__init__(self, low, high, dtype=np.float32)

    def to_native(self, rows: np.ndarray) -> list[Any]:
        return self.spec.to_native_batch(self.spec.own_parameters(rows[:, 0].astype(int), rows[:, self.parameter_columns]))

    def sample_rows(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """:return: (n, columns) rows, k uniform over the actions, all parameters uniform in [-1, 1]"""
        rows = np.zeros((n, *self.shape), dtype=np.float32)
        rows[:, 0] = rng.integers(self.spec.n_discrete_actions, size=n)
        rows[:, self.parameter_columns] = rng.uniform(-1.0, 1.0, (n, self.spec.n_parameters))
        return rows


class ScoreBox(HybridBox):
    """
    The space [-1, 1]^(K + P) of algorithms whose actor gives a score to every discrete action.

    Rows are ``[scores | scaled parameters of all actions]``, see :meth:`HybridActionSpec.rows_from_scores`.

    :param native: the user's action space
    :param layout: see :class:`HybridActionSpec`
    """

    def __init__(self, native: spaces.Space, layout: str = "auto"):
        super().__init__(native, layout)
        size = self.spec.n_discrete_actions + self.spec.n_parameters
        spaces.Box.__init__(self, -1.0, 1.0, (size,), dtype=np.float32)

    def to_native(self, rows: np.ndarray) -> list[Any]:
        return self.spec.to_native_batch(self.spec.rows_from_scores(rows))

    def sample_rows(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """:return: (n, K + P) uniform scores and parameters; every discrete action is as likely as the others"""
        return rng.uniform(-1.0, 1.0, (n, *self.shape)).astype(np.float32)

    def __reduce__(self) -> tuple[Any, ...]:
        return ScoreBox, (self.native, self.spec.layout)
