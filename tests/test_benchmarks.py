"""The runs behind the published tables: resumable, and counted correctly."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from rliable import metrics

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import cells  # noqa: E402
import release  # noqa: E402
import tables  # noqa: E402
import trials  # noqa: E402

TINY = {
    "chdp": dict(n_diffusion_steps=2, learning_starts=40, n_envs=4, buffer_size=300, gradient_steps=1),
    "hyar_td3": dict(learning_starts=40, n_envs=4, buffer_size=300, gradient_steps=1, representation_warmup_steps=3),
    "hppo": dict(n_steps=10, n_envs=4, batch_size=20, n_epochs=2),
}


def make_cell(tmp_path, algo, **kwargs):
    overrides = {"n_timesteps": 240, **TINY[algo]}
    return cells.Cell(algo, algo, "HardMove4-v0", 3, str(tmp_path / "main"), overrides, 60, 4, **kwargs)


class KilledError(Exception):
    pass


@pytest.mark.parametrize("algo", TINY)
def test_a_killed_run_goes_on(algo, tmp_path, monkeypatch):
    cell = make_cell(tmp_path, algo)
    monkeypatch.setattr(cells, "CHECKPOINT_INTERVAL", -1.0)
    evaluate, n_evaluations = cells.evaluate, []

    def killed(*args):
        n_evaluations.append(1)
        if len(n_evaluations) == 3:
            raise KilledError
        return evaluate(*args)

    monkeypatch.setattr(cells, "evaluate", killed)
    with pytest.raises(KilledError):
        cells.run_cell(cell)
    assert not cell.is_complete and len(cell.rows()) == 2
    log = trials.read_trials(tmp_path.parent)
    assert log.loc[log["trial"] == tmp_path.name, "stopped"].tolist() == [True]
    before = cell.path(".csv").read_text()
    cells.run_cell(cell)
    assert cell.is_complete and cell.path(".csv").read_text().startswith(before)
    assert [row["timesteps"] for row in cell.rows()] == [60, 120, 180, 240]
    steps = [row["gradient_steps"] for row in cell.rows()]
    assert steps == sorted(steps) and steps[-1] > 0
    assert json.loads(cell.path(".json").read_text())["resumed_at"] == 120
    # Nothing is left of the checkpoint, and a complete cell is not run again
    assert {path.suffix for path in cell.stem.parent.iterdir()} == {".csv", ".json", ".zip"}
    assert "complete already" in cells.run_cell(cell)


def test_gradient_steps_of_hppo(tmp_path):
    cell = make_cell(tmp_path, "hppo")
    cells.run_cell(cell)
    # 240 steps are six rollouts of 40, of which five are learnt from before the last evaluation: 2 epochs of 2 minibatches
    assert cell.rows()[-1]["gradient_steps"] == 5 * 2 * 2


def test_tables(tmp_path):
    for algo in ("hppo", "chdp"):
        cells.run_cell(make_cell(tmp_path, algo))
    unfinished = make_cell(tmp_path, "hyar_td3")
    cells.run_cell(unfinished)
    unfinished.path(".json").unlink()
    runs = tables.read_runs(tmp_path / "main")
    assert set(runs["row"]) == {"hppo", "chdp"}
    scores = tables.scores_of(runs)
    expected = 100 * sum(row["success"] for row in make_cell(tmp_path, "chdp").rows()[-5:]) / 4
    assert scores[scores["row"] == "chdp"]["success"].item() == pytest.approx(expected)
    assert "94.2 ± 1.7" in tables.markdown("main", scores)


def test_intervals_are_reproducible():
    scores = np.random.default_rng(0).normal(90, 5, (20, 1))
    iqm, low, high = tables.interval(scores, metrics.aggregate_iqm)
    assert low < iqm < high
    assert (iqm, low, high) == tables.interval(scores, metrics.aggregate_iqm)


def test_log_of_trials(tmp_path):
    cells.run_cell(make_cell(tmp_path / "smaller", "hppo"))
    log = trials.read_trials(tmp_path)
    assert len(log) == 1 and log.iloc[0]["trial"] == "smaller" and "n_steps=10" in log.iloc[0]["changes"]
    assert log.iloc[0]["timesteps"] == 240 and not log.iloc[0]["stopped"]


@pytest.mark.parametrize("algo", ["chdp", "hyar_td3"])
def test_published_models_act_as_the_trained_ones(algo, tmp_path):
    cell = make_cell(tmp_path, algo)
    cells.run_cell(cell)
    trained, small = (cells.ALGORITHMS[algo].load(cell.path(".zip"), device="cpu") for _ in range(2))
    release.shrink(small)
    release.save_compressed(small, tmp_path / "small.zip")
    assert (tmp_path / "small.zip").stat().st_size < 0.5 * cell.path(".zip").stat().st_size
    published = cells.ALGORITHMS[algo].load(tmp_path / "small.zip", device="cpu")
    obs = np.random.uniform(-1, 1, (20, 4)).astype(np.float32)
    for expected, action in zip(*(model.predict(obs, deterministic=True)[0] for model in (trained, published)), strict=True):
        assert expected[0] == action[0]
        np.testing.assert_array_equal(expected[1][expected[0]], action[1][action[0]])


def test_the_papers_figures_are_complete():
    assert all(len(tables.PAPER[table]) == n for table, n in (("main", 48), ("ablation", 10)))
