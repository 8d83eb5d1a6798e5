"""The command line, really run on tiny budgets."""

import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import yaml
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_chdp import ALGORITHMS, CHDP
from sb3_chdp.cli import DISPLAYS, SCRIPTS
from sb3_chdp.envs import ENV_IDS
from sb3_chdp.zoo_plots import tell_runs_apart
from tests.commands import main, run, start

pytest.importorskip("rl_zoo3")
optuna = pytest.importorskip("optuna")

ENV_ID = "HardMove4-v0"
TINY = ["-params", "n_envs:2", "learning_starts:20", "n_diffusion_steps:2", "batch_size:8", "buffer_size:500"]
DEFAULT = next(iter(ALGORITHMS))


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A folder in which ``sb3-chdp train`` ran."""
    folder = tmp_path_factory.mktemp("zoo")
    run(
        "train", "--env", ENV_ID, "-n", "300", "--eval-freq", "100", "--eval-episodes", "2", "--n-eval-envs", "2",
        "--save-freq", "100", "--save-replay-buffer", "-P", *TINY, cwd=folder,
    )  # fmt: skip
    return folder


def test_train(trained):
    folder = trained / "logs" / "chdp" / f"{ENV_ID}_1"
    assert (folder / f"{ENV_ID}.zip").is_file() and (folder / "best_model.zip").is_file()
    assert len(np.load(folder / "evaluations.npz")["successes"]) >= 2
    config = dict(yaml.load((folder / ENV_ID / "config.yml").read_text(), Loader=yaml.UnsafeLoader))
    own = yaml.safe_load(ALGORITHMS[DEFAULT].hyperparams.read_text())[ENV_ID]
    assert config["gradient_steps"] == own["gradient_steps"] != 1, "the YAML file of the package was used"


def test_continue(trained):
    model = Path("logs") / "chdp" / f"{ENV_ID}_1" / f"{ENV_ID}.zip"
    run("train", "--algo", "chdp", "--env", ENV_ID, "-i", str(model), "-n", "100", "--eval-freq", "-1", "-f", "continued",
        "--vec-env", "subproc", *TINY, cwd=trained)  # fmt: skip
    assert (trained / "continued" / "chdp" / f"{ENV_ID}_1" / f"{ENV_ID}.zip").is_file()


@pytest.mark.parametrize("which", [(), ("--load-best", "--n-envs", "2"), ("--load-last-checkpoint", "--stochastic")], ids=str)
def test_enjoy(trained, which):
    output = run("enjoy", "--env", ENV_ID, "-f", "logs", "--no-render", "-n", "150", *which, cwd=trained)
    # rl_zoo3 counts episodes of a single environment only
    assert "--n-envs" in which or ("Success rate" in output and "Mean reward" in output)


def test_enjoy_renders(trained):
    run("enjoy", "--env", ENV_ID, "-f", "logs", "-n", "5", cwd=trained)


def test_enjoy_without_arguments(trained):
    """The run that was trained last, of those in the folder logs."""
    assert f"logs/chdp/{ENV_ID}_1" in run("enjoy", "--no-render", "-n", "5", cwd=trained)


def test_plot(trained):
    for arguments in (["--env", ENV_ID, "-f", "logs", "-y", "success"], []):
        output = run("plot", *arguments, "-w", "2", "-o", "pictures/plot.png", cwd=trained)
        assert output == "Saving to pictures/plot.png\n", "no warnings either"
        picture = trained / "pictures" / "plot.png"
        assert picture.read_bytes().startswith(b"\x89PNG")
        picture.unlink()
    assert "-o FILE.png" in run("plot", "-w", "2", cwd=trained, code=1), "there is no display"
    assert "nothing to plot" in run("plot", "-w", "5000", "-o", "plot.png", cwd=trained, code=1)


def test_all_plots(trained):
    output = run("all_plots", "-a", "chdp", "-e", ENV_ID, "-f", "logs", "-k", "successes", "-o", "all.png", cwd=trained)
    assert "Warning" not in output and (trained / "all.png").read_bytes().startswith(b"\x89PNG")
    run("all_plots", "-o", "post", cwd=trained)
    assert (trained / "post.pkl").is_file()


def test_runs_of_other_environments_with_longer_names(tmp_path):
    """Goal-v0 is a part of HardGoal-v0."""
    names = ["HardGoal-v0_1", "Goal-v0_1", "Goal-v0_12", "sb3_chdp-Goal-v0_1"]
    for name in names:
        (tmp_path / name).mkdir()
    module = ModuleType("script")
    tell_runs_apart(module)
    listings = module.os.listdir(tmp_path), [entry.name for entry in module.os.scandir(tmp_path)]
    for listing in listings:
        assert sorted(name for name in listing if "Goal-v0" in name) == ["Goal-v0_1", "Goal-v0_12"]
        assert sorted(name for name in listing if "Goal" in name) == sorted(names), "what names no environment, as in rl_zoo3"
    assert all(entry.is_dir() for entry in module.os.scandir(tmp_path))


def test_record(trained):
    run("record", "--env", ENV_ID, "-f", "logs", "-n", "20", "-o", "videos", cwd=trained)
    assert list((trained / "videos").glob("*.mp4"))


def test_optimize_and_train_the_best_trial(trained):
    study = ["--storage", "study.log", "--study-name", "s", "-f", "tuned"]
    run("optimize", "--env", ENV_ID, "-n", "60", "--n-trials", "2", "--n-startup-trials", "1", "--n-evaluations", "1",
        "--eval-episodes", "1", "--no-optim-plots", *study, cwd=trained)  # fmt: skip
    journal = optuna.storages.journal.JournalFileBackend(str(trained / "study.log"))
    trials = optuna.load_study(study_name="s", storage=optuna.storages.JournalStorage(journal)).trials
    models: set[Path] = set()
    for trial in trials:
        train = ["train", "--env", ENV_ID, "-n", "60", "--eval-freq", "-1", "--trial-id", str(trial.number), *study]
        run(*train, cwd=trained)
        (path,) = set((trained / "tuned").rglob(f"{ENV_ID}.zip")) - models
        models.add(path)
        model = CHDP.load(path)
        assert model.gamma == pytest.approx(1 - trial.params["one_minus_gamma"])
    message = run("train", "--env", ENV_ID, "--trial-id", "7", *study, cwd=trained, code=1)
    assert "--trial-id 7: the study s has no such trial" in message


def small(algo):
    """Settings with which an algorithm learns within 60 steps."""
    off_policy = issubclass(ALGORITHMS[algo].load_class(), OffPolicyAlgorithm)
    settings = ["learning_starts:20", "buffer_size:100"] if off_policy else ["n_steps:5", "batch_size:10"]
    return [*settings, "representation_warmup_steps:5"] if algo == "hyar_td3" else settings


@pytest.mark.parametrize("algo", [name for name in ALGORITHMS if name != DEFAULT])
def test_every_algorithm(algo, tmp_path):
    run("train", "--algo", algo, "--env", ENV_ID, "-n", "60", "-params", *small(algo), "--eval-freq", "-1", cwd=tmp_path)
    run("enjoy", "--algo", algo, "--env", ENV_ID, "-f", "logs", "--no-render", "-n", "40", cwd=tmp_path)
    can_be_tuned = ALGORITHMS[algo].tuning is not None
    output = run("optimize", "--algo", algo, "--env", ENV_ID, "-n", "40", "--n-trials", "1", "--n-evaluations", "1",
                 "--eval-episodes", "1", "--no-optim-plots", "-f", "tuned", cwd=tmp_path, code=not can_be_tuned)  # fmt: skip
    assert can_be_tuned or output.strip() == f"sb3-chdp optimize: {algo} has no Optuna sampler and cannot be tuned"


@pytest.mark.slow
def test_two_processes_tune_one_study(tmp_path):
    """What several machines do, with the journal on a file system that they share."""
    study = ["--storage", "study.log", "--study-name", "both", "--no-optim-plots", "--n-evaluations", "1"]
    command = ["optimize", "--algo", "hppo", "--env", ENV_ID, "-n", "60", "--n-trials", "2", "--eval-episodes", "1", *study]
    processes = [start(main, *command, "-f", f"tuned{i}", "--seed", str(i), cwd=tmp_path) for i in range(2)]
    for process in processes:
        process.join(timeout=300)
    assert [process.exitcode for process in processes] == [0, 0]
    storage = optuna.storages.JournalStorage(optuna.storages.journal.JournalFileBackend(str(tmp_path / "study.log")))
    trials = optuna.load_study(study_name="both", storage=storage).trials
    assert [trial.number for trial in trials] == [0, 1, 2, 3]
    assert all(trial.state.is_finished() for trial in trials)


def test_users_own_hyperparameters_win(trained):
    (trained / "own.yml").write_text("default:\n  n_timesteps: 40\n  policy: MlpPolicy\n  latent_dim: 5\n")
    output = run("train", "--env", ENV_ID, "-conf", "own.yml", "--eval-freq", "-1", "-f", "own", cwd=trained)
    assert "latent_dim" in output


def test_stock_algorithm_with_a_wrapper_of_the_users(trained):
    """FlattenHybridAction comes on top, once."""
    wrappers = "[gymnasium.wrappers.NormalizeReward, sb3_chdp.wrappers.FlattenHybridAction]"
    (trained / "sac.yml").write_text(f"default: {{n_timesteps: 120, policy: MlpPolicy, env_wrapper: {wrappers}}}\n")
    run("train", "--algo", "sb3:sac", "--env", ENV_ID, "-conf", "sac.yml", "--eval-freq", "-1", "-f", "stock", cwd=trained)


def main_without_display(*arguments):
    for name in DISPLAYS:
        os.environ.pop(name, None)
    main(*arguments)


def test_help_and_unknown_command(tmp_path):
    assert "sb3-chdp train" in run("--help", cwd=tmp_path)
    assert "--no-render" in run("enjoy", "--help", cwd=tmp_path, main=main_without_display)
    message = run("trian", cwd=tmp_path, code=1)
    assert "unknown command 'trian', did you mean train?" in message and all(script in message for script in SCRIPTS)


def test_without_the_zoo_extra(tmp_path):
    """One line says what to install."""
    code = (
        "import sys, importlib.util as u; find = u.find_spec;"
        "u.find_spec = lambda name, *a: None if name == 'rl_zoo3' else find(name, *a);"
        "sys.argv = ['sb3-chdp', 'train']; from sb3_chdp.cli import main; main()"
    )
    result = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == 1
    assert result.stderr.strip() == "sb3-chdp train needs rl_zoo3: pip install '.[zoo]' in a clone of this package"


@pytest.mark.parametrize("algorithm", ALGORITHMS.values(), ids=lambda algorithm: algorithm.name)
def test_yaml_files_are_complete(algorithm):
    settings = yaml.safe_load(algorithm.hyperparams.read_text())
    assert "default" in settings
    own = [env_id for env_id in ENV_IDS if env_id in settings]
    assert all(settings[env_id] == settings[f"sb3_chdp/{env_id}"] for env_id in own)
    for env_settings in settings.values():
        assert {"n_timesteps", "policy"} <= set(env_settings)
