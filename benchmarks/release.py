"""
The published models, from runs of ``sb3-chdp benchmark``.

    python benchmarks/release.py --results logs/benchmark  for every environment CHDP's best seed, and HyAR-TD3 on Hard Move 6
    sb3-chdp enjoy --env Platform-v0 -f benchmarks/models  watch one

A published model is a full zip of its algorithm, made small: the online networks of CHDP are replaced by their targets, by
which deterministic actions are chosen, and optimizers start anew. It predicts as the trained model does and can be trained on.
"""

import argparse
import zipfile
from pathlib import Path

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_chdp import ALGORITHMS, CHDP
from sb3_chdp.benchmark.results import read_results
from sb3_chdp.benchmark.statistics import cell_of, scores_of
from sb3_chdp.envs import ENV_IDS

ROOT = Path(__file__).parent
PUBLISHED = [("chdp", env_id) for env_id in ENV_IDS] + [("hyar_td3", "HardMove6-v0")]


def shrink(model: BaseAlgorithm) -> None:
    """Drop what a deterministic prediction does not need; see above."""
    if isinstance(model, CHDP):
        model.actor.load_state_dict(model.actor_target.state_dict())
        model.critic.load_state_dict(model.critic_target.state_dict())
    for name in model._get_torch_save_params()[0]:
        owner: object = model
        for part in name.split("."):
            owner = getattr(owner, part)
        if isinstance(owner, th.optim.Optimizer):
            owner.state.clear()


def save_compressed(model: BaseAlgorithm, path: Path) -> None:
    """Save as SB3 does, then compress: LZMA finds that targets equal online networks."""
    path.parent.mkdir(parents=True, exist_ok=True)
    model.save(path)
    with zipfile.ZipFile(path) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as archive:
        for name, content in contents.items():
            archive.writestr(name, content)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--results", type=Path, default=Path("logs/benchmark"))
    args = parser.parse_args()
    scores = scores_of(read_results(args.results))
    for algo, env_id in PUBLISHED:
        runs = cell_of(scores, algo, env_id).sort_values("score")
        folders = [args.results / algo / env_id / f"seed_{seed}" / algo / f"{env_id}_1" for seed in runs["seed"]]
        if not folders or not (folders[-1] / f"{env_id}.zip").exists():
            print(f"{algo} {env_id}: no trained model in {args.results}")
            continue
        model = ALGORITHMS[algo].load_class().load(folders[-1] / f"{env_id}.zip", device="cpu")
        shrink(model)
        path = ROOT / "models" / algo / f"{env_id}_1" / f"{env_id}.zip"
        save_compressed(model, path)
        print(f"{algo} {env_id}: seed {runs['seed'].iloc[-1]}, {path.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
