"""SustainGym's CogenEnv: seven switches and eight set points of a power plant, every quarter of an hour for a day."""

from compare import compare
from gymnasium.wrappers import FlattenObservation
from sustaingym.envs.cogen import CogenEnv


def change_nothing(env):
    return env.unwrapped.current_action


if __name__ == "__main__":
    # The observation holds the last action, which is a Dict of its own
    compare(FlattenObservation(CogenEnv()), change_nothing, n_timesteps=30_000, name="cogen")
