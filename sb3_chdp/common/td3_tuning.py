"""Optuna sampler and converter of the TD3 algorithms, in the form that rl_zoo3 expects."""

from typing import Any

import optuna
from rl_zoo3.hyperparams_opt import convert_offpolicy_params


def convert_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: the raw parameters of a trial
    :return: arguments of the algorithm
    """
    hyperparams: dict[str, Any] = convert_offpolicy_params(sampled_params)
    hyperparams["gradient_steps"] = 2 ** hyperparams.pop("gradient_steps_pow")
    return hyperparams


def sample_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Sampler for the hyperparams that the TD3 algorithms share.

    :param trial: Optuna trial
    :param n_actions: not used, rl_zoo3 counts only the dimensions of Box actions
    :param n_envs: not used
    :param additional_args: not used
    :return: arguments of the algorithm
    """
    sampled_params = {
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.001, 0.1, log=True),
        "learning_rate": trial.suggest_float("learning_rate", 1e-5, 2e-3, log=True),
        # From 2**6=64 to 2**9=512
        "batch_size_pow": trial.suggest_int("batch_size_pow", 6, 9),
        # From 1 to 2**4=16
        "gradient_steps_pow": trial.suggest_int("gradient_steps_pow", 0, 4),
        "tau": trial.suggest_float("tau", 0.001, 0.05, log=True),
        "exploration_noise": trial.suggest_float("exploration_noise", 0.05, 0.5),
        "exploration_fraction": trial.suggest_float("exploration_fraction", 0.05, 0.5),
        "inverting_gradients": trial.suggest_categorical("inverting_gradients", [False, True]),
        "net_arch": trial.suggest_categorical("net_arch", ["small", "medium", "big"]),
    }
    return convert_params(sampled_params)
