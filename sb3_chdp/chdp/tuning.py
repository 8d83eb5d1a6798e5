"""Optuna sampler and converter of CHDP, in the form that rl_zoo3 expects."""

from typing import Any

import optuna
from rl_zoo3.hyperparams_opt import convert_offpolicy_params

NET_ARCHS = {
    "small": {"pi": [64, 64], "qf": [128, 128]},
    "medium": {"pi": [128, 128], "qf": [256, 256]},
    "big": {"pi": [256, 256], "qf": [256, 256]},
}


def convert_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: the raw parameters of a trial
    :return: arguments of CHDP
    """
    hyperparams: dict[str, Any] = convert_offpolicy_params(sampled_params)
    for name in ("latent_dim", "gradient_steps"):
        hyperparams[name] = 2 ** hyperparams.pop(f"{name}_pow")
    hyperparams["policy_kwargs"] = {"net_arch": NET_ARCHS[sampled_params["net_arch"]]}
    return hyperparams


def sample_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """
    Sampler for CHDP hyperparams.

    :param trial: Optuna trial
    :param n_actions: not used, rl_zoo3 counts only the dimensions of Box actions
    :param n_envs: not used
    :param additional_args: not used
    :return: arguments of CHDP
    """
    sampled_params = {
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.001, 0.1, log=True),
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 3e-3, log=True),
        "codebook_lr_factor": trial.suggest_float("codebook_lr_factor", 0.01, 1.0, log=True),
        # From 2**6=64 to 2**9=512
        "batch_size_pow": trial.suggest_int("batch_size_pow", 6, 9),
        # From 1 to 2**3=8
        "gradient_steps_pow": trial.suggest_int("gradient_steps_pow", 0, 3),
        # From 2**3=8 to 2**6=64
        "latent_dim_pow": trial.suggest_int("latent_dim_pow", 3, 6),
        "tau": trial.suggest_float("tau", 0.001, 0.05, log=True),
        "eta": trial.suggest_float("eta", 1.0, 30.0, log=True),
        "n_diffusion_steps": trial.suggest_int("n_diffusion_steps", 5, 15, step=5),
        "policy_delay": trial.suggest_int("policy_delay", 1, 2),
        "net_arch": trial.suggest_categorical("net_arch", list(NET_ARCHS)),
    }
    return convert_params(sampled_params)
