"""Scores, tables and figures of any grid of algorithms and environments, and the published ones."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml

pytest.importorskip("rliable")
pytest.importorskip("rl_zoo3")

from sb3_chdp import ALGORITHMS
from sb3_chdp.benchmark import figures, paper, tables
from sb3_chdp.benchmark.results import FIELDS, ResultsError, differences, read_results
from sb3_chdp.benchmark.runs import display_name, file_name
from sb3_chdp.benchmark.statistics import iqm, matrix_of, probability_of_improvement, scores_of

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

import protocol

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"
RESULTS = BENCHMARKS / "results"


def make_results(success):
    """
    Evaluations of every (row, env), three seeds each, whose success at evaluation t is ``success[row, env] + t + seed``.
    """
    lines = []
    for (row, env), level in success.items():
        for seed in range(3):
            for t in range(1, 9):
                values = dict(zip(FIELDS, (10 * t, 5 * t, level + t + seed, -level, 7.0, 60.0 * t), strict=True))
                lines.append({**values, "row": row, "env": env, "seed": seed})
    return pd.DataFrame(lines)


GRID = {(f"algo{i}", f"Env{j}-v0"): 10.0 * i for i in range(7) for j in range(9)}


def test_score_is_the_mean_over_the_last_five_evaluations():
    scores = scores_of(make_results({("a", "E"): 10.0}))
    assert scores["score"].tolist() == [16.0, 17.0, 18.0] and set(scores["metric"]) == {"success, %"}
    assert scores["seconds"].tolist() == [480.0] * 3


@pytest.mark.parametrize("success", [np.nan, 0.0], ids=["not reported", "nobody succeeds"])
def test_without_success_the_return_counts(success):
    results = make_results({("a", "E"): 10.0, ("b", "E"): 20.0})
    results["success"] = success
    scores = scores_of(results)
    assert set(scores["metric"]) == {"return"} and scores["score"].tolist() == [-10.0] * 3 + [-20.0] * 3


def test_one_algorithm_without_success_is_compared_by_return():
    results = make_results({("a", "E"): 10.0, ("b", "E"): 20.0})
    results.loc[results["row"] == "a", "success"] = np.nan
    assert set(scores_of(results)["metric"]) == {"return"}


def test_intervals_are_reproducible_and_hold_the_point():
    scores = np.random.default_rng(0).normal(90, 5, 20)
    np.random.seed(1)
    state = np.random.get_state(legacy=False)
    middle, low, high = iqm(scores)
    assert low < middle < high
    np.testing.assert_equal(np.random.get_state(legacy=False), state, "the caller's random numbers are left alone")
    assert iqm(scores + 0.0) == (middle, low, high)


def test_runs_without_a_gradient_step_are_named():
    results = make_results({("hppo", "E"): 10.0, ("chdp", "E"): 20.0})
    results.loc[results["row"] == "hppo", "gradient_steps"] = 0
    text = tables.report(scores_of(results), ["chdp", "hppo"], ["E"])
    assert text.endswith("**Not trained**: HPPO on E. Too few environment steps for a single gradient step.")


def test_probability_of_improvement():
    assert probability_of_improvement([3.0, 4.0], [1.0, 2.0])[0] == 1
    assert probability_of_improvement([1.0, 2.0], [1.0, 2.0])[0] == 0.5
    assert probability_of_improvement([1.0, 2.0], [3.0, 4.0])[0] == 0


@pytest.mark.slow
def test_seven_algorithms_and_nine_environments(tmp_path):
    results = make_results(GRID)
    scores = scores_of(results)
    rows, envs = tables.order(scores["row"], ["algo3"]), tables.order(scores["env"], [])
    assert rows[0] == "algo3" and len(rows) == 7 and len(envs) == 9
    assert tables.score_table(scores, rows, envs).count("\n") == 1 + 63
    assert tables.aggregate_table(scores, rows).count("\n") == 1 + 7
    assert "1.00 [1.00, 1.00]" in tables.improvement_table(scores, ["algo6", "algo0"], envs[:1])
    for x in ("timesteps", "minutes"):
        figures.plot_curves(results, scores, rows, envs, x, tmp_path / f"{x}.png")
    figures.plot_scores(scores, rows, envs, tmp_path / "scores.png", lambda row, env: 50.0)
    assert all(path.stat().st_size > 10_000 for path in tmp_path.glob("*.png"))
    assert len(list(tmp_path.glob("*.png"))) == 3


def test_a_grid_with_gaps_and_one_seed(tmp_path):
    results = make_results({("a", "E"): 10.0, ("b", "F"): 20.0})
    results = results[(results["row"] == "a") | (results["seed"] == 0)]
    scores = scores_of(results)
    report = tables.report(scores, ["a", "b"], ["E", "F"])
    assert report.count("\n") == 3, "one table: nothing to aggregate, nothing to compare"
    assert matrix_of(scores, "a") is None
    figures.plot_curves(results, scores, ["a", "b"], ["E", "F"], "minutes", tmp_path / "curves.png")
    figures.plot_scores(scores, ["a", "b"], ["E", "F"], tmp_path / "scores.png")


def test_one_seed_has_no_interval():
    results = make_results({("a", "E"): 10.0, ("a", "F"): 20.0})
    scores = scores_of(results[results["seed"] == 0])
    assert matrix_of(scores_of(results), "a") is not None and matrix_of(scores, "a") is None


def test_curves_end_where_the_shortest_seed_does():
    results = make_results({("a", "E"): 10.0})
    shorter = results[(results["seed"] < 2) | (results["timesteps"] < 50)]
    assert figures.curve_of(shorter, "timesteps", "success")["x"].tolist() == [10, 20, 30, 40]
    curve = figures.curve_of(results.assign(minutes=results["seconds"] / 60), "minutes", "success")
    assert curve["x"].tolist() == list(range(1, 9)) and curve["mean"].iloc[0] == 12


def test_no_results(tmp_path):
    with pytest.raises(ResultsError, match="no finished run"):
        read_results(tmp_path)


def test_differences_of_settings():
    ours = {"gamma": 0.9, "n_timesteps": "45000.0", "policy": "MlpPolicy"}
    assert differences(ours, {"gamma": "0.9", "n_timesteps": 45000, "policy": "MlpPolicy"}) == []
    assert differences(ours, {"gamma": 0.8, "n_timesteps": 45000, "tau": 1}) == ["gamma", "policy", "tau"]


def test_names_of_rows():
    assert [display_name(name) for name in ("chdp", "sb3:sac", "without_codebook")] == [
        "CHDP", "SAC, flattened", "without codebook",
    ]  # fmt: skip


def test_the_papers_figures_belong_to_what_there_is():
    for env, figures_of_env in yaml.safe_load(paper.PAPER.read_text()).items():
        assert paper.paper_figure("chdp", env) is not None
        assert set(figures_of_env) - {"note"} <= set(ALGORITHMS)
    assert paper.paper_figure("chdp", "MyEnv-v0") is None and paper.paper_column("chdp", "MyEnv-v0") == ""


def test_protocol_tells_what_was_run():
    """Every published file is named, with its seed, steps and commit, and settings that are not today's are marked."""
    pytest.importorskip("rl_zoo3")
    named = paper.load_protocol()
    assert named == protocol.describe_cells(RESULTS, "main"), "python benchmarks/publish.py writes it anew"
    runs = {(cell["algorithm"], file_name(cell["environment"]), seed) for cell in named for seed in cell["seeds"]}
    files = {(path.parts[-3], path.parts[-2], int(path.stem[5:])) for path in (RESULTS / "main").glob("*/*/*.csv")}
    assert runs == files


def test_documents_show_what_was_measured():
    """Means and single scores in both README files are those of the published runs."""
    scores = scores_of(read_results(RESULTS / "main"))
    measured, overview = (
        path.read_text().splitlines() for path in (BENCHMARKS / "README.md", BENCHMARKS.parent / "README.md")
    )
    for (env, row), cell in scores.groupby(["env", "row"]):
        values = cell["score"].to_numpy()
        own = f"| {env} | {display_name(row)} | success, % | {tables.mean_and_std(values)} | "
        assert any(line.startswith(own + ", ".join(tables.numbers(values))) for line in measured), own
        if row == "chdp":
            assert any(re.match(rf"\| {env} \| [\d.]+ \| \d \| {values.mean():.1f} \|", line) for line in overview)


def test_deviations_are_found_and_marked():
    path = next((RESULTS / "main" / "hppo" / "Goal-v0").glob("*.json"))
    meta = json.loads(path.read_text())
    assert protocol.deviations_of(meta, "main") == []
    meta["settings"]["gamma"] = "0.5"
    assert protocol.deviations_of(meta, "main") == ["gamma"]
    cells = [{"environment": "Goal-v0", "algorithm": "hppo", "deviations": ["gamma"]}]
    assert protocol.deviation_column(cells)("hppo", "Goal-v0") == "others"


def test_paper_command_trains_every_published_run():
    pytest.importorskip("submitit")
    from sb3_chdp.benchmark.cli import make_runs, parse

    runs = make_runs(parse(["paper"])[0])
    published = {(cell["algorithm"], cell["environment"], seed) for cell in paper.load_protocol() for seed in cell["seeds"]}
    assert {(run.algo, run.env_id, run.seed) for run in runs} == published and len(runs) == len(published)
    assert {run.eval_episodes for run in runs} == {100}
    (one,) = make_runs(parse(["paper", "--algos", "hppo", "--envs", "Goal-v0", "--seeds", "10", "--steps", "50"])[0])
    assert one.overrides == {"n_timesteps": 50} and one.eval_freq is None
