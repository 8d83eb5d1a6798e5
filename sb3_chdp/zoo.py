"""Registration with rl_zoo3. Importing this module imports rl_zoo3, which patches Gymnasium."""

import gymnasium as gym
import rl_zoo3.exp_manager
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS
from stable_baselines3.common import callbacks
from stable_baselines3.common.vec_env import VecEnv

import sb3_chdp
from sb3_chdp.common.evaluation import evaluate_policy
from sb3_chdp.registry import ALGORITHMS


def register() -> None:
    """Make the algorithms of this package known to every script of rl_zoo3, in this process."""
    for name, algorithm in ALGORITHMS.items():
        ALGOS[name] = algorithm.load_class()
        tuning = algorithm.load_tuning()
        if tuning is not None:
            HYPERPARAMS_SAMPLER[name], HYPERPARAMS_CONVERTER[name] = tuning
    # rl_zoo3 evaluates replay_buffer_class and the like among its own imports: YAML files may name classes of this package.
    # From there rl_zoo3.train takes its manager, too
    vars(rl_zoo3.exp_manager).update(sb3_chdp=sb3_chdp, ExperimentManager=HybridExperimentManager)
    # Its evaluations are those of SB3's EvalCallback, which knows no masks
    vars(callbacks).update(evaluate_policy=evaluate_policy)


class HybridExperimentManager(ExperimentManager):
    """rl_zoo3's manager; the monitor notes only what the environment has in its infos, which need not be success."""

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        wanted = self.monitor_kwargs.get("info_keywords", ())
        if wanted:
            present = self._info_keywords()
            self.monitor_kwargs = {**self.monitor_kwargs, "info_keywords": tuple(key for key in wanted if key in present)}
        return super().create_envs(n_envs, eval_env, no_log)

    def _info_keywords(self) -> set[str]:
        """:return: what the environment has in the info of a step"""
        env = gym.make(self.env_name.gym_id, **self.env_kwargs)
        env.reset(seed=0)
        info = env.step(env.action_space.sample())[-1]
        env.close()
        return set(info)
