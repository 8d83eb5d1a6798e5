"""Evaluation that asks the environment for masks, where both it and the model know them."""

import math
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


def evaluate_episodes(
    model: Any, env: VecEnv, n_episodes: int, deterministic: bool = True
) -> tuple[list[float], list[int], list[float]]:
    """
    :param model: what acts
    :param env: the environments
    :param n_episodes: number of episodes
    :param deterministic: whether actions are deterministic
    :return: per episode its return, its length, and ``is_success`` of its last info, nan without one
    """
    successes: list[float] = []

    def note(local_vars: dict[str, Any], _: dict[str, Any]) -> None:
        if local_vars["done"]:
            success = local_vars["info"].get("is_success")
            successes.append(math.nan if success is None else float(success))

    returns, lengths = evaluate_policy(
        model, env, n_episodes, deterministic=deterministic, return_episode_rewards=True, callback=note, warn=False
    )
    return returns, lengths, successes
