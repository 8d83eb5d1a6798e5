"""The baselines that are TD3 on scores and parameters."""

from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import TD3

from sb3_chdp import HHQNTD3, PATD3, PDQNTD3, FlattenHybridAction
from sb3_chdp.common.buffers import PrioritizedReplayBuffer
from sb3_chdp.common.td3 import InvertingGradients
from sb3_chdp.common.watkins_buffer import WatkinsReplayBuffer
from tests.algorithms import make_model
from tests.hybrid_envs import make_layout_env

SMALL: dict[str, Any] = dict(
    batch_size=16, learning_starts=10**9, buffer_size=500, seed=0, learning_rate=1e-3,
    policy_kwargs=dict(net_arch=[16], optimizer_kwargs=dict(fused=True)),
)  # fmt: skip


@pytest.mark.parametrize("layout", ["nested", "shared"])
def test_pa_td3_equals_td3_on_the_flattened_environment(layout):
    ours = PATD3("MlpPolicy", make_layout_env(layout), **SMALL)
    theirs = TD3("MlpPolicy", FlattenHybridAction(make_layout_env(layout)), **SMALL)
    assert ours.hybrid_space.shape == theirs.action_space.shape
    ours.learn(60)
    theirs.learn(1)
    theirs.replay_buffer = ours.replay_buffer
    theirs.policy.load_state_dict(ours.policy.state_dict())
    for model in (ours, theirs):
        np.random.seed(1)
        th.manual_seed(1)
        model.train(6, 32)
    for mine, other in zip(ours.policy.parameters(), theirs.policy.parameters(), strict=True):
        # Up to rounding: all targets are updated in one operation
        th.testing.assert_close(mine, other, rtol=0, atol=1e-6)
    obs = np.random.uniform(-1, 1, (5, 2)).astype(np.float32)
    np.testing.assert_allclose(ours.policy.predict_rows(obs), theirs.predict(obs)[0], atol=1e-6)


def test_inverting_gradients_against_a_slow_loop():
    values = (th.rand(20, 3) * 2.4 - 1.2).requires_grad_()
    weights = th.randn(20, 3)
    (InvertingGradients()(values) * weights).sum().backward()
    assert values.grad is not None
    for i in range(20):
        for j in range(3):
            ascent = -weights[i, j]  # of what the loss is the negative of
            a = values[i, j].detach()
            factor = (1 - a) / 2 if ascent > 0 else (a + 1) / 2
            assert values.grad[i, j] == pytest.approx((-ascent * factor).item(), abs=1e-6)


@pytest.mark.parametrize("algorithm", [PATD3, HHQNTD3])
def test_inverting_gradients_is_an_option(algorithm, tmp_path):
    gradients = []
    for inverting in (False, True):
        model = algorithm("MlpPolicy", make_layout_env(), inverting_gradients=inverting, **SMALL)
        obs = th.rand(8, 2)
        loss = -model.critic.q1_forward(obs, model.actor(obs)).mean()
        gradients.append(th.autograd.grad(loss, list(model.actor.mu.parameters()))[0])
    plain, inverted = gradients
    assert not th.allclose(plain, inverted)
    model.learn(20)
    model.save(tmp_path / "model")
    assert algorithm.load(tmp_path / "model").policy.inverting_gradients


def test_lower_actor_sees_the_noisy_scores():
    model = HHQNTD3("MlpPolicy", make_layout_env(), **SMALL)
    obs = np.zeros((1, 2), dtype=np.float32)
    noise = np.zeros((1, 6))
    clean = model.policy.noisy_rows(obs, noise)
    np.testing.assert_array_equal(clean, model.policy.predict_rows(obs))
    noise[0, 0] = 0.7
    noisy = model.policy.noisy_rows(obs, noise)
    assert (noisy[0, 3:] != clean[0, 3:]).all(), "parameters follow from the noisy scores"
    with th.no_grad():
        expected = model.actor.lower(th.cat([th.zeros(1, 2), th.as_tensor(noisy[:, :3])], dim=1))
    np.testing.assert_allclose(noisy[:, 3:], expected, atol=1e-6)


def test_exploration_noise_reaches_scores_and_parameters():
    model = PATD3("MlpPolicy", make_layout_env(), exploration_noise=0.3, exploration_initial_eps=0, exploration_final_eps=0,
                  **{**SMALL, "learning_starts": 0, "gradient_steps": 0})  # fmt: skip
    model.learn(200)
    rows = model.replay_buffer.actions[:200, 0]
    obs = model.replay_buffer.observations[:200, 0]
    difference = rows - model.policy.predict_rows(obs)
    assert np.all(np.abs(difference.std(axis=0) - 0.3) < 0.06) and np.abs(rows).max() <= 1


@pytest.mark.parametrize("algorithm", [PATD3, PDQNTD3])
@pytest.mark.parametrize("buffer_class", [PrioritizedReplayBuffer, WatkinsReplayBuffer])
def test_priorities_and_costs_that_nobody_would_set_are_refused(algorithm, buffer_class):
    with pytest.raises(ValueError, match="replay_buffer_class must be a class of replay buffers without priorities or costs"):
        make_model(algorithm, make_layout_env(), replay_buffer_class=buffer_class)
