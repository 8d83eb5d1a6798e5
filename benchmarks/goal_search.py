"""
What a search reaches on Goal and Hard Goal that tries its actions in copies of the state, by the height of the start.

    python benchmarks/goal_search.py                                       Hard Goal, half an hour
    python benchmarks/goal_search.py --kicks 3 --starts 12.5 13.5 14.5     more kicks where they count, an hour
    python benchmarks/goal_search.py --env Goal-v0

No model plays. In every state the search shoots if no kick promises more, else it kicks to the best (v, 0) of a grid: that
after which the search, with a kick less, scores most. Every choice is scored by trials of its own, so that luck in the
choosing does not count. More or better kicks may do better: what is possible is at least this.
"""

import argparse
from typing import Any

import gymnasium as gym
import numpy as np

import sb3_chdp  # noqa: F401, registers the environments

# The height to which a kick goes changes nothing, hence (v, 0)
KICKS = (*np.arange(0, 1, 0.1), *np.arange(1, 2, 0.2), 2, 2.3, 2.6, 3, 3.5, 4, 4.5, 5, 5.5, *np.arange(6, 16), 17, 19, 21, 25)
N_SHOTS, N_RETRIED, RETRIALS = 60, 4, 6
# Above this share of goals a shot is not put off
CERTAIN = 0.9


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

    def best_shot(self, state: np.ndarray) -> float:
        """:return: share of goals of the best of random shots, in trials of its own"""
        shots = [(1 + i % self.n_shots, self.env.action_space[1].sample()) for i in range(N_SHOTS)]
        scoring = [shot for shot in shots if self.shoot(state, shot)][:N_RETRIED]
        if not scoring:
            return 0.0
        best = max(scoring, key=lambda shot: sum(self.shoot(state, shot) for _ in range(RETRIALS)))
        return float(np.mean([self.shoot(state, best) for _ in range(RETRIALS)]))

    def best_play(self, state: np.ndarray | None, n_kicks: int, trials: int) -> float:
        """
        :param state: where to play from, None if the episode is over
        :param n_kicks: how many kicks may precede the shot
        :param trials: of every kick when one is chosen; twice as many score the choice
        :return: share of goals
        """
        if state is None:
            return 0.0
        shot = self.best_shot(state)
        if n_kicks == 0 or shot > CERTAIN:
            return shot
        rates = [self.rate(state, v, n_kicks, trials, hopeless_after=2) for v in KICKS]
        if max(rates) <= shot:
            return shot
        return self.rate(state, KICKS[int(np.argmax(rates))], n_kicks, 2 * trials)

    def rate(self, state: np.ndarray, v: float, n_kicks: int, trials: int, hopeless_after: int | None = None) -> float:
        """:return: share of goals after a kick to (v, 0); 0 if the first ``hopeless_after`` trials have none"""
        goals = 0.0
        for trial in range(trials):
            if trial == hopeless_after and goals == 0:
                break
            goals += self.best_play(self.kick(state, v), n_kicks - 1, min(trials, 2))
        return goals / trials


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HardGoal-v0", choices=["Goal-v0", "HardGoal-v0"])
    parser.add_argument("--kicks", type=int, default=2, help="how many kicks may precede the shot")
    parser.add_argument("--starts", type=float, nargs="+", default=np.arange(-14.25, 15, 1.5), help="heights of the player")
    parser.add_argument("--trials", type=int, default=4, help="of every first kick; twice as many score the choice")
    args = parser.parse_args()
    referee = Referee(args.env)
    print("| start | goals, % |\n|---|---|")
    rates = []
    for y in args.starts:
        rates.append(referee.best_play(referee.start(y), args.kicks, args.trials))
        print(f"| {y:g} | {100 * rates[-1]:.0f} |", flush=True)
    print(f"| all | {100 * np.mean(rates):.0f} |")


if __name__ == "__main__":
    main()
