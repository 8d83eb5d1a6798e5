"""Optuna sampler and converter of CHDP, in the form that rl_zoo3 expects."""

from typing import Any

import optuna

from sb3_chdp.common.buffers import PrioritizedReplayBuffer

NET_ARCHS = {
    "small": {"pi": [64, 64], "qf": [128, 128]},
    "medium": {"pi": [128, 128], "qf": [256, 256]},
    "big": {"pi": [256, 256], "qf": [256, 256]},
}
# By what Optuna stores
REPLAY_BUFFERS = {None: None, "PrioritizedReplayBuffer": PrioritizedReplayBuffer}


def convert_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: the raw parameters of a trial
    :return: arguments of CHDP
    """
    hyperparams = sampled_params.copy()
    hyperparams["gamma"] = 1 - hyperparams.pop("one_minus_gamma")
    for name in ("batch_size", "latent_dim", "gradient_steps", "n_target_candidates"):
        hyperparams[name] = 2 ** hyperparams.pop(f"{name}_pow")
    net_arch = NET_ARCHS[hyperparams.pop("net_arch")]
    hyperparams["replay_buffer_class"] = REPLAY_BUFFERS[hyperparams["replay_buffer_class"]]
    critic_kwargs = {name: hyperparams.pop(name) for name in ("layer_norm", "parameter_degree", "bilinear")}
    hyperparams["policy_kwargs"] = {"net_arch": net_arch, **critic_kwargs}
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
        "critics_train_codebook": trial.suggest_categorical("critics_train_codebook", [False, True]),
        # From 2**6=64 to 2**9=512
        "batch_size_pow": trial.suggest_int("batch_size_pow", 6, 9),
        # From 1 to 2**3=8
        "gradient_steps_pow": trial.suggest_int("gradient_steps_pow", 0, 3),
        # From 2 to 2**5=32
        "latent_dim_pow": trial.suggest_int("latent_dim_pow", 1, 5),
        # From 1 to 2**4=16
        "n_target_candidates_pow": trial.suggest_int("n_target_candidates_pow", 0, 4),
        "uniform_fraction": trial.suggest_categorical("uniform_fraction", [0.0, 0.25, 0.5, 0.75]),
        "explore_parts": trial.suggest_categorical("explore_parts", [False, True]),
        "replay_buffer_class": trial.suggest_categorical("replay_buffer_class", list(REPLAY_BUFFERS)),
        "layer_norm": trial.suggest_categorical("layer_norm", [False, True]),
        "parameter_degree": trial.suggest_categorical("parameter_degree", [1, 4]),
        "bilinear": trial.suggest_categorical("bilinear", [False, True]),
        "tau": trial.suggest_float("tau", 0.001, 0.05, log=True),
        "eta": trial.suggest_float("eta", 1.0, 30.0, log=True),
        "n_diffusion_steps": trial.suggest_int("n_diffusion_steps", 5, 15, step=5),
        "net_arch": trial.suggest_categorical("net_arch", list(NET_ARCHS)),
    }
    return convert_params(sampled_params)
