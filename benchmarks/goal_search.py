"""
What a search reaches on Goal and Hard Goal that tries its actions in copies of the state, by the height of the start.

    python benchmarks/goal_search.py                 Hard Goal, 10 minutes
    python benchmarks/goal_search.py --env Goal-v0

No model plays. The first kick goes to the best (v, 0) of a grid for the start, the second to the best of the state that
has come about, unless a shot is as good; the shot is the best of 60 random ones. Every choice is scored by trials of its
own, so that luck in the choosing does not count. More or better kicks may do better: what is possible is at least this.
"""

import argparse
from typing import Any

import gymnasium as gym
import numpy as np

import sb3_chdp  # noqa: F401, registers the environments

# The height to which a kick goes changes little, hence (v, 0)
KICKS = (0.0, 0.2, 0.4, 0.7, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 8.0, 12.0)
STARTS_PER_RANGE = 3
N_SHOTS, N_RETRIED, RETRIALS = 60, 4, 6
# Trials of a first kick when it is chosen and when it is scored, of a second kick when it is chosen
FIRST_TRIALS, FIRST_RETRIALS, SECOND_TRIALS = 4, 20, 2


class Referee:
    """
    Tries kicks and shots from any state.

    :param env_id: Goal-v0 or HardGoal-v0
    """

    def __init__(self, env_id: str):
        self.env: Any = gym.make(env_id).unwrapped
        self.env.reset(seed=0)
        self.env.action_space.seed(0)
        self.n_shots = len(self.env.action_space[1]) - 1

    def start(self, y: float) -> np.ndarray:
        """:return: state at the start of an episode, the player at height y"""
        self.env._place_at_start(y)
        return self.env.get_state()

    def kick(self, state: np.ndarray, v: float) -> np.ndarray | None:
        """:return: state after a kick to (v, 0), None if the episode is over"""
        self.env.set_state(state)
        parameters = [space.low for space in self.env.action_space[1]]
        parameters[0] = np.array([v, 0.0], dtype=np.float32)
        over = self.env.step((0, tuple(parameters)))[2]
        return None if over else self.env.get_state()

    def shoot(self, state: np.ndarray, action: tuple[int, Any]) -> bool:
        """:return: whether a shot scores"""
        self.env.set_state(state)
        return self.env.step(action)[4]["is_success"]

    def best_shot(self, state: np.ndarray | None) -> float:
        """:return: share of goals of the best of random shots, in trials of its own; 0 if the episode is over"""
        if state is None:
            return 0.0
        shots = [(1 + i % self.n_shots, self.env.action_space[1].sample()) for i in range(N_SHOTS)]
        scoring = [shot for shot in shots if self.shoot(state, shot)][:N_RETRIED]
        if not scoring:
            return 0.0
        best = max(scoring, key=lambda shot: sum(self.shoot(state, shot) for _ in range(RETRIALS)))
        return float(np.mean([self.shoot(state, best) for _ in range(RETRIALS)]))

    def kick_or_shoot(self, state: np.ndarray | None) -> float:
        """:return: share of goals of the better of shooting at once and after one more kick, in trials of its own"""
        if state is None:
            return 0.0
        rates = [np.mean([self.best_shot(self.kick(state, v)) for _ in range(SECOND_TRIALS)]) for v in KICKS]
        if self.best_shot(state) >= max(rates):
            return self.best_shot(state)
        return self.best_shot(self.kick(state, KICKS[int(np.argmax(rates))]))

    def best_play(self, y: float) -> float:
        """:return: share of goals from height y"""
        state = self.start(y)

        def rate(v: float, n: int) -> float:
            return float(np.mean([self.kick_or_shoot(self.kick(state, v)) for _ in range(n)]))

        rates = [rate(v, FIRST_TRIALS) for v in KICKS]
        if self.best_shot(state) >= max(rates):
            return self.best_shot(state)
        return rate(KICKS[int(np.argmax(rates))], FIRST_RETRIALS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HardGoal-v0", choices=["Goal-v0", "HardGoal-v0"])
    args = parser.parse_args()
    referee = Referee(args.env)
    print("| start | goals, % | of single starts |")
    print("|---|---|---|")
    total = []
    for low in range(-15, 15, 3):
        heights = low + 3 * (np.arange(STARTS_PER_RANGE) + 0.5) / STARTS_PER_RANGE
        rates = [referee.best_play(y) for y in heights]
        total += rates
        numbers = ", ".join(f"{100 * rate:.0f}" for rate in rates)
        print(f"| {low} to {low + 3} | {100 * np.mean(rates):.0f} | {numbers} |", flush=True)
    print(f"| all | {100 * np.mean(total):.0f} | |")


if __name__ == "__main__":
    main()
