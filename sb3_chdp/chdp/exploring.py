"""What CHDP does to explore, and what it learns about itself from that."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.her import HerReplayBuffer

from sb3_chdp.chdp.exploration import ReturnSums, exploration_rate, informative_steps
from sb3_chdp.chdp.foresight import Claims, ForesightSums, explore
from sb3_chdp.chdp.losses import next_values
from sb3_chdp.chdp.policies import CHDPPolicy
from sb3_chdp.common.arguments import is_class_of
from sb3_chdp.common.off_policy_algorithm import HybridOffPolicyAlgorithm
from sb3_chdp.common.rows import RETURN_PARTS

# Claims of critics that have hardly learnt are no matter
MIN_UPDATES = 200
# In the critics' units; a single one is not to decide about claims
LARGEST_OUTCOME = 20.0
# Steps that count for exploration for each gradient step
STEPS_PER_UPDATE = 4


class ExploringAlgorithm(HybridOffPolicyAlgorithm):
    """
    Exploration at a rate that follows from the task, see :func:`exploration_rate`, and foresight as far as exploratory actions
    justify it, see :class:`ForesightSums`.

    :param args: those of :class:`HybridOffPolicyAlgorithm`
    :param kwargs: those of :class:`HybridOffPolicyAlgorithm`
    """

    policy: CHDPPolicy
    # Whether rows hold what episodes have returned, on which the values of next states then depend
    knows_returns: ClassVar[bool] = True

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        # What the exploration rate depends on; returns_so_far are those of unfinished episodes, one per environment
        self.n_informative_steps = 0.0
        self.returns_so_far: list[float] = []
        self.return_sums = ReturnSums()
        self.foresight_sums = ForesightSums()
        # Those of the present step
        self._claims: Claims | None = None

    def _setup_model(self) -> None:
        # Lists in a model that is being loaded
        self.return_sums, self.foresight_sums = ReturnSums(*self.return_sums), ForesightSums(*self.foresight_sums)
        super()._setup_model()

    def _setup_learn(
        self, total_timesteps: int, callback: MaybeCallback = None, reset_num_timesteps: bool = True, *args: Any, **kwargs: Any
    ) -> tuple[int, BaseCallback]:
        self._claims = None
        if reset_num_timesteps or self._last_obs is None:
            # The environment is reset: no return is that of half an episode and of another one
            self.returns_so_far = []
        if reset_num_timesteps:
            self.n_informative_steps, self.return_sums = 0.0, ReturnSums()
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **kwargs)

    def _state_parts(self) -> tuple[str, ...]:
        kind = self.replay_buffer_class
        # Hindsight has other rewards than the episode had
        has_hindsight = is_class_of(kind, HerReplayBuffer)
        return (*super()._state_parts(), *(RETURN_PARTS if self.knows_returns and not has_hindsight else ()))

    def _exploration_rate(self) -> float:
        n_values = sum(self.hybrid_space.spec.radices)
        # Many environments make many steps before anything is learnt from them
        n_informative = min(self.n_informative_steps, self.learning_starts + STEPS_PER_UPDATE * self._n_updates)
        return exploration_rate(self.num_timesteps, n_informative, self._episode_num, n_values)

    def _exploratory_rows(
        self, rows: np.ndarray, envs: np.ndarray, rng: np.random.Generator, masks: np.ndarray | None
    ) -> np.ndarray:
        assert self._last_obs is not None, "self._last_obs was not set"
        observation = self.policy.obs_to_tensor(self._last_obs)[0]
        self._claims = explore(self.policy, observation, rows[envs], envs, rng, None if masks is None else masks[envs])
        return self._claims.rows

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: Any,
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        self._add_rewards(buffer_action, reward)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        if self._claims is not None and self._n_updates >= MIN_UPDATES:
            self._check_claims(self._claims, buffer_action, new_obs, reward, dones, infos)
        self._claims = None
        self._count_returns(dones)

    def _add_rewards(self, rows: np.ndarray, rewards: np.ndarray) -> None:
        # As the environment gave them, within VecNormalize too
        own = rewards if self._vec_normalize_env is None else self._vec_normalize_env.get_original_reward()
        before = self.returns_so_far if len(self.returns_so_far) == self.n_envs else [0.0] * self.n_envs
        self.returns_so_far = [value + reward for value, reward in zip(before, own.tolist(), strict=True)]
        if "returns" in self.hybrid_space.columns:
            for name, values in zip(RETURN_PARTS, (before, self.returns_so_far), strict=True):
                self.hybrid_space.columns.view(rows, name)[:, 0] = values

    def _count_returns(self, dones: np.ndarray) -> None:
        for i in np.flatnonzero(dones):
            self.return_sums = self.return_sums.add(self.returns_so_far[i])
            self.returns_so_far[i] = 0.0
        self.n_informative_steps += informative_steps(self.n_envs, self.return_sums)

    def _check_claims(
        self,
        claims: Claims,
        rows: np.ndarray,
        new_obs: Any,
        rewards: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Compare what was claimed to come of exploratory actions with the rewards and the values of what followed."""
        columns = self.hybrid_space.columns
        next_masks = self.policy.mask_tensor(columns.masks(rows, "next_masks") if self.use_masking else None)
        returns = th.tensor(self.returns_so_far, dtype=th.float32, device=self.device)[:, None]
        values, _ = next_values(self.policy, self.policy.obs_to_tensor(new_obs)[0], next_masks, returns)
        came = th.as_tensor(rewards + self.gamma * (1 - dones) * values.flatten().cpu().numpy(), device=self.device)
        outputs = self.policy.value_scale.outputs(th.stack([came, came], dim=1))[:, 0]
        outcomes = outputs.clamp(-LARGEST_OUTCOME, LARGEST_OUTCOME).tolist()
        for i, reward, follows, expected in zip(claims.envs, claims.rewards, claims.follows, claims.expected, strict=True):
            # A new episode has begun where a time limit was reached: its first state is not what followed
            if not infos[i].get("TimeLimit.truncated", False):
                surprise = outcomes[i] - float(expected)
                self.foresight_sums = self.foresight_sums.add(float(reward), float(follows), surprise)
        self.policy.set_foresight(self.foresight_sums.weight())

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_claims"]

    def _on_step(self) -> None:
        super()._on_step()
        if self.policy.reward_optimizer is not None:  # PaperCHDP has no foresight
            self.logger.record("rollout/foresight", self.foresight_sums.weight())
