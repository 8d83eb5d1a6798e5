"""
What the policies of Hard Move 6 have learnt: the paper's expressiveness experiment, and the codebook in two dimensions.

    python benchmarks/reproduce.py expressivity

The published models draw 100 actions at one state: the agent at rest, the target so close above it that many subsets of the
actuators reach it in one step. Rewrites its section of benchmarks/README.md, and expressivity.png and codebook.png in figures.
"""

import gymnasium as gym
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from cells import ALGORITHMS, ROOT
from stable_baselines3.common.base_class import BaseAlgorithm
from tables import FIGURES, NAMES, README, replace_section

from sb3_chdp.envs.point_mass import motion_table

ENV_ID = "HardMove6-v0"
N_ACTIONS = 100
# One step moves the agent by 0.02 at most, and 0.2 is near enough
START, TARGET = (0.0, 0.0), (0.0, 0.205)
MOTIONS = motion_table(6)


def load_model(algo: str) -> BaseAlgorithm:
    """:return: the published model of Hard Move 6"""
    return ALGORITHMS[algo].load(ROOT / "models" / algo / f"{ENV_ID}_1" / ENV_ID, device="cpu")


def draw_actions(model: BaseAlgorithm) -> pd.DataFrame:
    """:return: a line per action at the state: subset k, strength s, whether the step reaches the target"""
    env = gym.make(ENV_ID, start=START, target=TARGET)
    model.set_random_seed(0)
    lines = []
    for _ in range(N_ACTIONS):
        obs, _ = env.reset()
        action, _ = model.predict(obs)
        _, _, terminated, _, _ = env.step(action)
        k = int(action[0])
        lines.append({"k": k, "s": float(action[1][k][0]), "reached": terminated})
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


def plot_draws(draws: dict[str, pd.DataFrame]) -> None:
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


def plot_codebook(codewords: np.ndarray) -> None:
    """
    The codewords on their two main axes, coloured by the direction in which the action moves the agent at strength 1.

    :param codewords: (64, d_e)
    """
    centred = codewords - codewords.mean(axis=0)
    _, singular_values, axes = np.linalg.svd(centred, full_matrices=False)
    points = centred @ axes[:2].T
    shares = 100 * singular_values**2 / (singular_values**2).sum()
    figure, axis = plt.subplots(figsize=(6, 5))
    lengths = np.linalg.norm(MOTIONS, axis=1)
    moves = lengths > 1e-6
    angles = np.degrees(np.arctan2(MOTIONS[:, 1], MOTIONS[:, 0])) % 360
    picture = axis.scatter(
        *points[moves].T, c=angles[moves], s=160 * lengths[moves], cmap="hsv", vmin=0, vmax=360, edgecolors="black"
    )
    axis.scatter(*points[~moves].T, marker="x", color="black", label="no motion")
    figure.colorbar(picture, label="direction of the motion, degrees (size: length)")
    axis.set(xlabel=f"first axis ({shares[0]:.0f} % of the variance)", ylabel=f"second axis ({shares[1]:.0f} %)")
    axis.legend()
    figure.tight_layout()
    figure.savefig(FIGURES / "codebook.png", dpi=100)


def main() -> None:
    chdp = load_model("chdp")
    name, policy = NAMES["chdp"], chdp.policy
    draws = {f"{name}, as it acts": draw_actions(chdp)}
    policy.n_action_candidates, policy.n_random_candidates = 1, 0
    draws = {name: draw_actions(chdp), **draws}
    draws[NAMES["hyar_td3"]] = draw_actions(load_model("hyar_td3"))
    text = markdown(draws)
    print(text)
    replace_section(README, "expressivity", text)
    plot_draws(draws)
    plot_codebook(policy.actor.codebook.codewords.detach().numpy())


if __name__ == "__main__":
    main()
