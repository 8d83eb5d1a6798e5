"""The environment as rollouts see it: rows go in, native actions reach the user's environment."""

from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_chdp.common.checks import check_finite
from sb3_chdp.common.hybrid_box import HybridBox


class NativeActionVecEnv(VecEnvWrapper):
    """
    Environment that takes rows, which the wrapped one gets as native actions.

    :param venv: the vectorised environment
    :param rows: space of the rows
    :raises ValueError: from ``step`` if an observation or a reward is not finite, before anything is stored
    """

    def __init__(self, venv: VecEnv, rows: HybridBox):
        super().__init__(venv)
        self.rows = rows

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        native_actions: Any = self.rows.to_native(actions)  # a list, where SB3 expects an array
        self.venv.step_async(native_actions)

    def step_wait(self) -> VecEnvStepReturn:
        obs, rewards, dones, infos = self.venv.step_wait()
        # One NaN would ruin the networks for good
        check_finite("The observation", obs)
        check_finite("The reward", rewards)
        return obs, rewards, dones, infos
