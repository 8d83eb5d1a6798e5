"""
What the policies of Hard Move 6 draw: the paper's expressiveness experiment.

    python -m benchmarks.probes.expressivity

The published models draw 100 actions at one state: the agent at rest, the target so close above it that many subsets of the
actuators reach it in one step. Prints the table of benchmarks/README.md and draws figures/expressivity.png.
"""

import matplotlib

matplotlib.use("Agg")
from typing import Any

import gymnasium as gym
import matplotlib.pyplot as plt
import pandas as pd

from benchmarks.probes.rollout import FIGURES, load_model, make_env, parser_of, play
from sb3_chdp import HyARTD3
from sb3_chdp.chdp.candidates import Selection
from sb3_chdp.envs.hard_move import motion_table

ENV_ID = "HardMove6-v0"
N_ACTIONS = 100
# One step moves the agent by 0.02 at most, and 0.2 is near enough
STATE = {"start": (0.0, 0.0), "target": (0.0, 0.205)}
MOTIONS = motion_table(6)


def draw_actions(model: Any, env: gym.Env) -> pd.DataFrame:
    """:return: a line per action at the state: subset k, strength s, whether the step reaches the target"""
    model.set_random_seed(0)
    lines = []
    for _ in range(N_ACTIONS):
        episode = play(model, env, options=STATE, deterministic=False)
        k = int(episode.actions[0][0])
        lines.append({"k": k, "s": float(episode.actions[0][1][k][0]), "reached": episode.success})
    return pd.DataFrame(lines)


def markdown(draws: dict[str, pd.DataFrame]) -> str:
    """:return: the paper's table: a line per algorithm and motion, the most frequent first"""
    lines = ["| policy | base direction | frequency | strength | reached in one step |", "|---|---|---|---|---|"]
    for name, actions in draws.items():
        # Different subsets with the same motion are one base direction
        directions = MOTIONS[actions["k"]].round(3) + 0.0
        groups = actions.assign(x=directions[:, 0], y=directions[:, 1]).groupby(["x", "y"])
        for (x, y), group in sorted(groups, key=lambda item: -len(item[1])):
            strength = f"{group['s'].mean():.3f} ± {group['s'].std(ddof=0):.3f}"
            reached = f"{100 * group['reached'].mean():.0f} %"
            lines.append(f"| {name} | ({x:.3f}, {y:.3f}) | {len(group)} % | {strength} | {reached} |")
    return "\n".join(lines)


def plot(draws: dict[str, pd.DataFrame]) -> None:
    """The force of every action: motion of the subset times strength."""
    figure, axes = plt.subplots(1, len(draws), figsize=(4 * len(draws), 4), sharex=True, sharey=True)
    for axis, (name, actions) in zip(axes, draws.items(), strict=True):
        forces = 2 * MOTIONS[actions["k"]] * actions["s"].to_numpy()[:, None]
        axis.scatter(*forces.T, c=actions["k"], cmap="tab20", alpha=0.6)
        axis.set(title=name, xlabel="force x", xlim=(-2.2, 2.2), ylim=(-2.2, 2.2), aspect="equal")
        axis.axhline(0, color="lightgray", zorder=0)
        axis.axvline(0, color="lightgray", zorder=0)
    axes[0].set_ylabel("force y")
    figure.tight_layout()
    figure.savefig(FIGURES / "expressivity.png", dpi=100, bbox_inches="tight")


def main() -> None:
    parser_of(__doc__).parse_args()
    chdp, env = load_model(ENV_ID), make_env(ENV_ID, max_episode_steps=1)
    as_it_acts = draw_actions(chdp, env)
    # What the policies draw, without the choice among candidates
    chdp.policy.select = Selection(n_drawn=1)
    draws = {"CHDP": draw_actions(chdp, env), "CHDP, as it acts": as_it_acts}
    draws["HyAR-TD3"] = draw_actions(load_model(ENV_ID, HyARTD3), env)
    print(markdown(draws))
    plot(draws)


if __name__ == "__main__":
    main()
