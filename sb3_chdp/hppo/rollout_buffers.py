"""Rollout buffers for policies that have a log-probability for each part of an action."""

from typing import Any

import numpy as np
from stable_baselines3.common.buffers import DictRolloutBuffer, RolloutBuffer


class HybridRolloutBuffer(RolloutBuffer):
    """
    Rollout buffer with two log-probabilities per action, (B, 2) in the samples, and advantages (B, 1) that go with both.
    """

    def reset(self) -> None:
        super().reset()
        self.log_probs = np.zeros((self.buffer_size, self.n_envs, 2), dtype=np.float32)

    def _get_samples(self, *args: Any, **kwargs: Any) -> Any:
        samples = super()._get_samples(*args, **kwargs)
        return samples._replace(old_log_prob=samples.old_log_prob.view(-1, 2), advantages=samples.advantages[:, None])


class HybridDictRolloutBuffer(HybridRolloutBuffer, DictRolloutBuffer):
    """:class:`HybridRolloutBuffer` for dict observations."""
