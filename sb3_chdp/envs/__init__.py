"""The eight benchmarks of the paper, registered with Gymnasium on import."""

import gymnasium as gym

ENV_IDS = (
    "Platform-v0",
    "Goal-v0",
    "HardGoal-v0",
    "CatchPoint-v0",
    "HardMove4-v0",
    "HardMove6-v0",
    "HardMove8-v0",
    "HardMove10-v0",
)

# Goal's limit of 100 steps belongs to its dynamics: it is a termination
gym.register("Platform-v0", entry_point="sb3_chdp.envs.platform:PlatformEnv", max_episode_steps=200)
gym.register("Goal-v0", entry_point="sb3_chdp.envs.goal:GoalEnv")
gym.register("HardGoal-v0", entry_point="sb3_chdp.envs.hard_goal:HardGoalEnv")
gym.register("CatchPoint-v0", entry_point="sb3_chdp.envs.point_mass:CatchPointEnv", max_episode_steps=25)
gym.register("HardMove-v0", entry_point="sb3_chdp.envs.point_mass:HardMoveEnv", max_episode_steps=30)
for n_actuators in (4, 6, 8, 10):
    gym.register(
        f"HardMove{n_actuators}-v0",
        entry_point="sb3_chdp.envs.point_mass:HardMoveEnv",
        max_episode_steps=30,
        kwargs={"n_actuators": n_actuators},
    )

__all__ = ["ENV_IDS"]
