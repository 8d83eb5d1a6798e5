"""The ablations of CHDP and of the published algorithm: they run, and lack what they say, and that alone."""

import inspect
import sys
from pathlib import Path

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_chdp import ALGORITHMS, CHDP
from sb3_chdp.chdp import PaperCHDP
from sb3_chdp.chdp.candidates import Selection
from sb3_chdp.common.watkins_buffer import WatkinsReplayBuffer
from tests.algorithms import calls_of, filled_model, has_learnt, sample, snapshot
from tests.hybrid_envs import HybridIdentityEnv, LayoutEnv, box, make_layout_env

sys.path.insert(0, str(Path(__file__).parent.parent / "benchmarks"))

import ablations
import leave_one_out

VARIANTS = {**ablations.ABLATIONS, **leave_one_out.LEFT_OUT}
# Importing them puts them into the registry, which other tests read
for name in VARIANTS:
    ALGORITHMS.pop(name, None)

PREFIXES = {"chdp_": CHDP, "chdp_paper_": PaperCHDP}
NAMES = ("full", "without_diffusion", "without_codebook", "without_sequential_update", "without_both")
TABLES = list(PREFIXES)
CASES = [(table, name) for table in TABLES for name in NAMES]


def make(table, name, env=None, **kwargs):
    algorithm = PREFIXES[table] if name == "full" else VARIANTS[table + name]
    return filled_model(env, algorithm_class=algorithm, **kwargs)


OBS = th.rand(9, 2)
LACKS = {
    "without_normalization": lambda model: isinstance(model.critic.features_extractor, FlattenExtractor),
    "without_value_scale": lambda model: not model.policy.value_scale.adapts,
    "without_positions": lambda model: model.critic.ranges.update(OBS) is None and not model.critic.ranges(OBS).any(),
    "without_reads": lambda model: model.actor.reads is None,
    "without_latent_scale": lambda model: (model.critic.q_networks[0].latent_scale == 1).all(),
    "without_random_share": lambda model: model.policy.random_share == 0,
    "without_candidates": lambda model: model.policy.select == model.policy.select_target == Selection(1),
    "without_foresight": lambda model: model.policy.set_foresight(0.5) is None and model.critic.foresight == 1,
    "without_returns": lambda model: model.critic.return_network is None,
    "without_long_returns": lambda model: not isinstance(model.replay_buffer, WatkinsReplayBuffer),
    "without_uniform": lambda model: model.uniform_fraction == 0,
    "without_learnt_codewords": lambda model: not model.critics_train_codebook,
    "without_comparison": lambda model: type(model)._discrete_policy_loss is not CHDP._discrete_policy_loss,
    "without_parts": lambda model: type(model)._exploratory_rows is not CHDP._exploratory_rows,
}


@pytest.mark.parametrize("table, name", [*CASES, *(("chdp_", name[5:]) for name in leave_one_out.LEFT_OUT)])
def test_they_run(table, name, tmp_path):
    model = make(table, name, make_layout_env("nested"))
    assert isinstance(model, PaperCHDP) == (table == "chdp_paper_")
    assert name in NAMES or LACKS[name](model)
    before = snapshot(model)
    model.learning_starts = 60
    model.learn(20, reset_num_timesteps=False)
    assert has_learnt(model, before)
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model", env=make_layout_env("nested"), trusted=True)
    obs = np.random.uniform(-1, 1, (5, 2)).astype(np.float32)
    rows = model.policy.predict_rows(obs, deterministic=True)
    np.testing.assert_array_equal(rows, loaded.policy.predict_rows(obs, deterministic=True))
    np.testing.assert_array_equal(rows, model.policy.predict_rows(obs, deterministic=True))
    spec, columns = model.hybrid_space.spec, model.hybrid_space.columns
    assert not columns.view(rows, "parameters")[~spec.parameter_mask[columns.discrete_actions(rows)].astype(bool)].any()
    loaded.learn(10)


@pytest.mark.parametrize("table", TABLES)
def test_without_diffusion(table):
    """One draw is as good as another but for Gaussian noise of 0.1, and there is nothing to denoise."""
    model = make(table, "without_diffusion")
    features = model.critic.features(th.rand(1, 4)).detach().expand(4000, -1)
    with th.no_grad():
        latents, _ = model.actor.draw_latents(features)
        parameters = model.actor.sample_parameters(features, th.zeros(4000, dtype=th.long))
    for draws in (latents, parameters):
        assert draws.std(dim=0).numpy() == pytest.approx(0.1, rel=0.1)
    model.train(model.policy_delay, 32)
    assert model.logger.name_to_value["train/diffusion_loss_discrete"] == 0
    assert model.logger.name_to_value["train/diffusion_loss_continuous"] == 0
    full = make(table, "full")
    features = full.critic.features(th.rand(1, 4)).detach().expand(4000, -1)
    with th.no_grad():
        assert full.actor.draw_latents(features)[0].std(dim=0).min() > 0.2


@pytest.mark.parametrize("table", TABLES)
@pytest.mark.parametrize("name", ["without_codebook", "without_both"])
def test_without_codebook(table, name):
    """Latents are as wide as there are actions, the largest entry decides, and training changes nothing of that."""
    env = LayoutEnv(spaces.Tuple((spaces.Discrete(7), box(-1, 1, 2))))
    model = make(table, name, env)
    model.train(3, 32)
    codebook = model.actor.codebook
    assert (codebook(th.arange(7)) == th.eye(7)).all()
    latents = 2 * th.rand(50, 7) - 1
    assert (codebook.quantize(latents) == latents.argmax(dim=1)).all()
    data = sample(model)
    assert data.latents.shape[1] == 7 and (data.latents.argmax(dim=1) == data.discrete_actions).all()


@pytest.mark.parametrize("table, name", CASES)
def test_sequential_update(table, name):
    """Which actions the continuous policy is improved for: those of the updated discrete policy, or the stored ones."""
    # The codebook stays as it is, so that stored actions can be told
    model = make(table, name, learning_rate=0.0, **({} if table == "chdp_paper_" else {"policy_delay": 1}))
    calls = calls_of(model.critic.q_networks[0])
    model.train(1, 400)
    *_, (_, stored, _), _, (_, improved, _) = calls
    n_uniform = round(400 * model.uniform_fraction)
    is_stored = (improved[n_uniform:] == stored[n_uniform:]).all(dim=1)
    is_sequential = name not in ("without_sequential_update", "without_both")
    # CHDP's latents of one action are the same, so that drawn and stored ones are equal now and then
    most = 0.1 if table == "chdp_paper_" else 0.8
    assert is_stored.float().mean() < most if is_sequential else is_stored.all()


@pytest.mark.parametrize("table", TABLES)
def test_what_is_left_is_the_full_algorithm(table):
    """Arguments, training and critics are those of the algorithm."""
    models = {name: make(table, name, HybridIdentityEnv()) for name in NAMES}
    full = models["full"]
    for model in models.values():
        assert type(model).train is CHDP.train
        assert inspect.signature(type(model)) == inspect.signature(type(full))
        for attribute in ("uniform_fraction", "critics_train_codebook", "max_grad_norm"):
            assert getattr(model, attribute) == getattr(full, attribute)
        assert [type(q_net) for q_net in model.critic.q_networks] == [type(q_net) for q_net in full.critic.q_networks]
        assert model.policy.select_target == full.policy.select_target and model.policy.select == full.policy.select
