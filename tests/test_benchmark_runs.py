"""Runs of the benchmark: what is measured, and that nothing is lost when processes are killed."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rl_zoo3")
pytest.importorskip("submitit")

from submitit.core.utils import FailedJobError, UncompletedJobError

from sb3_chdp.benchmark import jobs
from sb3_chdp.benchmark.manager import RunManager, settings_of
from sb3_chdp.benchmark.results import FIELDS, ResultsError, append_row, read_results, read_rows, write_rows
from sb3_chdp.benchmark.runs import Run
from sb3_chdp.benchmark.training import forget, train
from tests.commands import start

ENV_ID = "HardMove4-v0"
ROOT = Path(__file__).parent.parent
OFF_POLICY = dict(n_envs=4, learning_starts=40, buffer_size=400, gradient_steps=1)
TINY: dict[str, dict[str, Any]] = {
    "chdp": dict(OFF_POLICY, n_diffusion_steps=2, n_action_candidates=2, policy_kwargs="dict(net_arch=[32, 32])"),
    "hppo": dict(n_envs=4, n_steps=10, batch_size=20, n_epochs=2),
    "pdqn_td3": OFF_POLICY,
    "sb3:sac": dict(OFF_POLICY, normalize=True),
}


def make_run(folder, algo="hppo", n_timesteps=240, **kwargs):
    settings = dict(eval_episodes=2, checkpoint_interval=0.3, overrides={"n_timesteps": n_timesteps, **TINY[algo]})
    return Run(algo, algo, ENV_ID, 3, str(folder), **{**settings, **kwargs})


def started(run):
    """A process that trains a run; it is left to the caller to end it."""
    return start(train, run, cwd=ROOT)


def wait_for(condition, seconds=600):
    for _ in range(int(seconds * 20)):
        if condition():
            return
        time.sleep(0.05)
    raise TimeoutError


def without_seconds(rows):
    # As text: nan is not equal to itself
    return [str({key: value for key, value in row.items() if key != "seconds"}) for row in rows]


@pytest.mark.parametrize("algo", [algo if algo == "hppo" else pytest.param(algo, marks=pytest.mark.slow) for algo in TINY])
def test_a_killed_run_goes_on_to_the_last_bit(algo, tmp_path):
    # Long enough to be killed halfway
    n_timesteps = 2400 if algo == "hppo" else 960
    run = make_run(tmp_path / "killed", algo, n_timesteps)
    process = started(run)
    try:
        wait_for(lambda: list(run.checkpoints.glob("0*_steps")) and len(run.rows()) > 3)
        with pytest.raises(ResultsError, match=f"being trained by process {process.pid}"):
            train(run)
    finally:
        process.kill()
        process.join()
    before = run.rows()
    train(run)
    rows = run.rows()
    assert [row["timesteps"] for row in rows] == [n_timesteps // 30 * i for i in range(1, 31)]
    assert rows[-1]["gradient_steps"] > 0 and rows[-1]["seconds"] > rows[0]["seconds"] >= 0
    # Rows behind the checkpoint were evaluated again, and came out the same
    assert without_seconds(rows[: len(before)]) == without_seconds(before)
    assert 0 < json.loads(run.json.read_text())["resumed_at"] < n_timesteps
    at_once = make_run(tmp_path / "at_once", algo, n_timesteps, checkpoint_interval=1000)
    train(at_once)
    assert without_seconds(at_once.rows()) == without_seconds(rows)
    # Nothing is left of the checkpoints, and a finished run is not trained again
    assert not run.checkpoints.exists()
    assert "complete already" in train(run)


def test_arguments_of_the_environment_count_in_evaluations_too(tmp_path):
    run = make_run(tmp_path)
    manager: Any = RunManager(replace(run, overrides={**run.overrides, "env_kwargs": {"noise": False}}))
    model = manager.setup_experiment()[0]
    assert model.env.get_attr("noise") == [False] * 4
    assert manager.create_envs(1, eval_env=True).get_attr("noise") == [False]


def test_damaged_checkpoints_of_a_run(tmp_path):
    run = make_run(tmp_path, n_timesteps=20_000)
    process = started(run)
    try:
        wait_for(lambda: len(list(run.checkpoints.glob("0*_steps"))) == 2)
    finally:
        process.kill()
        process.join()
    for generation in run.checkpoints.glob("0*_steps"):
        (generation / "state.json").write_text("{}")
    with (
        pytest.warns(UserWarning, match="is not used"),
        pytest.raises(ResultsError, match=r"All checkpoints in .*checkpoints are damaged.*Delete .*trained anew"),
    ):
        train(run)


def test_checkpoints_without_settings_are_not_used(tmp_path):
    """Who deletes a damaged ``started.json``, as its message says, trains anew."""
    run = make_run(tmp_path, n_timesteps=20_000)
    process = started(run)
    try:
        wait_for(lambda: list(run.checkpoints.glob("0*_steps")))
    finally:
        process.kill()
        process.join()
    run.started.write_text("{")
    changed = replace(run, overrides={**run.overrides, "gamma": 0.5, "n_timesteps": 240})
    with pytest.raises(ResultsError, match=r"started\.json is damaged .*: delete it, and the run is trained anew"):
        train(changed)
    run.started.unlink()
    train(changed)
    meta = json.loads(run.json.read_text())
    assert meta["resumed_at"] == 0 and meta["settings"]["gamma"] == "0.5"


def test_gradient_steps_of_on_policy_algorithms(tmp_path):
    run = make_run(tmp_path)
    train(run)
    # 240 steps are six rollouts of 40, of which five are learnt from before the last evaluation: 2 epochs of 2 minibatches
    assert run.rows()[-1]["gradient_steps"] == 5 * 2 * 2


def test_other_settings_are_refused(tmp_path):
    run = make_run(tmp_path)
    train(run)
    changed = replace(run, overrides={**run.overrides, "gamma": 0.5})
    with pytest.raises(ResultsError, match=r"other settings \(gamma\).*--restart"):
        train(changed)
    with pytest.raises(ResultsError, match="eval_episodes"):
        train(replace(run, eval_episodes=3))
    forget(run)
    train(changed)
    assert json.loads(run.json.read_text())["settings"]["gamma"] == "0.5"


def test_settings_are_those_of_the_yaml_files(tmp_path):
    assert settings_of(make_run(tmp_path, "hppo"))["gamma"] == "0.95"
    (tmp_path / "hppo.yml").write_text("default:\n  n_timesteps: 10\n  policy: MlpPolicy\n  gamma: 0.7\n")
    assert settings_of(make_run(tmp_path, "hppo", conf_folder=str(tmp_path)))["gamma"] == "0.7"


def test_stock_algorithms_are_wrapped_once(tmp_path):
    assert settings_of(make_run(tmp_path, "sb3:sac"))["env_wrapper"] == "['sb3_chdp.wrappers.FlattenHybridAction']"
    own = dict(TINY["sb3:sac"], env_wrapper="sb3_chdp.wrappers.FlattenHybridAction", n_timesteps=10)
    assert settings_of(make_run(tmp_path, "sb3:sac", overrides=own))["env_wrapper"] == own["env_wrapper"]


def test_evaluations_are_normalised_as_in_training(tmp_path):
    run = make_run(tmp_path, "sb3:sac")
    train(run)
    manager = RunManager(run)
    # What sb3-chdp enjoy needs beside the model
    assert (Path(manager.params_path) / "vecnormalize.pkl").is_file()
    # Returns are those of the environment: a step of 30 costs more than 0.5
    assert run.rows()[-1]["return"] < -10


def test_an_environment_without_success(tmp_path, monkeypatch):
    (tmp_path / "plain_env.py").write_text(
        "import gymnasium as gym\nfrom tests.hybrid_envs import make_layout_env\n"
        "class Plain(gym.Wrapper):\n"
        "    def __init__(self):\n        super().__init__(make_layout_env())\n"
        "    def step(self, action):\n        return (*super().step(action)[:4], {})\n"
        "gym.register('own/Plain-v0', entry_point='plain_env:Plain')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    run = replace(make_run(tmp_path / "out"), env_id="own/Plain-v0", gym_packages=("plain_env",))
    train(run)
    assert all(math.isnan(row["success"]) for row in run.rows())
    assert read_results(tmp_path / "out")["return"].notna().all()


@pytest.mark.parametrize(
    "damage",
    [lambda text: "", lambda text: text[:-8], lambda text: text + "50,1,0.0,1.0,1.0,1.0\n", lambda text: text + "nonsense\n"],
    ids=["emptied", "half a row", "two runs in one file", "nonsense"],
)
def test_damaged_results_name_the_file_and_the_remedy(damage, tmp_path):
    path = tmp_path / "seed_0.csv"
    row = dict.fromkeys(FIELDS, 1.0)
    write_rows(path, [{**row, "timesteps": 50}])
    append_row(path, {**row, "timesteps": 100, "success": math.nan})
    assert [row["timesteps"] for row in read_rows(path)] == [50, 100]
    path.write_text(damage(path.read_text()))
    with pytest.raises(ResultsError, match=r"seed_0\.csv.* delete it and seed_0\.json"):
        read_rows(path)


def benchmark(folder, *options):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [
        sys.executable,
        "-m",
        "sb3_chdp",
        "benchmark",
        "--envs",
        ENV_ID,
        "--out",
        "out",
        "--eval-episodes",
        "2",
        *options,
    ]
    return subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def holder(run):
    """:return: id of the process that trains a run"""
    path = run.folder / "holder.txt"
    wait_for(lambda: path.exists() and path.read_text().split()[1:2])
    return int(path.read_text().split()[1])


@pytest.mark.slow
def test_a_killed_worker_is_reported_and_the_others_go_on(tmp_path):
    options = ["--algos", "hppo", "--seeds", "0", "1", "--jobs", "2", "--steps", "4000", "-params", "n_envs:4", "n_steps:10"]
    process = benchmark(tmp_path, *options)
    runs = [Run("hppo", "hppo", ENV_ID, seed, str(tmp_path / "out")) for seed in (0, 1)]
    os.kill(holder(runs[0]), signal.SIGKILL)
    output, _ = process.communicate(timeout=900)
    assert process.returncode == 1, output
    assert "seed_0: its process was killed" in output
    assert [run.is_complete for run in runs] == [False, True]


@pytest.mark.slow
def test_workers_end_with_their_parent(tmp_path):
    options = ["--algos", "hppo", "--seeds", "0", "--steps", "100000", "-params", "n_envs:4", "n_steps:10"]
    process = benchmark(tmp_path, *options)
    worker = holder(Run("hppo", "hppo", ENV_ID, 0, str(tmp_path / "out")))
    process.kill()
    # Not communicate(), which waits for the worker to close the same output first
    process.wait()
    process.stdout.close()

    def is_gone():
        try:
            return Path(f"/proc/{worker}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
        except FileNotFoundError:
            return True

    wait_for(is_gone, seconds=20)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--algos", "chdpp"], "unknown algorithm 'chdpp', did you mean chdp?"),
        (["--algos", "sb3:sax"], "did you mean sb3:sac?"),
        (["--algos", "chdp", "--envs", "Nowhere-v0"], "unknown environment 'Nowhere-v0'.*--gym-packages"),
        (["--algos", "chdp", "--slurm-partition", "main"], "needs --cluster slurm"),
        (["--algos", "chdp", "--jobs", "-1"], "must be at least 1"),
        (["--algos", "chdp", "--conf-folder", "nowhere"], "there is no YAML file in nowhere"),
        ([], "--envs and --algos"),
    ],
    ids=str,
)
def test_bad_arguments(options, message, capsys):
    from sb3_chdp.benchmark.cli import parse

    with pytest.raises(SystemExit):
        parse(["--envs", ENV_ID, *options])
    assert __import__("re").search(message, capsys.readouterr().err)


def test_reason_of_a_failure():
    assert "killed" in jobs.reason(UncompletedJobError("no output"))
    ruler = "----------------------"
    trace = f"Job failed with trace:\n{ruler}\nTraceback\n  File\nValueError: too big\n\n{ruler}\nlogs"
    assert jobs.reason(FailedJobError(trace)) == "ValueError: too big"
