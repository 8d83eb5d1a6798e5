"""Policies that answer in the user's own action space."""

import io
import pathlib
from abc import abstractmethod
from typing import Any, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import CombinedExtractor, NatureCNN
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_chdp.common.arguments import check_device
from sb3_chdp.common.checks import LARGEST, check_numbers
from sb3_chdp.common.hybrid_box import HybridBox
from sb3_chdp.common.masks import read_masks
from sb3_chdp.common.safe_zip import load_policy, refuse, save_policy

SelfHybridPolicy = TypeVar("SelfHybridPolicy", bound="HybridPolicy")


class HybridPolicy(BasePolicy):
    """
    Base class of policies for hybrid action spaces.

    Networks work on rows of ``action_space``, see :class:`HybridBox`; ``predict`` returns native actions.
    ``predict`` takes masks as environments give them; all other methods take what :func:`read_masks` makes of them, (n, K)
    booleans, or None.
    """

    action_space: HybridBox

    @abstractmethod
    def _predict(
        self, observation: PyTorchObs, deterministic: bool = False, action_masks: th.Tensor | None = None
    ) -> th.Tensor:
        """:return: (n, columns) rows"""

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        action_masks: np.ndarray | None = None,
    ) -> tuple[Any, tuple[np.ndarray, ...] | None]:
        """
        Get native actions from observations.

        :param observation: the input observation
        :param state: unused, returned as it is (these policies are not recurrent)
        :param episode_start: unused
        :param deterministic: whether to return the same action for the same observation every time
        :param action_masks: (M,) or (n, M) False for discrete actions that may not be taken, see :func:`read_masks`
        :return: one native action for one observation, a list of n native actions for n observations; and ``state``
        :raises ValueError: if the observation has another shape, or holds NaN, infinity or numbers beyond 1e15; for masks that
            do not fit or allow nothing
        """
        obs_tensor, vectorized_env = self._checked_observation(observation)
        n = len(next(iter(obs_tensor.values())) if isinstance(obs_tensor, dict) else obs_tensor)
        if action_masks is not None:
            action_masks = read_masks(self.action_space.spec, action_masks, n)
        if n == 0:
            return [], state
        actions = self.action_space.to_native(self._rows(obs_tensor, deterministic, action_masks))
        return (actions if vectorized_env else actions[0]), state

    def predict_rows(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        deterministic: bool = False,
        action_masks: np.ndarray | None = None,
    ) -> np.ndarray:
        """
        Like :meth:`predict`, for code that needs arrays.

        :param observation: the input observation
        :param deterministic: whether to return the same action for the same observation every time
        :param action_masks: (n, K) False for discrete actions that may not be taken
        :return: rows of ``action_space``, (n, columns) for n observations, (columns,) for one
        """
        obs_tensor, vectorized_env = self._checked_observation(observation)
        rows = self._rows(obs_tensor, deterministic, action_masks)
        return rows if vectorized_env else rows[0]

    def mask_tensor(self, action_masks: np.ndarray | None) -> th.Tensor | None:
        """:return: masks on the policy's device"""
        return None if action_masks is None else th.as_tensor(action_masks, device=self.device)

    def _rows(self, obs: PyTorchObs, deterministic: bool, action_masks: np.ndarray | None) -> np.ndarray:
        self.set_training_mode(False)
        with th.no_grad():
            return self._predict(obs, deterministic, self.mask_tensor(action_masks)).cpu().numpy()

    def _checked_observation(self, observation: np.ndarray | dict[str, np.ndarray]) -> tuple[PyTorchObs, bool]:
        """:return: the observation as a tensor or a dict of them, and whether it is one of several environments"""
        # Common mistake, see https://github.com/DLR-RM/stable-baselines3/issues/1694
        if isinstance(observation, tuple) and len(observation) == 2 and isinstance(observation[1], dict):
            raise ValueError(
                "predict() got a tuple instead of an array or a dict: `obs, info = env.reset()` (Gymnasium) "
                "and `obs = vec_env.reset()` (SB3) differ"
            )
        obs_tensor, vectorized_env = self.obs_to_tensor(observation)
        tensors = obs_tensor if isinstance(obs_tensor, dict) else {"": obs_tensor}
        if not all(bool((tensor.float().abs() <= LARGEST).all()) for tensor in tensors.values() if tensor.is_floating_point()):
            parts = observation if isinstance(observation, dict) else {"": np.asarray(observation)}
            for key, part in parts.items():
                name = f"observation[{key!r}]" if key else "observation"
                check_numbers(name, np.asarray(part) if vectorized_env else np.asarray(part)[None])
        return obs_tensor, vectorized_env

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
        check_device(device)
        start = path.tell() if isinstance(path, io.IOBase) else 0
        policy = load_policy(cls, path, device)
        if policy is None:
            if not trusted:
                raise refuse(path, "holds a policy in pickled form")
            if isinstance(path, io.IOBase):
                path.seek(start)
            policy = super().load(path, device)  # type: ignore[arg-type]
        return policy

    @property
    def noise_dim(self) -> int:
        """Width of the action noise that :meth:`noisy_rows` takes"""
        return self.action_space.spec.max_parameters

    def noisy_rows(
        self, observation: np.ndarray | dict[str, np.ndarray], noise: np.ndarray, action_masks: np.ndarray | None = None
    ) -> np.ndarray:
        """
        :param observation: n observations
        :param noise: (n, noise_dim) action noise
        :param action_masks: (n, K) False for discrete actions that may not be taken
        :return: rows of sampled actions with the noise added
        """
        return self.action_space.add_noise(self.predict_rows(observation, action_masks=action_masks), noise)

    def random_rows(self, rng: np.random.Generator, n: int, masks: np.ndarray | None = None) -> np.ndarray:
        """
        Uniformly random actions, for the warm-up and for exploration.

        :param rng: random generator
        :param n: number of rows
        :param masks: (n, K) False for discrete actions that may not be taken
        :return: (n, columns) rows
        """
        return self.action_space.sample_rows(rng, n, masks)


class CnnFeatures(HybridPolicy):
    """Mixin for policies of image observations: ``features_extractor_class`` is :class:`NatureCNN` by default."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{"features_extractor_class": NatureCNN, **kwargs})


class CombinedFeatures(HybridPolicy):
    """Mixin for policies of dict observations: ``features_extractor_class`` is :class:`CombinedExtractor` by default."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{"features_extractor_class": CombinedExtractor, **kwargs})
