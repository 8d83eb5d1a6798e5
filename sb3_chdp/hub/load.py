"""``sb3-chdp load_from_hub``: a repository of the Hugging Face Hub becomes a run in the folder of logs."""

import argparse
import shutil
from pathlib import Path
from typing import Any

import yaml
from huggingface_hub import HfApi, hf_hub_download
from huggingface_sb3 import EnvironmentName, ModelName
from rl_zoo3.load_from_hub import download_from_hub
from rl_zoo3.utils import ALGOS, get_latest_run_id

from sb3_chdp.registry import ALGORITHMS
from sb3_chdp.zoo_arguments import LOGS, ArgumentsError

_TRUST = "--trusted loads it all the same, if you know who made it"
# Settings that name code, or need statistics that are a pickle
CODE = ("env_wrapper", "vec_env_wrapper", "frame_stack", "normalize")


def make_parser() -> argparse.ArgumentParser:
    """:return: the parser of the command line, with rl_zoo3's names"""
    parser = argparse.ArgumentParser(
        prog="sb3-chdp load_from_hub", description="Download a model from the Hugging Face Hub. None of its code runs."
    )
    add = parser.add_argument
    add("--env", type=EnvironmentName, required=True, help="environment")
    add("--algo", required=True, choices=list(ALGOS), help="algorithm")
    add("-orga", "--organization", required=True, help="user or organization on the Hub")
    add("-name", "--repo-name", help="repository (default: ALGORITHM-ENVIRONMENT)")
    add("-f", "--folder", default=LOGS, help=f"folder of the runs (default: {LOGS})")
    add("--exp-id", type=int, default=0, help="number of the run that it becomes (default: 0, the next one)")
    add("--force", action="store_true", help="replace a run of this number")
    add("--trusted", action="store_true", help="take what can run code too: wrappers, pickles, Stable-Baselines3's own models")
    return parser


def download(args: argparse.Namespace, run: Path) -> None:
    """
    Download model and arguments of the environment, which are all that an untrusted repository gives.

    :param args: command line
    :param run: folder of the run
    :raises ArgumentsError: if the model needs more than that
    """
    model_name = ModelName(args.algo, args.env)
    repo_id = f"{args.organization}/{args.repo_name or model_name}"
    if args.algo not in ALGORITHMS:
        raise ArgumentsError(f"models of Stable-Baselines3's own {args.algo} are pickles, which can run any code; {_TRUST}")
    files = HfApi().list_repo_files(repo_id)
    config, env_kwargs = (
        _plain(hf_hub_download(repo_id, name), name) if name in files else {} for name in ("config.yml", "env_kwargs.yml")
    )
    needed = [key for key in CODE if config.get(key)]
    if needed:
        raise ArgumentsError(f"{repo_id} was trained with {', '.join(needed)}, which can run any code; {_TRUST}")
    model = hf_hub_download(repo_id, model_name.filename)
    # Refuses what is not safe to read
    ALGORITHMS[args.algo].load_class().load(model, device="cpu")
    shutil.rmtree(run, ignore_errors=True)
    (run / args.env).mkdir(parents=True)
    shutil.copy(model, run / f"{args.env}.zip")
    (run / args.env / "args.yml").write_text(yaml.safe_dump({"env_kwargs": env_kwargs}))


def _plain(path: str, name: str) -> dict[str, Any]:
    """:return: a YAML file without Python objects"""
    try:
        content = yaml.safe_load(Path(path).read_text())
    except yaml.YAMLError:
        raise ArgumentsError(f"{name} of the repository holds Python objects, which can run any code; {_TRUST}") from None
    return content if isinstance(content, dict) else {}


def main() -> None:
    """Entry point of ``sb3-chdp load_from_hub``."""
    args = make_parser().parse_args()
    exp_id = args.exp_id or get_latest_run_id(str(Path(args.folder, args.algo)), args.env) + 1
    run = Path(args.folder, args.algo, f"{args.env}_{exp_id}")
    if run.exists() and not args.force:
        raise ArgumentsError(f"{run} is there already; --force replaces it, --exp-id 0 takes the next number")
    if args.trusted:
        download_from_hub(args.algo, args.env, exp_id, args.folder, args.organization, args.repo_name, args.force)
        return
    download(args, run)
    print(f"Saving to {run}")
