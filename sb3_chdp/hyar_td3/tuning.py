"""Optuna sampler and converter of HyAR-TD3."""

from typing import Any

import optuna

from sb3_chdp.common.td3_tuning import convert_params
from sb3_chdp.common.td3_tuning import sample_params as sample_td3_params

__all__ = ["convert_params", "sample_params"]


def sample_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Sampler for the hyperparams of HyAR-TD3, see :func:`sb3_chdp.common.td3_tuning.sample_params`.

    :return: arguments of HyARTD3
    """
    own = {
        "embedding_dim": trial.suggest_int("embedding_dim", 2, 16),
        "parameter_latent_dim": trial.suggest_int("parameter_latent_dim", 2, 16),
        "representation_learning_rate": trial.suggest_float("representation_learning_rate", 1e-5, 1e-3, log=True),
    }
    return {**sample_td3_params(trial, n_actions, n_envs, additional_args), **own}
