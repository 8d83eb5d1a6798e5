"""``sb3-chdp push_to_hub``: a run becomes a repository of the Hugging Face Hub."""

import argparse
import json
import shutil
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from huggingface_hub import HfApi
from huggingface_sb3 import EnvironmentName, ModelName
from rl_zoo3.utils import ALGOS, create_test_env, get_model_path, get_saved_hyperparams
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_chdp.common.evaluation import evaluate_episodes
from sb3_chdp.envs.recorder import FrameVideoRecorder
from sb3_chdp.hub.card import Evaluation, make_card

# Folder of the repositories on this machine
LOCAL = Path("hub")
VIDEO = "replay.mp4"


def make_parser() -> argparse.ArgumentParser:
    """:return: the parser of the command line, with rl_zoo3's names"""
    description = "Publish a trained model on the Hugging Face Hub."
    parser = argparse.ArgumentParser(prog="sb3-chdp push_to_hub", description=description)
    add = parser.add_argument
    add("--env", type=EnvironmentName, required=True, help="environment")
    add("--algo", required=True, choices=list(ALGOS), help="algorithm")
    add("-f", "--folder", required=True, help="folder of the runs")
    add("--exp-id", type=int, default=0, help="number of the run (default: 0, the last one)")
    add("--load-best", action="store_true", help="the best model of the evaluations instead of the last one")
    add("--load-checkpoint", type=int, metavar="STEPS", help="a checkpoint instead of the last model")
    add("--load-last-checkpoint", action="store_true", help="the last checkpoint instead of the last model")
    add("-orga", "--organization", required=True, help="user or organization on the Hub")
    add("-name", "--repo-name", help="repository (default: ALGORITHM-ENVIRONMENT)")
    add("-m", "--commit-message", default="Add the model", help="commit message")
    add("--eval-episodes", type=int, default=100, help="episodes of the results on the card (default: 100)")
    add("-n", "--n-timesteps", type=int, default=500, help="pictures of the video (default: 500)")
    add("--no-render", action="store_true", help="no video")
    add("--seed", type=int, default=0, help="seed of the episodes (default: 0)")
    add("--no-upload", action="store_true", help=f"write the repository into the folder {LOCAL} and look at it first")
    return parser


def record(model: BaseAlgorithm, env: VecEnv, length: int, path: Path) -> None:
    """Write a video of so many pictures; the environment is closed."""
    with tempfile.TemporaryDirectory() as folder:
        recorder = FrameVideoRecorder(env, folder, lambda step: step == 0, length)
        obs: Any = recorder.reset()
        while recorder.recording:
            actions, _ = model.predict(obs, deterministic=True)
            obs = recorder.step(actions)[0]
        recorder.close()
        shutil.move(next(Path(folder).glob("*.mp4")), path)


def make_repository(args: argparse.Namespace, folder: Path) -> str:
    """
    Write everything that is published, in rl_zoo3's form.

    :param args: command line
    :param folder: where to; what is there is replaced
    :return: ``organization/name`` of the repository
    """
    algo, env_name = args.algo, args.env
    model_name = ModelName(algo, env_name)
    repo_id = f"{args.organization}/{args.repo_name or model_name}"
    _, model_path, log_path = get_model_path(
        args.exp_id, args.folder, algo, env_name, args.load_best, args.load_checkpoint, args.load_last_checkpoint
    )
    hyperparams, stats_path = get_saved_hyperparams(f"{log_path}/{env_name}", test_mode=True)
    published = {key: value for key, value in hyperparams.items() if key != "normalize_kwargs"}
    arguments = Path(log_path, env_name, "args.yml")
    trained_with = yaml.load(arguments.read_text(), Loader=yaml.UnsafeLoader) if arguments.is_file() else {}
    env_kwargs = {**(hyperparams.pop("env_kwargs", None) or {}), **(trained_with.get("env_kwargs") or {})}

    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    render = {} if args.no_render else {"render_mode": "rgb_array"}
    env = create_test_env(
        env_name.gym_id,
        stats_path=stats_path,
        seed=args.seed,
        should_render=False,
        hyperparams=hyperparams,
        env_kwargs={**env_kwargs, **render},
    )
    model = ALGOS[algo].load(model_path, env=env, device="cpu")
    returns, _, successes = evaluate_episodes(model, env, args.eval_episodes)
    evaluation = Evaluation(np.array(returns).tolist(), [] if np.isnan(successes).any() else successes)
    if args.no_render:
        env.close()
    else:
        record(model, env, args.n_timesteps, folder / VIDEO)

    shutil.copy(model_path, folder / model_name.filename)
    # Plain YAML, without Python objects: whoever downloads it reads it with yaml.safe_load. No folders of this machine
    (folder / "config.yml").write_text(yaml.safe_dump(json.loads(json.dumps(published, default=str))))
    (folder / "env_kwargs.yml").write_text(yaml.safe_dump(env_kwargs))
    (folder / "args.yml").write_text(yaml.safe_dump({"algo": algo, "env": env_name.gym_id, "env_kwargs": env_kwargs}))
    (folder / "results.json").write_text(json.dumps(evaluation._asdict()))
    if Path(log_path, env_name, "vecnormalize.pkl").is_file():
        shutil.copy(Path(log_path, env_name, "vecnormalize.pkl"), folder / "vec_normalize.pkl")
    with zipfile.ZipFile(folder / "train_eval_metrics.zip", "w") as archive:
        for file in (*Path(log_path).glob("evaluations.npz"), *Path(log_path).glob("*.monitor.csv")):
            archive.write(file, file.name)
    n_timesteps, has_video = model.num_timesteps, not args.no_render
    card = make_card(algo, env_name.gym_id, repo_id, model_name.filename, evaluation, published, n_timesteps, has_video)
    card.save(folder / "README.md")
    return repo_id


def main() -> None:
    """Entry point of ``sb3-chdp push_to_hub``."""
    args = make_parser().parse_args()
    folder = LOCAL / (args.repo_name or ModelName(args.algo, args.env))
    repo_id = make_repository(args, folder)
    print(f"{repo_id} is in {folder}")
    if args.no_upload:
        return
    api = HfApi()
    url = api.create_repo(repo_id, exist_ok=True)
    api.upload_folder(repo_id=repo_id, folder_path=folder, commit_message=args.commit_message)
    print(f"Uploaded to {url}")
