"""What every SB3 algorithm needs to work with the user's own hybrid action space."""

import io
import pathlib
import warnings
from collections.abc import Iterable
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib.common.maskable.utils import is_masking_supported
from stable_baselines3.common.base_class import BaseAlgorithm, maybe_make_env
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import update_learning_rate
from stable_baselines3.common.vec_env import VecCheckNan, VecEnv, is_vecenv_wrapped

from sb3_chdp.common.arguments import (
    FRACTION,
    NOT_NEGATIVE,
    RATE,
    SEED,
    SWITCH,
    Accepted,
    check,
    check_arguments,
    check_load,
    is_class_of,
    is_number,
    of_networks,
    one_of,
    optional,
    whole,
)
from sb3_chdp.common.checks import check_is_env, check_keys, check_observation_space, check_policy_kwargs, check_same_order
from sb3_chdp.common.hybrid_box import HybridBox
from sb3_chdp.common.masks import env_masks
from sb3_chdp.common.policies import HybridPolicy
from sb3_chdp.common.resume import last_checkpoint
from sb3_chdp.common.row_env import RowVecEnv, uncounted_if_refused
from sb3_chdp.common.safe_zip import VERSION, misfit, read_model, save_model
from sb3_chdp.common.spaces import LAYOUTS, MAX_DISCRETE_ACTIONS
from sb3_chdp.common.utils import NonFiniteLossError

SelfHybridAlgorithm = TypeVar("SelfHybridAlgorithm", bound="HybridAlgorithm")

HYBRID_SPACES = (spaces.Tuple, spaces.Dict, spaces.OneOf)


class HybridAlgorithm(BaseAlgorithm):
    """
    Mixin for SB3's algorithms, to be named before them.

    ``model.action_space`` is the user's space; environments and ``predict`` deal in native actions. Buffers and networks
    deal in rows of numbers, see :class:`HybridBox`. Rollouts step :meth:`row_env`, which converts the one to the other.
    """

    # What arguments may be, by name; subclasses have tables of their own for what they add or narrow
    accepted_arguments: ClassVar[dict[str, Accepted]] = {
        "learning_rate": RATE,
        "n_steps": whole(1),
        "batch_size": whole(1),
        "gamma": FRACTION,
        "action_layout": of_networks(one_of(LAYOUTS)),
        "use_masking": optional(SWITCH),
        "stats_window_size": whole(1),
        "seed": SEED,
    }
    policy: HybridPolicy
    action_layout: str
    hybrid_space: HybridBox
    # Whether rows may have a column for every discrete choice, or only one for the joint index of all
    takes_factored: ClassVar[bool] = True
    # Whether the environment is asked for the discrete actions that it allows; None: as long as none has said whether it can
    use_masking: bool | None = None
    # An array or a dict of arrays, which SB3's own annotations hand on where one of them is accepted
    _last_obs: Any
    _row_env: RowVecEnv | None = None

    @staticmethod
    def _wrap_env(env: GymEnv | str, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        # load() and set_env() do not take ids in SB3
        env = maybe_make_env(env, verbose)
        check_is_env(env)
        # SB3 converts the spaces of the old gym
        if isinstance(env.observation_space, spaces.Space):
            check_observation_space(env.observation_space)
        vec_env = BaseAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        if not isinstance(vec_env.action_space, HYBRID_SPACES):
            raise ValueError(
                f"env.action_space must be a Tuple, Dict or OneOf of a discrete choice and its parameters, got "
                f"{vec_env.action_space}: take an algorithm of SB3's for it, or leave out FlattenHybridAction"
            )
        if is_vecenv_wrapped(vec_env, VecCheckNan):
            raise ValueError(
                "VecCheckNan can not look into hybrid actions, leave it out: training stops with an error at the first "
                "observation or reward that is not finite, and actions always are"
            )
        return vec_env

    def row_env(self, env: VecEnv) -> RowVecEnv:
        """
        :param env: the training environment
        :return: the same, which takes rows in place of native actions
        """
        # Kept: SB3 collects rollouts of a single step, and a new wrapper asks all subprocesses for their render mode
        if self._row_env is None or self._row_env.venv is not env:
            self._row_env = RowVecEnv(env, self.hybrid_space)
        return self._row_env

    def _action_masks(self) -> np.ndarray | None:
        """:return: (n_envs, K) which discrete actions the environments allow now, None without masking"""
        assert self.env is not None, "the model has no environment"
        return env_masks(self.hybrid_space.spec, self.env) if self.use_masking else None

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
        action_masks: np.ndarray | None = None,
    ) -> tuple[Any, tuple[np.ndarray, ...] | None]:
        """
        Get native actions from observations, see :meth:`HybridPolicy.predict`.

        :param observation: the input observation
        :param state: unused, returned as it is (these policies are not recurrent)
        :param episode_start: unused
        :param deterministic: whether to return the same action for the same observation every time
        :param action_masks: what ``action_masks()`` of the environments returned, False for what may not be taken
        :return: one native action for one observation, a list of n native actions for n observations; and ``state``
        """
        if self.use_masking and action_masks is None:
            warnings.warn(
                "Without action_masks predict() takes any discrete action: give what action_masks() of the environments "
                "returns, as sb3-contrib's evaluate_policy and MaskableEvalCallback do",
                stacklevel=2,
            )
        return self.policy.predict(observation, state, episode_start, deterministic, action_masks)

    def _make_hybrid_space(self, action_layout: str) -> HybridBox:
        """
        :param action_layout: how to read an ambiguous action space
        :return: the space of the rows that buffer and networks work with
        """
        raise NotImplementedError

    def _choose_hybrid_space(self) -> HybridBox:
        """:return: what :meth:`_make_hybrid_space` makes, with one index for algorithms that need it"""
        space = self._make_hybrid_space(self.action_layout)
        if self.takes_factored or not space.spec.is_factored:
            return space
        n_actions = space.spec.n_discrete_actions
        if self.action_layout == "factored" or n_actions > MAX_DISCRETE_ACTIONS:
            raise ValueError(
                f"{type(self).__name__} needs one index for all joint discrete actions, {MAX_DISCRETE_ACTIONS} at most, no "
                f"action_layout='factored', got {n_actions} of them: use an algorithm that takes every discrete part as a "
                "choice of its own, such as CHDP"
            )
        return self._make_hybrid_space("joint")

    def _network_kwargs(self) -> dict[str, Any]:
        """:return: arguments of the algorithm that shape its networks, handed to the policy beside ``policy_kwargs``"""
        return {}

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        check(one_of(self.policy_aliases), policy=policy_name)
        return super()._get_policy_from_name(policy_name)

    def _settle_arguments(self) -> None:
        """Check the arguments, and ask the environment what they leave open. The first thing that ``_setup_model`` does."""
        if getattr(self, "observation_space", None) is None:
            raise ValueError("env must be an environment of Gymnasium's, a VecEnv of SB3's, or an id, got None")
        check_arguments(self)
        if self.use_masking is None and self.env is not None and is_masking_supported(self.env):
            self.use_masking = True

    def _setup_model(self) -> None:
        if self.tensorboard_log is not None:
            self.tensorboard_log = str(self.tensorboard_log)  # a Path would be pickled
        kinds = tuple(self.policy_aliases.values())
        own = Accepted(f"one of {tuple(self.policy_aliases)} or derived from one", lambda kind: is_class_of(kind, kinds))
        check(own, policy=self.policy_class)
        takes_dicts = issubclass(self.policy_class, self.policy_aliases.get("MultiInputPolicy", ()))
        if takes_dicts and not isinstance(self.observation_space, spaces.Dict):
            raise ValueError(
                f"policy must be 'MlpPolicy', or 'CnnPolicy' for images, for observations in {self.observation_space}, got "
                f"{self.policy_class.__name__}, which takes a Dict of them"
            )
        check_policy_kwargs(self.policy_class, self.policy_kwargs)
        if is_class_of(self.policy_kwargs.get("features_extractor_class", CombinedExtractor), CombinedExtractor):
            check_keys(self.observation_space)
        of_algorithm = self._network_kwargs()
        for name in self.policy_kwargs.keys() & of_algorithm.keys():
            raise ValueError(f"policy_kwargs must not have {name!r}: it is an argument of {type(self).__name__} itself")
        native_space, policy_kwargs = self.action_space, self.policy_kwargs
        self.hybrid_space = self._choose_hybrid_space()
        # Buffer and policy are built for the rows; the model keeps the user's space
        self.action_space = self.hybrid_space
        self.policy_kwargs = {**policy_kwargs, **of_algorithm}
        if isinstance(policy_kwargs.get("net_arch"), tuple):
            self.policy_kwargs["net_arch"] = [*policy_kwargs["net_arch"]]
        try:
            super()._setup_model()  # type: ignore[safe-super]  # of the SB3 algorithm that follows in the MRO
        finally:
            self.action_space, self.policy_kwargs = native_space, policy_kwargs
        if self.seed is not None:
            # set_random_seed() seeded the stand-in
            self.action_space.seed(int(self.seed))

    def learn(self: SelfHybridAlgorithm, *args: Any, **kwargs: Any) -> SelfHybridAlgorithm:
        """
        SB3's ``learn``.

        :raises ValueError: for an observation or a reward that is not finite or too large to be learnt from
        :raises NonFiniteLossError: for a loss like that, before it moves any parameter
        """
        try:
            return super().learn(*args, **kwargs)  # type: ignore[safe-super]  # of the SB3 algorithm that follows
        except NonFiniteLossError as error:
            checkpoint = last_checkpoint(self)
            where = "no ResumableCheckpoint is in use" if checkpoint is None else f"the last checkpoint is {checkpoint}"
            raise NonFiniteLossError(
                error.name,
                error.loss,
                f" at step {self.num_timesteps}, after {self._n_updates} updates. It moved no parameter, {where}. "
                "What helps: a smaller learning_rate, smaller rewards or observations",
            ) from error
        except BaseException:  # KeyboardInterrupt is no Exception
            self._last_obs = None  # the environment may have gone on, or begun anew: learning begins with a reset again
            raise

    def _setup_lr_schedule(self) -> None:
        super()._setup_lr_schedule()
        check(NOT_NEGATIVE, learning_rate=self.lr_schedule(1))

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        # What a function gives is known only now
        check(NOT_NEGATIVE, learning_rate=self.lr_schedule(self._current_progress_remaining))
        super()._update_learning_rate(optimizers)

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        # The last rollout may go beyond the end: no schedule is asked about less than nothing
        super()._update_current_progress_remaining(min(num_timesteps, total_timesteps), total_timesteps)

    def _update_own_learning_rate(self, optimizer: th.optim.Optimizer, name: str, schedule: Schedule) -> None:
        """
        SB3's ``_update_learning_rate`` for what does not learn at the rate ``learning_rate``.

        :param optimizer: the optimizer
        :param name: the rate's name, for the log and the message
        :param schedule: the rate as a function of the remaining progress
        """
        rate = schedule(self._current_progress_remaining)
        check(NOT_NEGATIVE, **{name: rate})
        update_learning_rate(optimizer, rate)
        self.logger.record(f"train/{name}", rate)

    def _setup_learn(self, total_timesteps: int, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        # Less than 0 if a training that goes on is through already
        check(Accepted("a finite number", is_number), total_timesteps=total_timesteps)
        if self.env is None:
            raise ValueError("The model has no environment to learn from: set_env() gives it one, or load(..., env=...)")
        if self.use_masking is not False and is_masking_supported(self.env) != bool(self.use_masking):
            if self.use_masking:
                raise ValueError("use_masking is True but the environment has no method action_masks()")
            warnings.warn(
                "The environment has action_masks(), that of the model's set-up had none: forbidden actions are taken. Load "
                "the model with env=..., or say use_masking=False"
            )
        with uncounted_if_refused(self._vec_normalize_env):
            total_timesteps, callback = super()._setup_learn(total_timesteps, *args, **kwargs)
            try:
                self.row_env(self.env).check_observations(self._last_obs)
            except ValueError:
                self._last_obs = None  # learning begins with a reset again
                raise
        return total_timesteps, callback

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        vec_env = self._wrap_env(env, self.verbose)
        check_same_order(self.action_space, vec_env.action_space)
        super().set_env(vec_env, force_reset)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "hybrid_space", "_row_env"]

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        Save all the attributes of the object and the model parameters in a zip-file.

        Attributes are JSON where they can be, so that :meth:`load` runs no code of the file's. Custom objects are pickled, as
        SB3 does it, and need ``load(..., trusted=True)``.

        :param path: path to the file where the rl agent should be saved
        :param exclude: name of parameters that should be excluded in addition to the default ones
        :param include: name of parameters that might be excluded but should be included anyway
        """
        sb3_zip = io.BytesIO()
        super().save(sb3_zip, exclude, include)
        save_model(sb3_zip, self, path)

    @classmethod
    def load(
        cls: type[SelfHybridAlgorithm],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        trusted: bool = False,
        **kwargs: Any,
    ) -> SelfHybridAlgorithm:
        """
        Load the model from a zip-file. No code of the file's runs unless it is ``trusted``.

        :param path: path to the file (or a file-like) where to load the agent from
        :param env: the new environment to run the loaded model on (can be None if you only need prediction from a trained
            model) has priority over any saved environment
        :param device: Device on which the code should run.
        :param custom_objects: objects to use in place of those of the file, by attribute; what is named here is not read
        :param print_system_info: Whether to print system info from the saved model and the current system info
        :param force_reset: Force call to ``reset()`` before training to avoid unexpected behavior.
        :param trusted: whether pickled objects may be read, which runs whatever code the file's author put there
        :param kwargs: extra arguments to change the model when loading, but for those that shape the networks
        :return: new model instance with loaded parameters
        :raises ValueError: if the file is of another class or of a version that does not fit, if it holds pickled objects and
            is not trusted, and for an argument that is unknown, out of range, or does not fit the networks in the file
        """
        file, objects, version = read_model(cls, path, custom_objects, trusted)
        check_load(cls, path, objects, kwargs)
        try:
            model = super().load(file, env, device, objects, print_system_info, force_reset, **kwargs)
        except (AttributeError, LookupError, RuntimeError, TypeError) as error:
            if version == VERSION and not kwargs:
                raise
            raise misfit(path, version, error, kwargs) from error
        if model.env is not None:
            check_same_order(model.action_space, model.env.action_space)
        return model
