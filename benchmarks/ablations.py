"""
What the parts of CHDP are good for: it without diffusion policies, without codebook, without sequential update.

    python benchmarks/ablations.py ablation --jobs 2           with the paper's settings
    python benchmarks/ablations.py ablation_tuned --jobs 2     with those of the YAML file

Options are those of ``sb3-chdp benchmark``. ``publish.py`` makes the tables.
"""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from sb3_chdp.benchmark.cli import make_runs, parse, train_all
from sb3_chdp.benchmark.paper import EVAL_EPISODES

RESULTS = Path(__file__).parent / "results"
TABLES = {"ablation": "Ablation with the paper's settings", "ablation_tuned": "Ablation with our settings"}
ENVS = ("HardGoal-v0", "HardMove6-v0")
SEEDS = ("10", "11", "12")
# The paper's default parameters, losses and critics, and no search beyond the policies' own draws, which may cover up what
# they lack
PAPER_SETTINGS: dict[str, Any] = {
    "n_diffusion_steps": 15,
    "eta": 10.0,
    "latent_dim": 8,
    "improvement_parameters": "stored",
    "uniform_fraction": 0.0,
    "n_random_candidates": 0,
    "n_refinement_candidates": 0,
    "critics_train_codebook": False,
    "prioritized_replay": False,
    "codebook_lr_factor": 0.1,
    "n_target_candidates": 1,
    "policy_kwargs": {"whitening": False, "layer_norm": False, "parameter_degree": 1, "bilinear": False},
}
VARIANTS: dict[str, dict[str, Any]] = {
    "full": {},
    "without_diffusion": {"diffusion": False},
    "without_codebook": {"codebook": False},
    "without_sequential_update": {"sequential_update": False},
    "without_both": {"codebook": False, "sequential_update": False},
}
# The paper's success rates in percent, mean and standard deviation, in the order of the variants
PAPER = {
    "HardGoal-v0": ("81.8 ± 3.5", "49.8 ± 26.9", "73.3 ± 7.8", "53.5 ± 14.5", "52.4 ± 13.7"),
    "HardMove6-v0": ("94.4 ± 1.2", "88.2 ± 5.6", "56.1 ± 12.5", "92.3 ± 4.5", "54.6 ± 9.6"),
}


def paper_column(row: str, env: str) -> str:
    """:return: what the paper prints for a variant"""
    return dict(zip(VARIANTS, PAPER[env], strict=True))[row]


def main() -> None:
    table, *options = sys.argv[1:] or [""]
    if table not in TABLES:
        sys.exit(__doc__)
    defaults = ["--algos", "chdp", "--envs", *ENVS, "--seeds", *SEEDS, "--out", str(RESULTS / table)]
    args, slurm = parse([*defaults, "--eval-episodes", str(EVAL_EPISODES), *options])
    settings = PAPER_SETTINGS if table == "ablation" else {}
    runs = [
        replace(run, name=name, overrides={**settings, **variant, **run.overrides})
        for run in make_runs(args)
        for name, variant in VARIANTS.items()
    ]
    sys.exit("\n".join(train_all(runs, args, slurm, Console())) or 0)


if __name__ == "__main__":
    main()
