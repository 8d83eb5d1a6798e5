"""
The codebooks of Hard Move.

    python -m benchmarks.probes.codebook

Draws figures/codebook.png: the 64 codewords of Hard Move 6 on their two main axes, coloured by the direction in which the
action moves the agent. Prints for n = 4, 6, 8 and 10, as far as there are models, how much of the variance of the pushes a
linear function of the codewords explains (of random ones: latent_dim / K).
"""

import matplotlib

matplotlib.use("Agg")
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.probes.rollout import FIGURES, load_model, parser_of, published
from sb3_chdp.envs.hard_move import motion_table


def codewords_of(model: Any) -> np.ndarray:
    """:return: (K, d_e) codewords by which deterministic actions are chosen"""
    return model.actor_target.codebook.codewords.detach().numpy()


def explained_share(codewords: np.ndarray, motions: np.ndarray) -> float:
    """
    :param codewords: (K, d_e)
    :param motions: (K, 2) pushes of the discrete actions
    :return: share of the pushes' variance that a linear function of the codewords explains
    """
    inputs = np.column_stack([codewords, np.ones(len(codewords))])
    weights = np.linalg.lstsq(inputs, motions, rcond=None)[0]
    return 1 - float(np.square(motions - inputs @ weights).sum() / np.square(motions - motions.mean(axis=0)).sum())


def plot(codewords: np.ndarray, motions: np.ndarray) -> None:
    """The codewords on their two main axes."""
    centred = codewords - codewords.mean(axis=0)
    _, singular_values, axes = np.linalg.svd(centred, full_matrices=False)
    points = centred @ axes[:2].T
    shares = 100 * singular_values**2 / (singular_values**2).sum()
    figure, axis = plt.subplots(figsize=(6, 5))
    lengths = np.linalg.norm(motions, axis=1)
    moves = lengths > 1e-6
    angles = np.degrees(np.arctan2(motions[:, 1], motions[:, 0])) % 360
    x, y = points[moves].T
    picture = axis.scatter(x, y, c=angles[moves], s=160 * lengths[moves], cmap="hsv", vmin=0, vmax=360, edgecolors="black")
    axis.scatter(*points[~moves].T, marker="x", color="black", label="no motion")
    figure.colorbar(picture, label="direction of the motion, degrees (size: length)")
    axis.set(xlabel=f"first axis ({shares[0]:.0f} % of the variance)", ylabel=f"second axis ({shares[1]:.0f} %)")
    axis.legend()
    figure.tight_layout()
    figure.savefig(FIGURES / "codebook.png", dpi=100)


def main() -> None:
    parser_of(__doc__).parse_args()
    print("| environment | variance of the pushes that codewords explain |\n|---|---|")
    for n in [n for n in (4, 6, 8, 10) if published(f"HardMove{n}-v0").exists()]:
        codewords, motions = codewords_of(load_model(f"HardMove{n}-v0")), motion_table(n)
        print(f"| HardMove{n}-v0 | {100 * explained_share(codewords, motions):.0f} % |")
        if n == 6:
            plot(codewords, motions)


if __name__ == "__main__":
    main()
