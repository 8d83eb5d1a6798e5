"""Evaluation that asks the environment for masks, where both it and the model know them."""

from typing import Any

from sb3_contrib.common.maskable.evaluation import evaluate_policy as evaluate_masked_policy
from sb3_contrib.common.maskable.utils import is_masking_supported
from stable_baselines3.common.evaluation import evaluate_policy as evaluate_free_policy
from stable_baselines3.common.vec_env import VecEnv


def evaluate_policy(model: Any, env: VecEnv, *args: Any, **kwargs: Any) -> Any:
    """
    sb3-contrib's ``evaluate_policy`` for a model with ``use_masking`` and an environment with ``action_masks()``, else SB3's.

    The arguments and what is returned are theirs.
    """
    masked = getattr(model, "use_masking", False) and is_masking_supported(env)
    return (evaluate_masked_policy if masked else evaluate_free_policy)(model, env, *args, **kwargs)
