"""The environment as rollouts see it: rows go in, native actions reach the user's environment."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize, unwrap_vec_normalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_chdp.common.checks import check_numbers, check_observation
from sb3_chdp.common.hybrid_box import HybridBox


@contextmanager
def uncounted_if_refused(normalize: VecNormalize | None) -> Iterator[None]:
    """
    ``VecNormalize`` counts numbers before they can be checked: it forgets those that are refused within the block.

    :param normalize: the wrapper, None if there is none
    """
    obs_rms = getattr(normalize, "obs_rms", {})
    parts = [] if normalize is None else [normalize, normalize.ret_rms]
    parts += obs_rms.values() if isinstance(obs_rms, dict) else [obs_rms]
    # Without copies of arrays: updates put new ones in their place
    before = [dict(vars(part)) for part in parts]
    try:
        yield
    except ValueError:
        for part, state in zip(parts, before, strict=True):
            vars(part).update(state)
        raise


def with_original_ends(normalize: VecNormalize, infos: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """
    :param normalize: the wrapper
    :param infos: those of a step
    :return: the same, with the last observations of episodes as the environment gave them
    """

    def original(like: Any, obs: Any) -> Any:
        if isinstance(like, dict):
            return {key: original(part, obs[key]) for key, part in like.items()}
        return np.rint(obs).astype(like.dtype) if np.issubdtype(like.dtype, np.integer) else obs

    # Of images the space says float32
    like = normalize.old_obs
    return [
        (
            {**info, "terminal_observation": original(like, normalize.unnormalize_obs(info["terminal_observation"]))}
            if info.get("terminal_observation") is not None
            else info
        )
        for info in infos
    ]


class RowVecEnv(VecEnvWrapper):
    """
    Environment that takes rows, which the wrapped one gets as native actions.

    :param venv: the vectorised environment
    :param rows: space of the rows
    :raises ValueError: from ``step`` if an observation or a reward is unusable, see :func:`check_numbers`, before anything is
        stored
    """

    def __init__(self, venv: VecEnv, rows: HybridBox):
        super().__init__(venv)
        self.rows = rows
        self._normalize = unwrap_vec_normalize(venv)

    def __reduce__(self) -> tuple[Any, ...]:
        # What VecEnvWrapper knows about its class cannot be pickled, and models are copied with all that they have
        return type(self), (self.venv, self.rows)

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        native_actions: Any = self.rows.to_native(actions)  # a list, where SB3 expects an array
        self.venv.step_async(native_actions)

    def step_wait(self) -> VecEnvStepReturn:
        with uncounted_if_refused(self._normalize):
            obs, rewards, dones, infos = self.venv.step_wait()
            # One NaN would ruin the networks for good
            self.check_observations(obs)
            check_numbers("The reward", rewards)
            if self._normalize is not None:
                check_numbers("The reward before normalization", self._normalize.old_reward)
            for i in np.flatnonzero(dones).tolist():
                if "terminal_observation" in infos[i]:
                    infos[i]["terminal_observation"] = self._checked_terminal(i, infos[i]["terminal_observation"])
        # SubprocVecEnv hands on whole numbers as such, to which no value can be added
        return obs, np.asarray(rewards, dtype=np.float32), dones, infos

    def check_observations(self, obs: VecEnvObs) -> None:
        """
        :param obs: the latest observations of all environments
        :raises ValueError: if there is one that nothing can be learnt from
        """
        check_observation("The observation", self.observation_space, obs)
        if self._normalize is not None:
            check_numbers("The observation before normalization", self._normalize.old_obs)

    def _checked_terminal(self, index: int, obs: Any) -> Any:
        """
        :return: the last observation of an episode, which goes into the replay buffer or is valued for bootstrapping; without
            entries that are not in the space, as the other observations
        """
        space = self.observation_space
        if isinstance(space, spaces.Dict):
            obs = {key: obs[key] for key in space}
        for key, part in obs.items() if isinstance(obs, dict) else [("", obs)]:
            name = f"The terminal observation[{key!r}]" if key else "The terminal observation"
            expected = space[key] if isinstance(space, spaces.Dict) else space
            if np.shape(part) != expected.shape:
                raise ValueError(f"{name} must have shape {expected.shape}, got {np.shape(part)} from environment {index}")
            check_observation(name, expected, np.asarray(part)[None], index)
        return obs
