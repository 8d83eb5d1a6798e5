"""What every SB3 algorithm needs to work with the user's own hybrid action space."""

import io
import pathlib
from typing import Any, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecCheckNan, VecEnv, is_vecenv_wrapped

from sb3_chdp.common.checks import check_policy_kwargs
from sb3_chdp.common.hybrid_box import HybridBox
from sb3_chdp.common.native_env import NativeActionVecEnv

SelfHybridAlgorithm = TypeVar("SelfHybridAlgorithm", bound="HybridAlgorithm")

HYBRID_SPACES = (spaces.Tuple, spaces.Dict, spaces.OneOf)


class HybridAlgorithm(BaseAlgorithm):
    """
    Mixin for SB3's algorithms, to be named before them.

    ``model.action_space`` is the user's space; environments and ``predict`` deal in native actions. Buffers and networks
    deal in rows of numbers, see :class:`HybridBox`. Rollouts step :meth:`native_env`, which converts the one to the other.
    """

    action_layout: str
    hybrid_space: HybridBox
    # An array or a dict of arrays, which SB3's own annotations hand on where one of them is accepted
    _last_obs: Any
    _native_env: NativeActionVecEnv | None = None

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        vec_env = BaseAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        if is_vecenv_wrapped(vec_env, VecCheckNan):
            raise ValueError(
                "VecCheckNan can not look into hybrid actions, leave it out: training stops with an error at the first "
                "observation or reward that is not finite, and actions always are"
            )
        return vec_env

    def native_env(self, env: VecEnv) -> NativeActionVecEnv:
        """
        :param env: the training environment
        :return: the same for rows instead of native actions
        """
        # Kept: SB3 collects rollouts of a single step, and a new wrapper asks all subprocesses for their render mode
        if self._native_env is None or self._native_env.venv is not env:
            self._native_env = NativeActionVecEnv(env, self.hybrid_space)
        return self._native_env

    def _make_hybrid_space(self) -> HybridBox:
        """:return: the space of the rows that buffer and networks work with"""
        return HybridBox(self.action_space, self.action_layout)

    def _network_kwargs(self) -> dict[str, Any]:
        """:return: arguments of the algorithm that shape its networks, handed to the policy beside ``policy_kwargs``"""
        return {}

    def _setup_model(self) -> None:
        check_policy_kwargs(self.policy_class, self.policy_kwargs)
        native_space, policy_kwargs = self.action_space, self.policy_kwargs
        self.hybrid_space = self._make_hybrid_space()
        # Buffer and policy are built for the rows; the model keeps the user's space
        self.action_space = self.hybrid_space
        self.policy_kwargs = {**policy_kwargs, **self._network_kwargs()}
        try:
            super()._setup_model()  # type: ignore[safe-super]  # of the SB3 algorithm that follows in the MRO
        finally:
            self.action_space, self.policy_kwargs = native_space, policy_kwargs
        # set_random_seed() seeded the stand-in
        self.action_space.seed(None if self.seed is None else int(self.seed))

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "hybrid_space", "_native_env"]

    @classmethod
    def load(
        cls: type[SelfHybridAlgorithm],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfHybridAlgorithm:
        data, _, _ = load_from_zip_file(path, device="cpu", custom_objects=custom_objects)
        if not isinstance(path, (str, pathlib.Path)):
            path.seek(0)
        saved_class = (data or {}).get("policy_class")
        accepted = tuple(cls.policy_aliases.values())
        if not (isinstance(saved_class, type) and issubclass(saved_class, accepted)):
            raise ValueError(f"{path} is not a {cls.__name__} model: its policy is {saved_class}, not one of {accepted}")
        return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
