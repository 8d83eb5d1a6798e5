"""The eight benchmarks of the paper and a larger Hard Move, registered with Gymnasium on import."""

from typing import Any

import gymnasium as gym
from gymnasium.envs.registration import WrapperSpec

# The count of the step limit belongs to the state of an episode
_STATE_OF_LIMIT = WrapperSpec("StatefulTimeLimit", "sb3_chdp.envs.time_limit:StatefulTimeLimit", {})


def _register(name: str, entry_point: str, **kwargs: Any) -> str:
    """Register under the full id of this package, and under the bare one unless another package has taken it."""
    entry_point = f"sb3_chdp.envs.{entry_point}"
    for env_id in (f"sb3_chdp/{name}", name):
        present = gym.registry.get(env_id)
        if present is None:
            gym.register(env_id, entry_point, additional_wrappers=(_STATE_OF_LIMIT,), **kwargs)
        elif present.entry_point != entry_point:
            gym.logger.warn(f"{env_id} is {present.entry_point}, registered before: this package's is sb3_chdp/{name}")
    return name


ENV_IDS = (
    _register("Platform-v0", "platform:PlatformEnv", max_episode_steps=200),
    # Goal's limit of 100 steps belongs to its dynamics: it is a termination
    _register("Goal-v0", "goal:GoalEnv"),
    _register("HardGoal-v0", "hard_goal:HardGoalEnv"),
    _register("CatchPoint-v0", "catch_point:CatchPointEnv", max_episode_steps=25),
    *(
        _register(f"HardMove{n}-v0", "hard_move:HardMoveEnv", max_episode_steps=30, kwargs={"n_actuators": n})
        for n in (4, 6, 8, 10)
    ),
)
_register("HardMove-v0", "hard_move:HardMoveEnv", max_episode_steps=30)
for n_actuators in (10, 12, 16, 20):
    factored = {"n_actuators": n_actuators, "factored": True}
    _register(f"FactoredHardMove{n_actuators}-v0", "hard_move:HardMoveEnv", max_episode_steps=30, kwargs=factored)

__all__ = ["ENV_IDS"]
