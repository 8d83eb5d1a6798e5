"""Checks of arguments and data, whose errors name what was given and what is accepted."""

import warnings
from importlib.util import find_spec
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize
from torch import nn

from sb3_chdp.common.arguments import constructor_defaults, whole
from sb3_chdp.common.space_tree import leaves_of, name_of

# What gymnasium.wrappers.FlattenObservation makes a vector of
FLATTENABLE = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary, spaces.Text, spaces.OneOf)
# Numbers that are learnt from: a thousand of them add up to 1e18, whose square float32 still holds. Losses and optimizers
# compute such squares; beyond them they put out infinity, or learn nothing
LARGEST = 1e15
# Bytes of actions in a replay buffer that deserve a warning
LARGE_ROWS = 2**30


def check_numbers(name: str, value: Any, first_env: int = 0) -> None:
    """
    :param name: what the value is, for the message
    :param value: array, or dict of arrays: observations or rewards of a vectorised environment
    :param first_env: index of the environment that the first entry is from
    :raises ValueError: if an array holds NaN, infinity or a number beyond ``LARGEST``; the message names the environments
        concerned
    """
    if isinstance(value, dict):
        for key, part in value.items():
            check_numbers(f"{name}[{key!r}]", part, first_env)
        return
    if value.dtype.kind == "f":
        # The cheapest test: NaN, infinity and numbers that are too large show in the sum of squares
        if float(np.vdot(value, value)) <= LARGEST**2:
            return
    elif value.dtype.kind not in "iu" or value.dtype.itemsize < 8:
        return  # cannot be that large
    usable = np.abs(value.astype(np.float64)) <= LARGEST
    if not usable.all():
        bad = np.flatnonzero(~usable.reshape(len(value), -1).all(axis=1))
        raise ValueError(
            f"{name} must be finite and between {-LARGEST:.0e} and {LARGEST:.0e}, got NaN, inf or more from environment(s) "
            f"{(first_env + bad).tolist()}: {value[bad]}"
        )


def check_observation(name: str, space: spaces.Space[Any], value: Any, first_env: int = 0) -> None:
    """
    :param name: what the value is, for the message
    :param space: the observation space
    :param value: (n, ...) observations of n environments, dict of arrays if the space is one
    :param first_env: index of the environment that the first is from
    :raises ValueError: see :func:`check_numbers`, and for a discrete value that is not in the space
    """
    if isinstance(space, spaces.Dict):
        for key, part in space.items():
            check_observation(f"{name}[{key!r}]", part, value[key], first_env)
        return
    check_numbers(name, value, first_env)
    if isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)):
        below = space.n if isinstance(space, spaces.Discrete) else space.nvec
        bad = np.flatnonzero(((value < 0) | (value >= below)).reshape(len(value), -1).any(axis=1))
        if len(bad):
            raise ValueError(f"{name} must be in {space}, got {value[bad]} from environment(s) {(first_env + bad).tolist()}")


def check_is_env(env: Any) -> None:
    """
    :param env: argument of an algorithm
    :raises ValueError: if it is no environment
    """
    if isinstance(env, type):
        raise ValueError(f"env must be an environment, got the class {env.__name__}: give an object of it, {env.__name__}()")
    if isinstance(env, gym.vector.VectorEnv):
        raise ValueError(f"env must be a VecEnv of SB3's, as make_vec_env() returns it, got Gymnasium's {type(env).__name__}")
    # SB3 converts environments of the old gym, where that is installed
    is_env = isinstance(env, (gym.Env, VecEnv)) or find_spec("gym") is not None
    if not is_env or not (hasattr(env, "action_space") and hasattr(env, "observation_space")):
        remedy = "derive its class from gymnasium.Env, and set action_space and observation_space"
        raise ValueError(f"env must be an environment of Gymnasium's, a VecEnv of SB3's, or an id, got {env!r}: {remedy}")


def _shapes(space: spaces.Space[Any]) -> Any:
    return {key: part.shape for key, part in space.items()} if isinstance(space, spaces.Dict) else space.shape


def check_replayed_observations(env: VecEnv | None) -> None:
    """
    :param env: the environment of an algorithm with a replay buffer
    :raises ValueError: if observations get another shape around ``VecNormalize``, which hands what it got to the buffer
    """
    normalize = None if env is None else unwrap_vec_normalize(env)
    if env is None or normalize is None:
        return
    inside, outside = _shapes(normalize.observation_space), _shapes(env.observation_space)
    if inside != outside:
        raise ValueError(
            "env must have VecNormalize around all that reshapes observations, as VecNormalize(VecTransposeImage(env)) has, "
            f"so that the replay buffer gets what the policy does, got shapes {inside} in VecNormalize and {outside} around it"
        )


def check_same_order(space: spaces.Space[Any], of_env: spaces.Space[Any]) -> None:
    """
    Dicts that differ by nothing but the order of their keys are equal to Gymnasium.

    :param space: action space of a model
    :param of_env: that of its environment
    :raises ValueError: if their parts come in another order
    """
    own, other = ([name_of(path) for path, _ in leaves_of(each)] for each in (space, of_env))
    if space == of_env and own != other:
        raise ValueError(f"env.action_space must have its parts in the model's order, {own}, got {other}: see OrderedDict")


def check_observation_space(space: spaces.Space[Any]) -> None:
    """
    :param space: the observation space of an environment
    :raises ValueError: if SB3's policies cannot read its observations; the message says how they can
    """
    parts = {f"observation_space[{key!r}]": part for key, part in space.items()} if isinstance(space, spaces.Dict) else None
    for name, part in (parts or {"observation_space": space}).items():
        is_flat = isinstance(part, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary))
        if isinstance(part, spaces.Box) and 0 in part.shape:
            raise ValueError(f"{name} is {part}, which has no elements: leave it out")
        if isinstance(part, spaces.Box) and part.shape == ():
            raise ValueError(f"{name} is {part}, a number: make it an array, of the shape (1,)")
        starts_elsewhere = np.any(getattr(part, "start", 0))
        if is_flat and not starts_elsewhere and not (isinstance(part, spaces.MultiDiscrete) and len(part.shape) > 1):
            continue
        remedy = (
            "flatten the observations to one vector with gymnasium.wrappers.FlattenObservation(env)"
            if all(isinstance(leaf, FLATTENABLE) for _, leaf in leaves_of(space))
            else "give the observations a fixed size, for example by padding them to a Box"
        )
        what = f"{part}" if starts_elsewhere else f"a {type(part).__name__}"
        raise ValueError(
            f"{name} is {what}, but SB3's policies read Box, Discrete, MultiDiscrete (of one dimension) and MultiBinary, the "
            f"discrete ones from 0 on, and a Dict of these; {remedy}"
        )


def check_keys(space: spaces.Space[Any]) -> None:
    """
    :param space: observation space, of whose parts SB3's ``CombinedExtractor`` makes a network each
    :raises ValueError: for a key that PyTorch does not take as a name of a network
    """
    for key in space if isinstance(space, spaces.Dict) else ():
        try:
            nn.ModuleDict({key: nn.Identity()})
        except (KeyError, TypeError) as error:
            raise ValueError(f"observation_space has the key {key!r}, which PyTorch takes for no name: rename it") from error


# Given by the algorithm, set by the policy, or of gSDE, which no algorithm has
NO_POLICY_KWARGS = {"observation_space", "action_space", "lr_schedule", "squash_output", "use_sde", "full_std", "use_expln"}


def check_policy_kwargs(policy_class: type, policy_kwargs: dict[str, Any]) -> None:
    """
    :raises ValueError: if the policy has no such argument, where the message lists those it has, and for the name of a class
    """
    if not isinstance(policy_kwargs, dict):
        raise ValueError(f"policy_kwargs must be a dict, or None, got {policy_kwargs!r}")
    accepted = {*constructor_defaults(policy_class)} - NO_POLICY_KWARGS
    unknown = set(policy_kwargs) - accepted
    if unknown:
        raise ValueError(
            f"policy_kwargs has unknown key(s) {sorted(unknown)}; {policy_class.__name__} accepts {sorted(accepted)}"
        )
    arch = policy_kwargs.get("net_arch") or []
    for layers in arch.values() if isinstance(arch, dict) else [arch]:
        if not isinstance(layers, (list, tuple)) or not all(whole(1).test(units) for units in layers):
            raise ValueError(f"net_arch must be a list of whole numbers, or a dict of such lists, got {arch!r}")
    for name, value in policy_kwargs.items():
        if name.endswith(("_fn", "_class")) and not callable(value):
            raise ValueError(f"policy_kwargs[{name!r}] must be a class, got {value!r}")


def warn_of_memory(buffer: ReplayBuffer) -> None:
    """Warn if the rows of a replay buffer take much memory."""
    n_bytes = buffer.actions.nbytes
    if n_bytes > LARGE_ROWS:
        warnings.warn(
            f"The actions in the replay buffer will take {n_bytes / 1e9:.1f} GB: {buffer.action_dim} numbers for each of "
            f"buffer_size={buffer.buffer_size * buffer.n_envs} transitions",
            stacklevel=3,
        )
