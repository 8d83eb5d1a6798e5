"""The counterpart of SB3's ``check_env`` for environments with hybrid actions."""

import warnings

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_checker import check_env

from sb3_chdp.common.spaces import HybridActionSpec
from sb3_chdp.wrappers import FlattenHybridAction

N_STEPS = 20


def check_hybrid_env(env: gym.Env, action_layout: str = "auto", warn: bool = True, skip_render_check: bool = True) -> None:
    """
    Check that an environment with hybrid actions can be used with this package.

    Its action space must be readable as a hybrid one; all else that SB3's ``check_env`` demands is checked on the
    flattened environment. Then native actions are played, including those at the ends of every action's parameters.

    :param env: the environment
    :param action_layout: see :class:`HybridActionSpec`
    :param warn: whether to warn about legal but unusual things
    :param skip_render_check: whether to skip the checks of the render method
    :raises ValueError: if the action space is not a hybrid one
    :raises AssertionError: if the environment breaks the API
    """
    spec = HybridActionSpec(env.action_space, action_layout)
    check_env(FlattenHybridAction(env, action_layout), warn=warn, skip_render_check=skip_render_check)
    if warn and spec.n_discrete_actions == 1:
        warnings.warn("The action space has a single discrete action: an algorithm for Box actions would do.")

    env.reset(seed=0)
    rng = np.random.default_rng(0)
    n_shown = min(spec.n_discrete_actions, N_STEPS)
    if spec.is_factored:
        choices = np.linspace(0, np.array(spec.radices) - 1, n_shown).astype(int)
    else:
        choices = np.linspace(0, spec.n_discrete_actions - 1, n_shown).astype(int)
    ends = [np.append(k, np.full(spec.max_parameters, end)) for k in choices for end in (-1.0, 1.0)]
    with_success, n_steps = 0, 0
    for row in [*ends, *spec.sample_rows(rng, N_STEPS)]:
        action = spec.to_native(row)
        assert env.action_space.contains(action), f"{action} was made for {env.action_space} but is not in it"
        obs, reward, terminated, truncated, info = env.step(action)
        assert np.isfinite(float(reward)), f"The reward must be finite, got {reward} after the action {action}"
        parts = obs.values() if isinstance(obs, dict) else [obs]
        assert all(np.isfinite(part).all() for part in parts), f"The observation must be finite, got {obs} after {action}"
        n_steps += 1
        with_success += "is_success" in info
        if terminated or truncated:
            env.reset()
    # Monitor and EvalCallback fail when only some steps report it
    assert with_success in (0, n_steps), "info['is_success'] must be there on every step or on none"
