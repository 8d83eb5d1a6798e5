"""The ablations of CHDP and of the published algorithm: they run, and lack what they say, and that alone."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_chdp import ALGORITHMS, CHDP
from sb3_chdp.chdp import PaperCHDP
from tests.algorithms import filled_model
from tests.hybrid_envs import HybridIdentityEnv, LayoutEnv, box, make_layout_env

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

import ablations

# Importing it puts them into the registry, which other tests read
for name in ablations.ABLATIONS:
    ALGORITHMS.pop(name, None)

PREFIXES = {"chdp_": CHDP, "chdp_paper_": PaperCHDP}
NAMES = ("full", "without_diffusion", "without_codebook", "without_sequential_update", "without_both")
TABLES = list(PREFIXES)
CASES = [(table, name) for table in TABLES for name in NAMES]


def make(table, name, env=None, **kwargs):
    algorithm = PREFIXES[table] if name == "full" else ablations.ABLATIONS[table + name]
    return filled_model(env, algorithm_class=algorithm, **kwargs)


@pytest.mark.parametrize("table, name", CASES)
def test_they_run(table, name, tmp_path):
    model = make(table, name, make_layout_env("nested"))
    assert isinstance(model, PaperCHDP) == (table == "chdp_paper_")
    model.learning_starts = 60
    model.learn(20, reset_num_timesteps=False)
    assert model._n_updates == 20
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=make_layout_env("nested"), trusted=True)
    obs = np.random.uniform(-1, 1, (5, 2)).astype(np.float32)
    rows = model.policy.predict_rows(obs, deterministic=True)
    np.testing.assert_array_equal(rows, loaded.policy.predict_rows(obs, deterministic=True))
    np.testing.assert_array_equal(rows, model.policy.predict_rows(obs, deterministic=True))
    spec, columns = model.hybrid_space.spec, model.hybrid_space.columns
    assert not columns.view(rows, "parameters")[~spec.mask[columns.discrete_actions(rows)].astype(bool)].any()
    loaded.learn(10)


@pytest.mark.parametrize("table", TABLES)
def test_without_diffusion(table):
    """One draw is as good as another but for Gaussian noise of 0.1, and there is nothing to denoise."""
    model = make(table, "without_diffusion")
    features = th.rand(1, 4).expand(4000, 4)
    with th.no_grad():
        latents, _ = model.actor.sample_latents(features)
        parameters = model.actor.sample_parameters(features, th.zeros(4000, dtype=th.long))
    for draws in (latents, parameters):
        assert draws.std(dim=0).numpy() == pytest.approx(0.1, rel=0.1)
    model.train(1, 32)
    assert model.logger.name_to_value["train/diffusion_loss_discrete"] == 0
    assert model.logger.name_to_value["train/diffusion_loss_continuous"] == 0
    full = make(table, "full")
    with th.no_grad():
        assert full.actor.sample_latents(features)[0].std(dim=0).min() > 0.2


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("name", ["without_codebook", "without_both"])
def test_without_codebook(table, name):
    """Latents are as wide as there are actions, the largest entry decides, and training changes nothing of that."""
    env = LayoutEnv(spaces.Tuple((spaces.Discrete(7), box(-1, 1, 2))))
    kwargs = {} if table == "chdp_paper_" else {"critics_train_codebook": True}
    model = make(table, name, env, **kwargs)
    model.train(3, 32)
    codebook = model.actor.codebook
    assert (codebook(th.arange(7)) == th.eye(7)).all()
    latents = 2 * th.rand(50, 7) - 1
    assert (codebook.quantize(latents) == latents.argmax(dim=1)).all()
    rows, columns = model.replay_buffer.actions[:60, 0], model.hybrid_space.columns
    stored = columns.view(rows, "latents")
    assert stored.shape == (60, 7) and (stored.argmax(axis=1) == rows[:, 0]).all()
    assert model.logger.name_to_value["train/latent_drift"] == 0


@pytest.mark.parametrize("table, name", CASES)
def test_sequential_update(table, name, monkeypatch):
    """Which actions the continuous policy is improved for: those of the updated discrete policy, or the stored ones."""
    kwargs = {} if table == "chdp_paper_" else {"uniform_fraction": 0.25}
    model = make(table, name, **kwargs)
    codewords = model.actor.codebook.representative_latents(th.arange(3))
    model.actor.discrete_policy.sample = lambda features, mask=None, noise=None: codewords[2].expand(len(features), -1)
    data = model._sample_batch(400)
    latents, k = model._actions_to_improve(data, data.observations)
    n_uniform = 0 if table == "chdp_paper_" else 100
    is_sequential = name not in ("without_sequential_update", "without_both")
    assert len(latents) == len(k) == 400
    assert (k[n_uniform:] == (2 if is_sequential else data.discrete_actions[n_uniform:])).all()
    assert n_uniform == 0 or th.bincount(k[:100], minlength=3).min() > 15


@pytest.mark.parametrize("table", TABLES)
def test_what_is_left_is_the_full_algorithm(table):
    """Arguments that the algorithm has, its ablations have with the same values."""
    models = {name: make(table, name, HybridIdentityEnv()) for name in NAMES}
    settings = {name: model._network_kwargs() for name, model in models.items()}
    assert all(settings[name] == settings["full"] for name in models)
    for model in models.values():
        assert type(model).train is CHDP.train and model.critic.q_networks[0][-1].out_features == 1
