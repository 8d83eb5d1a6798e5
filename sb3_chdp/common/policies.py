"""Policies that answer in the user's own action space."""

import io
import pathlib
from typing import Any, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import CombinedExtractor, NatureCNN

from sb3_chdp.common.checks import LARGEST, check_numbers
from sb3_chdp.common.hybrid_box import HybridBox
from sb3_chdp.common.safe_zip import load_policy, refuse, save_policy

SelfHybridPolicy = TypeVar("SelfHybridPolicy", bound="HybridPolicy")


class HybridPolicy(BasePolicy):
    """
    Base class of policies for hybrid action spaces.

    Networks work on rows ``[k | scaled parameters | latent]`` (:class:`HybridBox`); ``predict`` returns native actions.
    Subclasses implement ``_predict``, which returns rows.
    """

    action_space: HybridBox

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[Any, tuple[np.ndarray, ...] | None]:
        """
        Get native actions from observations.

        :param observation: the input observation
        :param state: unused, returned as it is (these policies are not recurrent)
        :param episode_start: unused
        :param deterministic: whether to return the same action for the same observation every time
        :return: one native action for one observation, a list of n native actions for n observations; and ``state``
        :raises ValueError: if the observation has another shape, or holds NaN, infinity or numbers beyond 1e15
        """
        return self._predict_native(observation, deterministic), state

    def predict_rows(self, observation: np.ndarray | dict[str, np.ndarray], deterministic: bool = False) -> np.ndarray:
        """
        Like :meth:`predict`, for code that needs arrays.

        :return: rows ``[k | scaled parameters | latent]``, (n, columns) for n observations, (columns,) for one
        """
        rows, vectorized_env = self._predict_rows(observation, deterministic)
        return rows if vectorized_env else rows[0]

    def _predict_native(self, observation: np.ndarray | dict[str, np.ndarray], deterministic: bool, **kwargs: Any) -> Any:
        """:return: native actions; further arguments are those of the subclass's ``_predict``"""
        rows, vectorized_env = self._predict_rows(observation, deterministic, **kwargs)
        actions = self.action_space.to_native(rows)
        return actions if vectorized_env else actions[0]

    def _predict_rows(
        self, observation: np.ndarray | dict[str, np.ndarray], deterministic: bool, **kwargs: Any
    ) -> tuple[np.ndarray, bool]:
        self.set_training_mode(False)
        # Common mistake, see https://github.com/DLR-RM/stable-baselines3/issues/1694
        if isinstance(observation, tuple) and len(observation) == 2 and isinstance(observation[1], dict):
            raise ValueError(
                "predict() got a tuple instead of an array or a dict: `obs, info = env.reset()` (Gymnasium) "
                "and `obs = vec_env.reset()` (SB3) differ"
            )
        obs_tensor, vectorized_env = self.obs_to_tensor(observation)
        tensors = obs_tensor if isinstance(obs_tensor, dict) else {"": obs_tensor}
        if not all(bool((tensor.abs() <= LARGEST).all()) for tensor in tensors.values() if tensor.is_floating_point()):
            parts = observation if isinstance(observation, dict) else {"observation": np.asarray(observation)}
            for name, part in parts.items():
                check_numbers(name, np.asarray(part) if vectorized_env else np.asarray(part)[None])
        with th.no_grad():
            rows = self._predict(obs_tensor, deterministic=deterministic, **kwargs)
        return rows.cpu().numpy(), vectorized_env

    def save(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """
        Save the policy, its arguments as JSON. Custom ones are pickled, as SB3 does it, and need ``load(..., trusted=True)``.

        :param path: the file
        """
        if not save_policy(self, path):
            super().save(path)  # type: ignore[arg-type]

    @classmethod
    def load(
        cls: type[SelfHybridPolicy],
        path: str | pathlib.Path | io.BufferedIOBase,
        device: th.device | str = "auto",
        trusted: bool = False,
    ) -> SelfHybridPolicy:
        """
        Load the policy. No code of the file's runs unless it is ``trusted``.

        :param path: the file
        :param device: Device on which the policy should be loaded.
        :param trusted: whether a pickled file may be read, which runs whatever code the file's author put there
        :return: the policy
        :raises ValueError: if the file is of another class or version, or if it is pickled and not trusted
        """
        policy = load_policy(cls, path, device)
        if policy is None:
            if not trusted:
                raise refuse(path, "holds a policy in pickled form")
            policy = super().load(path, device)  # type: ignore[arg-type]
        return policy

    @property
    def noise_dim(self) -> int:
        """Width of the action noise that :meth:`noisy_rows` takes"""
        return self.action_space.spec.max_parameters

    def noisy_rows(self, observation: np.ndarray | dict[str, np.ndarray], noise: np.ndarray) -> np.ndarray:
        """
        :param observation: n observations
        :param noise: (n, noise_dim) action noise
        :return: rows of sampled actions with the noise added
        """
        return self.action_space.add_noise(self.predict_rows(observation), noise)

    def random_rows(self, rng: np.random.Generator, n: int) -> np.ndarray:
        """
        Uniformly random actions, for the warm-up and for exploration.

        :param rng: random generator
        :param n: number of rows
        :return: (n, columns) rows
        """
        return self.action_space.sample_rows(rng, n)


class CnnFeatures(HybridPolicy):
    """Mixin for policies of image observations: ``features_extractor_class`` is :class:`NatureCNN` by default."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{"features_extractor_class": NatureCNN, **kwargs})


class CombinedFeatures(HybridPolicy):
    """Mixin for policies of dict observations: ``features_extractor_class`` is :class:`CombinedExtractor` by default."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{"features_extractor_class": CombinedExtractor, **kwargs})
