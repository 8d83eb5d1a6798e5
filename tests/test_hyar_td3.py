"""HyAR's action representation, on its own and in HyAR-TD3."""

import numpy as np
import pytest
import torch as th

from sb3_chdp import HyARTD3
from sb3_chdp.hyar_td3.representation import ActionBatch, ActionRepresentation
from tests.algorithms import has_learnt, make_model, snapshot
from tests.hybrid_envs import make_layout_env

MASK = th.tensor([[True, True], [True, False], [False, False]])


def random_batch(n):
    """The state moves by what the action says."""
    k = th.randint(3, (n,))
    parameters = (th.rand(n, 2) * 2 - 1) * MASK[k]
    features = th.rand(n, 3) * 2 - 1
    changes = 0.5 * th.stack([parameters[:, 0], parameters[:, 1], (k - 1.0)], dim=1)
    return ActionBatch(features, k, parameters, changes)


@pytest.fixture(scope="module")
def trained():
    th.manual_seed(0)
    representation = ActionRepresentation(3, MASK, embedding_dim=4, parameter_latent_dim=3, hidden_dim=64)
    optimizer = th.optim.Adam(representation.parameters(), lr=2e-3)
    for _ in range(800):
        loss = representation.loss(random_batch(128))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    representation.update_bounds(random_batch(5000))
    return representation


def latents_of(representation, batch):
    """What a policy would have to put out to take these actions."""
    return th.cat([representation.embed(batch.discrete_actions), representation.encode(batch)[0]], dim=1).detach()


def test_reconstruction_and_prediction(trained):
    batch = random_batch(1000)
    parameters, changes = trained.decode(batch.features, batch.discrete_actions, trained.encode(batch)[0])
    # Parameters are uniform in [-1, 1]: a representation that has learnt nothing has errors of 0.33 and 0.1
    mask = MASK[batch.discrete_actions]
    assert ((parameters - batch.parameters).square()[mask].mean() < 0.08).item()
    assert (changes - batch.changes).square().mean() < 0.03
    assert (parameters[~mask] == 0).all(), "padding"


def test_bounds_hold_the_central_96_percent(trained):
    batch = random_batch(20_000)
    mean, log_std = trained.encode(batch)
    z = mean + log_std.exp() * th.randn_like(mean)
    inside = ((z >= trained.latent_low) & (z <= trained.latent_high)).float().mean(dim=0)
    np.testing.assert_allclose(inside.numpy(), 0.96, atol=0.02)


def test_scaling(trained):
    scaled = th.rand(50, 3) * 2 - 1
    np.testing.assert_allclose(trained.scale(trained.unscale(scaled)), scaled, atol=1e-5)
    assert trained.scale(th.full((1, 3), 1e6)).tolist() == [[1.0, 1.0, 1.0]]
    np.testing.assert_allclose(trained.unscale(th.ones(1, 3))[0], trained.latent_high, atol=1e-5)


def test_scaling_with_collapsed_bounds():
    representation = ActionRepresentation(3, MASK, 4, 3)
    representation.latent_low.zero_()
    representation.latent_high.zero_()
    assert th.isfinite(representation.scale(th.rand(5, 3))).all()


def test_relabelling_is_the_identity_for_an_unchanged_representation(trained):
    batch = random_batch(1000)
    stored = latents_of(trained, batch)
    relabelled, kept = trained.relabel(batch, stored)
    assert kept[:, 0].all(), "embeddings"
    assert th.equal(relabelled[:, :4], stored[:, :4])
    assert kept[:, 1].float().mean() > 0.9, "parameter latents"
    keep = kept[:, 1]
    np.testing.assert_allclose(relabelled[keep, 4:], trained.scale(stored[keep, 4:]), atol=1e-6)


def test_relabelling_of_shifted_and_unknown_latents(trained):
    batch = random_batch(1000)
    stored = latents_of(trained, batch)
    wrong = stored.clone()
    wrong[:, :4] = trained.embed((batch.discrete_actions + 1) % 3).detach()
    wrong[:, 4:] = 50.0
    for latents in (wrong, th.full_like(stored, th.nan)):
        relabelled, kept = trained.relabel(batch, latents)
        assert not kept[:, 0].any()
        # Noise apart, every new embedding is the one of the action taken
        assert ((relabelled[:, :4] - trained.embed(batch.discrete_actions)).abs() <= 0.5 + 1e-6).all()
        assert (trained.nearest_action(relabelled[:, :4]) == batch.discrete_actions).float().mean() > 0.95
        assert th.isfinite(relabelled).all() and relabelled.abs().max() <= 1
    _, kept = trained.relabel(batch, th.full_like(stored, th.nan))
    assert not kept.any()
    np.testing.assert_allclose(relabelled[:, 4:], trained.scale(trained.encode(batch)[0]).detach(), atol=1e-5)


def test_embeddings_decode_to_their_action(trained):
    k = th.arange(3)
    assert (trained.nearest_action(trained.embed(k)) == k).all()


def test_loss_against_a_slow_loop():
    representation = ActionRepresentation(3, MASK, 4, 3, hidden_dim=8)
    batch = random_batch(20)
    th.manual_seed(1)
    noise = th.randn(20, 3)
    mean, log_std = representation.encode(batch)
    parameters, changes = representation.decode(batch.features, batch.discrete_actions, mean + log_std.exp() * noise)
    squares, kl_divergence, dynamics = [], [], []
    for i in range(20):
        squares += [(parameters[i, j] - batch.parameters[i, j]) ** 2 for j in range(2) if MASK[batch.discrete_actions[i], j]]
        for j in range(3):
            variance = th.exp(2 * log_std[i, j])
            kl_divergence.append(-0.5 * (1 + th.log(variance) - mean[i, j] ** 2 - variance))
            dynamics.append((changes[i, j] - batch.changes[i, j]) ** 2)
    expected = np.mean([d.item() for d in dynamics]) + 2 * np.mean([s.item() for s in squares])
    expected += 0.5 * np.mean([d.item() for d in kl_divergence])
    th.manual_seed(1)
    assert representation.loss(batch).item() == pytest.approx(expected, rel=1e-4)


def test_warm_up_is_counted_and_its_data_is_used():
    model = make_model(HyARTD3, make_layout_env(), learning_starts=50)
    before = snapshot(model)
    model.learn(50)
    assert model.num_timesteps == 50 and not has_learnt(model, before)
    latents = model.hybrid_space.columns.view(model.replay_buffer.actions[:50], "latents")
    assert np.isnan(latents).all(), "latents of random actions are unknown"
    model.learn(10, reset_num_timesteps=False, log_interval=1000)
    assert any((p != before[f"representation.{name}"]).any() for name, p in model.policy.representation.named_parameters())
    assert model.policy.representation.usual_error > 0
    assert model.num_timesteps == 60 and model.logger.name_to_value["train/n_updates"] == 10


def test_what_is_stored_is_what_was_done():
    """Stored latents decode, under the representation of then, to the stored action."""
    settings = dict(exploration_initial_eps=0, exploration_final_eps=0, learning_starts=0, gradient_steps=0)
    model = make_model(HyARTD3, make_layout_env(), exploration_noise=0.5, **settings).learn(40)
    rows, columns = th.as_tensor(model.replay_buffer.actions[:40, 0]), model.hybrid_space.columns
    obs = th.as_tensor(model.replay_buffer.observations[:40, 0])
    representation = model.policy.representation
    embeddings, z = columns.view(rows, "latents").split([3, 2], dim=1)
    k = representation.nearest_action(embeddings)
    assert th.equal(k, columns.discrete_actions(rows))
    parameters, _ = representation.decode(obs, k, z)
    np.testing.assert_allclose(parameters.detach(), columns.view(rows, "parameters"), atol=1e-6)


def test_representation_is_not_warmed_up_again_after_loading(tmp_path):
    model = make_model(HyARTD3, make_layout_env(), representation_freq=10**6).learn(30)
    model.save(tmp_path / "model")
    loaded = HyARTD3.load(tmp_path / "model", env=make_layout_env())
    before = snapshot(loaded)
    loaded.learn(20, reset_num_timesteps=False)
    assert has_learnt(loaded, before)
    for name, value in model.policy.representation.state_dict().items():
        assert th.equal(value, loaded.policy.representation.state_dict()[name]), name


@pytest.mark.parametrize("name", ["embedding_dim", "parameter_latent_dim"])
def test_bad_widths(name):
    with pytest.raises(ValueError, match=name):
        make_model(HyARTD3, make_layout_env(), **{name: 0})
