"""Registration with rl_zoo3. Importing this module imports rl_zoo3, which patches Gymnasium."""

from functools import cached_property, partialmethod
from typing import Any

import gymnasium as gym
import numpy as np
import rl_zoo3.exp_manager
import rl_zoo3.utils
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3.common import callbacks
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv, VecTransposeImage, is_vecenv_wrapped

import sb3_chdp
from sb3_chdp.common.arguments import constructor_defaults
from sb3_chdp.common.base_class import HYBRID_SPACES, HybridAlgorithm
from sb3_chdp.common.evaluation import evaluate_policy
from sb3_chdp.common.masks import allowed_now
from sb3_chdp.common.off_policy_algorithm import HybridOffPolicyAlgorithm
from sb3_chdp.common.spaces import HybridActionSpec
from sb3_chdp.registry import ALGORITHMS
from sb3_chdp.zoo_arguments import ArgumentsError, unknown

# Of random play, at the ends of whose episodes some environments say whether it was a success
EXAMPLE_STEPS = 1000
EXAMPLE_EPISODES = 3
# What rl_zoo3 makes action noise of
OF_NOISE = ("noise_type", "noise_std")
# Arguments that no setting may name: the command line has options for most of them
OF_COMMAND = {"env", "seed", "device", "verbose", "tensorboard_log", "_init_setup_model"}
FLATTEN = "sb3_chdp.wrappers.FlattenHybridAction"
TRANSPOSE = "stable_baselines3.common.vec_env.VecTransposeImage"


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


def play_with_masks() -> None:
    """
    Let a script that plays a model hand the masks of its environment to ``predict``. To be called before it is imported.

    Such a script makes one environment and loads one model, whose ``predict`` it calls without masks.
    """
    create_test_env, predict = rl_zoo3.utils.create_test_env, HybridAlgorithm.predict

    def create(*args: Any, **kwargs: Any) -> VecEnv:
        env = create_test_env(*args, **kwargs)

        def predict_masked(self: HybridAlgorithm, *args: Any, **kwargs: Any) -> Any:
            if self.use_masking:
                kwargs.setdefault("action_masks", get_action_masks(env))
            return predict(self, *args, **kwargs)

        if is_masking_supported(env):
            HybridAlgorithm.predict = predict_masked  # type: ignore[method-assign]
        return env

    # The scripts take it from either
    for module in (rl_zoo3, rl_zoo3.utils):
        vars(module).update(create_test_env=create)


def trust_own_runs() -> None:
    """Let a script take what is pickled in a run: it reads the run's other files as if they were the user's own, too."""
    for kind, name in ((HybridAlgorithm, "load"), (HybridOffPolicyAlgorithm, "load_replay_buffer")):
        setattr(kind, name, partialmethod(vars(kind)[name], trusted=True))


class HybridExperimentManager(ExperimentManager):
    """
    rl_zoo3's manager, which flattens hybrid actions for SB3's own algorithms, and whose monitor notes success, and whatever
    else the YAML file names, if the environment has it in its infos.
    """

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        hyperparams, saved = super().read_hyperparameters()
        if self.storage and self.study_name and self.trial_id == 0:
            # rl_zoo3 takes trial 0 for none
            of_trial = {**self.load_trial(self.storage, self.study_name, 0), **(self.custom_hyperparams or {})}
            hyperparams.update(of_trial)
            saved.update(of_trial)
            print(f"Settings of trial 0: {of_trial}")
        for settings in (hyperparams, saved):
            settings.setdefault("policy", "MlpPolicy")
            settings.setdefault("n_timesteps", self.n_timesteps)
        for name, value in hyperparams.items():
            # SB3 reads ent_coef itself
            if isinstance(value, str) and _is_number(value) and name != "ent_coef":
                raise ArgumentsError(f"{name}: {value} is a text, not a number; in YAML write !!float {value}")
        if hyperparams["n_timesteps"] <= 0:
            raise ArgumentsError(f"-n says for how many steps: the file {self.config} does not")
        if hyperparams.get("env_kwargs") and not self.env_kwargs:
            # Those of the YAML file are for evaluation too
            self.env_kwargs = hyperparams["env_kwargs"]
            self.eval_env_kwargs = self._eval_env_kwargs_args or self.env_kwargs
        # A wrapper may change the action space
        self._layout: str = "auto" if hyperparams.get("env_wrapper") else hyperparams.get("action_layout", "auto")
        if self.algo not in ALGORITHMS and isinstance(self._example[0], HYBRID_SPACES):
            for settings in (hyperparams, saved):
                _flatten(settings)
        return hyperparams, saved

    def load_trial(self, storage: str, study_name: str, trial_id: int | None = None, convert: bool = True) -> dict[str, Any]:
        try:
            return super().load_trial(storage, study_name, trial_id, convert)
        except IndexError:
            raise ArgumentsError(f"--trial-id {trial_id}: the study {study_name} has no such trial; the first is 0") from None

    @staticmethod
    def _preprocess_schedules(hyperparams: dict[str, Any]) -> dict[str, Any]:
        # rl_zoo3 reads schedules of a list of names
        for name in hyperparams:
            if name.endswith("_learning_rate"):
                of_name = ExperimentManager._preprocess_schedules({"learning_rate": hyperparams[name]})
                hyperparams[name] = of_name["learning_rate"]
        return ExperimentManager._preprocess_schedules(hyperparams)

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> tuple[dict[str, Any], Any, Any, Any]:
        preprocessed: tuple[dict[str, Any], Any, Any, Any] = super()._preprocess_hyperparams(hyperparams)
        known = {*constructor_defaults(ALGOS[self.algo]), *OF_NOISE} - OF_COMMAND
        for name in preprocessed[0]:
            if name not in known:
                raise ArgumentsError(unknown("setting", name, known, f"{self.algo} has {', '.join(sorted(known))}"))
        return preprocessed

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        wanted = dict.fromkeys([*self.monitor_kwargs.get("info_keywords", ()), "is_success"])
        present = self._example[1]
        self.monitor_kwargs = {**self.monitor_kwargs, "info_keywords": tuple(key for key in wanted if key in present)}
        try:
            return super().create_envs(n_envs, eval_env, no_log)
        except NotImplementedError as error:  # nested observations
            remedy = "-params env_wrapper:\"'gymnasium.wrappers.FlattenObservation'\""
            raise ArgumentsError(f"{error}; what makes a vector of observations: {remedy}") from error

    def _maybe_normalize(self, env: VecEnv, eval_env: bool) -> VecEnv:
        is_stock = self.algo not in ALGORITHMS and issubclass(ALGOS[self.algo], OffPolicyAlgorithm)
        if is_stock and isinstance(env.observation_space, gym.spaces.Discrete):
            self.normalize = False  # they fail with it
        if self.normalize:
            # Before SB3 transposes images: replay buffers get them from VecNormalize
            env = BaseAlgorithm._wrap_env(env)
            self.normalize_kwargs = {**_normalizable(env.observation_space), **self.normalize_kwargs}
        return super()._maybe_normalize(env, eval_env)

    def _preprocess_action_noise(
        self, hyperparams: dict[str, Any], saved_hyperparams: dict[str, Any], env: VecEnv
    ) -> dict[str, Any]:
        # The first method that gets both the environment and the arguments, those that enjoy will read among them
        if not self.normalize:
            saved_hyperparams.pop("normalize", None)
        if self.normalize and is_vecenv_wrapped(env, VecTransposeImage):
            _add_wrapper(saved_hyperparams, "vec_env_wrapper", TRANSPOSE)
        if hyperparams.get("policy") == "MlpPolicy" and "policy" not in (self.custom_hyperparams or {}):
            hyperparams["policy"] = saved_hyperparams["policy"] = _policy_for(env.observation_space)
        return super()._preprocess_action_noise(hyperparams, saved_hyperparams, env)

    @cached_property
    def _example(self) -> tuple[gym.Space[Any], set[str]]:
        """:return: action space of the environment, and what the last info of every episode has"""
        env = gym.make(self.env_name.gym_id, **self.env_kwargs)
        spec = HybridActionSpec(env.action_space, self._layout) if isinstance(env.action_space, HYBRID_SPACES) else None
        rng = np.random.default_rng(0)
        ends: list[set[str]] = []
        env.reset(seed=0)
        for _ in range(EXAMPLE_STEPS):
            *_, terminated, truncated, info = env.step(random_action(env, spec, rng))
            if terminated or truncated:
                ends.append(set(info))
                if len(ends) == EXAMPLE_EPISODES:
                    break
                env.reset()
        env.close()
        return env.action_space, set.intersection(*ends) if ends else set(info)


def random_action(env: gym.Env, spec: HybridActionSpec | None, rng: np.random.Generator) -> Any:
    """:return: an action that the masks of the environment, if it has any, allow; without a spec any"""
    if spec is None:
        return env.action_space.sample()
    return spec.to_native(spec.sample_rows(rng, 1, allowed_now(env, spec))[0])


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _normalizable(space: gym.Space[Any]) -> dict[str, Any]:
    """:return: arguments of VecNormalize with which it takes the observations: it normalises vectors and no images"""

    def is_vector(part: gym.Space[Any]) -> bool:
        return isinstance(part, gym.spaces.Box) and not is_image_space(part)

    if isinstance(space, gym.spaces.Dict):
        keys = [key for key, part in space.items() if is_vector(part)]
        return {"norm_obs_keys": keys} if keys else {"norm_obs": False}
    return {} if is_vector(space) else {"norm_obs": False}


def _policy_for(space: gym.Space[Any]) -> str:
    """:return: name of the policy that reads such observations"""
    if isinstance(space, gym.spaces.Dict):
        return "MultiInputPolicy"
    return "CnnPolicy" if is_image_space(space) else "MlpPolicy"


def _add_wrapper(settings: dict[str, Any], key: str, wrapper: str, **kwargs: Any) -> None:
    """Put a wrapper around those that the settings name, unless it is one of them."""
    wrappers = settings.get(key) or []
    wrappers = [wrappers] if isinstance(wrappers, (str, dict)) else list(wrappers)
    if wrapper not in str(wrappers):
        settings[key] = [*wrappers, {wrapper: kwargs} if kwargs else wrapper]


def _flatten(settings: dict[str, Any]) -> None:
    """Wrap the environment, and normalise as the algorithms of this package do unless told otherwise."""
    layout = {"action_layout": settings.pop("action_layout")} if "action_layout" in settings else {}
    _add_wrapper(settings, "env_wrapper", FLATTEN, **layout)
    settings.setdefault("normalize", True)
