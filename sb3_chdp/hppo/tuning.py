"""HPPO is tuned as SB3's PPO: rl_zoo3's sampler and converter."""

from rl_zoo3.hyperparams_opt import convert_onpolicy_params as convert_params
from rl_zoo3.hyperparams_opt import sample_ppo_params as sample_params

__all__ = ["convert_params", "sample_params"]
