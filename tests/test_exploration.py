"""Exploration of the parts of a hybrid action (CHDP's ``explore_parts``)."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_chdp import CHDP
from sb3_chdp.chdp.exploration import random_parameters, reflect, vary_parts
from tests.algorithms import FAST_CHDP, filled_model
from tests.hybrid_envs import box, make_layout_env


def test_reflect():
    x = np.array([-5.0, -1.25, -1.0, 0.5, 1.5, 4.0])
    np.testing.assert_allclose(reflect(x), [1.0, -0.75, -1.0, 0.5, 0.5, -1.0])


def test_half_of_the_random_parameters_are_bounds():
    mask = np.ones((20_000, 2))
    mask[:, 1] = 0
    first, padding = random_parameters(np.random.default_rng(0), mask).T
    assert not padding.any()
    assert (first == -1).mean() == pytest.approx(0.25, abs=0.02)
    assert (first == 1).mean() == pytest.approx(0.25, abs=0.02)
    assert (np.abs(first) < 0.5).mean() == pytest.approx(0.25, abs=0.02)


def test_each_part_is_varied():
    """Of four kinds of exploratory actions, two keep the discrete action, and one of these stays near its parameters."""
    model = filled_model(make_layout_env("nested"))
    spec = model.hybrid_space.spec
    n, columns = 4000, model.hybrid_space.columns
    obs = np.random.default_rng(0).uniform(-1, 1, (n, 2)).astype(np.float32)
    rows = model.policy.predict_rows(obs)
    varied = vary_parts(model.policy, obs, rows, np.random.default_rng(0))

    assert set(varied[:, 0]) == {0, 1, 2}
    assert np.abs(varied[:, 1:]).max() <= 1
    assert not columns.view(varied, "parameters")[~spec.mask[varied[:, 0].astype(int)].astype(bool)].any()
    decoded = model.actor.codebook.quantize(th.as_tensor(columns.view(varied, "latents")))
    assert (decoded.numpy() == varied[:, 0]).mean() > 0.97

    kept = (columns.view(varied, "latents") == columns.view(rows, "latents")).all(axis=1)
    assert kept.mean() == pytest.approx(0.5, abs=0.05)
    assert (varied[kept, 0] == rows[kept, 0]).all()
    two_parameters = kept & (rows[:, 0] == 0)
    near = np.abs(columns.view(varied - rows, "parameters"))[two_parameters].max(axis=1) < 0.1
    assert 0.1 < near.mean() < 0.4


@pytest.mark.parametrize("policy", ["MlpPolicy", "MultiInputPolicy"])
def test_explore_parts_learns_and_saves(policy, tmp_path):
    observation_space = spaces.Dict({"vector": box(-1, 1, 2)}) if policy == "MultiInputPolicy" else None
    env = DummyVecEnv([lambda: make_layout_env(observation_space=observation_space)] * 3)
    model = CHDP(policy, env, explore_parts=True, **FAST_CHDP).learn(60)
    assert model._n_updates > 0
    model.save(tmp_path / "model")
    assert CHDP.load(tmp_path / "model").explore_parts
