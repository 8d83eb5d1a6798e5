"""What is particular to PDQN-TD3 and MP-DQN-TD3."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_chdp import PDQNTD3
from tests.algorithms import LAYOUTS, make_model, sample
from tests.hybrid_envs import make_layout_env


def networks(layout="nested", **kwargs):
    model = make_model(PDQNTD3, make_layout_env(layout), policy_kwargs=dict(net_arch=[16, 8]), **kwargs)
    spec = model.hybrid_space.spec
    return model, spec, th.rand(5, 2), th.rand(5, spec.n_parameters, requires_grad=True)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_multi_pass_against_one_pass_per_action(layout):
    model, spec, features, parameters = networks(layout, multi_pass=True)
    values = model.critic(features, parameters)
    for q_net, of_all in zip(model.critic.q_networks, values, strict=True):
        for k in range(spec.n_discrete_actions):
            own = np.zeros(spec.n_parameters, dtype=np.float32)
            own[spec.parameter_index[k][spec.parameter_mask[k]]] = 1
            expected = q_net(th.cat([features, parameters * th.as_tensor(own)], dim=1))[:, k]
            np.testing.assert_allclose(of_all[:, k].detach(), expected.detach(), atol=1e-6)


@pytest.mark.parametrize("multi_pass", [False, True])
def test_values_of_chosen_actions(multi_pass):
    model, _, features, parameters = networks(multi_pass=multi_pass)
    k = th.tensor([0, 2, 1, 1, 0])
    for chosen, of_all in zip(
        model.critic.of_actions(features, parameters, k), model.critic(features, parameters), strict=True
    ):
        assert chosen.shape == (5, 1)
        np.testing.assert_allclose(chosen[:, 0].detach(), of_all[th.arange(5), k].detach(), atol=1e-6)


@pytest.mark.parametrize("multi_pass", [False, True])
def test_no_false_gradients_with_multi_pass(multi_pass):
    """dQ_k/dx_j is 0 for parameters of other actions with multi-pass, and is not without."""
    model, _, features, parameters = networks(multi_pass=multi_pass)
    owners = np.array([0, 0, 1])  # the third action has no parameters
    for k in range(3):
        (gradient,) = th.autograd.grad(model.critic(features, parameters)[0][:, k].sum(), parameters)
        others = gradient[:, th.as_tensor(owners != k)]
        assert (others == 0).all() == multi_pass
        if k < 2:
            assert (gradient[:, th.as_tensor(owners == k)] != 0).any()


def test_multi_pass_needs_a_hidden_layer():
    with pytest.raises(ValueError, match="multi_pass"):
        make_model(PDQNTD3, make_layout_env(), multi_pass=True, policy_kwargs=dict(net_arch=[]))


def test_target_is_the_best_of_the_pessimistic_values():
    model, _, _, _ = networks(learning_starts=5, target_policy_noise=0.0, gamma=0.9)
    model.learn(20)
    np.random.seed(1)
    batch = model.replay_buffer.sample(16)
    with th.no_grad():
        x = model.actor_target(batch.next_observations)
        q1, q2 = model.critic_target(batch.next_observations, x)
        best = th.stack([th.stack([min(a, b) for a, b in zip(*rows, strict=True)]).max() for rows in zip(q1, q2, strict=True)])
        target = batch.rewards + (1 - batch.dones) * 0.9 * best[:, None]
        columns = model.hybrid_space.columns
        k, parameters = columns.discrete_actions(batch.actions), columns.view(batch.actions, "parameters")
        values = [q.gather(1, k[:, None]) for q in model.critic(batch.observations, parameters)]
        expected = sum((q - target).square().mean() for q in values)
    np.random.seed(1)
    model.train(1, 16)
    assert model.logger.name_to_value["train/critic_loss"] == pytest.approx(expected.item(), rel=1e-5)


def test_passthrough_is_added_and_not_trained():
    weight = [[0.5, 0.0], [0.0, 0.25], [0.0, 0.0]]
    prior = dict(weight=weight, bias=[0.1, -0.1, 0.2])
    model, _, obs, _ = networks(passthrough=prior)
    plain, _, _, _ = networks()
    plain.actor.mu.load_state_dict(model.actor.mu.state_dict())
    expected = plain.actor.mu(obs) + obs @ th.tensor(weight).T + th.tensor(prior["bias"])
    np.testing.assert_allclose(model.actor(obs).detach(), expected.clamp(-1, 1).detach(), atol=1e-6)
    model.learn(40)
    assert th.equal(model.actor.passthrough_weight, th.tensor(weight))
    with pytest.raises(ValueError, match=r"passthrough\['bias'\] must have shape \(3,\)"):
        networks(passthrough=dict(bias=[1.0]))
    with pytest.raises(ValueError, match=r"passthrough must have no keys but \['weight', 'bias'\], got \['weights'\]"):
        networks(passthrough=dict(weights=weight))


def test_passthrough_stays_when_a_model_is_loaded(tmp_path):
    model, _, _, _ = networks(passthrough=dict(bias=np.full(3, 0.5)))
    model.save(tmp_path / "model")
    loaded = PDQNTD3.load(tmp_path / "model", passthrough=dict(bias=np.full(3, 0.5)))
    assert (loaded.actor.passthrough_bias == 0.5).all()
    with pytest.raises(ValueError, match="passthrough must stay"):
        PDQNTD3.load(tmp_path / "model", passthrough=dict(bias=np.zeros(3)))


@pytest.mark.parametrize("rate", [-1e-3, np.nan])
def test_a_schedule_that_leaves_what_is_accepted(rate):
    model, _, _, _ = networks(actor_learning_rate=lambda _: rate)
    with pytest.raises(ValueError, match="actor_learning_rate must be a finite number of at least 0, got"):
        model.learn(40)


def test_a_shared_extractor_learns_from_the_actors_loss_alone():
    env = make_layout_env(observation_space=spaces.Box(0, 255, (36, 36, 1), dtype=np.uint8))
    policy_kwargs = dict(net_arch=[8], share_features_extractor=True)
    model = make_model(PDQNTD3, env, "CnnPolicy", policy_kwargs=policy_kwargs).learn(20)
    weight = next(model.actor.features_extractor.parameters())
    data = sample(model, 8)
    assert th.autograd.grad(model._critic_loss(data), weight, allow_unused=True) == (None,)
    assert th.autograd.grad(model._actor_loss(data), weight)[0].any()


def test_another_number_of_critics():
    with pytest.raises(ValueError, match="n_critics must be 2 for PDQN-TD3, got 1"):
        make_model(PDQNTD3, make_layout_env(), policy_kwargs=dict(n_critics=1))


@pytest.mark.parametrize("inverting_gradients", [True, False])
def test_parameters_stay_in_bounds(inverting_gradients):
    model, _, _, _ = networks(inverting_gradients=inverting_gradients)
    with th.no_grad():
        for parameter in model.actor.parameters():
            parameter.mul_(20)
    parameters = model.actor(th.rand(50, 2) * 4)
    assert parameters.abs().max() <= 1 and (parameters.abs() > 0.99).any()


def test_gradient_leads_back_from_beyond_the_bounds():
    """The clamp must not cut off the inverted gradient of an output that has left [-1, 1]."""
    model, _, obs, _ = networks()
    with th.no_grad():
        model.actor.mu[-1].weight.zero_()
        model.actor.mu[-1].bias.fill_(1.5)
    model.actor(obs).sum().neg().backward()  # ascend: further up
    assert (model.actor.mu[-1].bias.grad > 0).all(), "descent lowers the outputs"


def test_every_network_moves():
    model, _, _, _ = networks()
    model.learn(20)
    before = {name: p.clone() for name, p in model.policy.named_parameters()}
    model.train(4, 16)
    assert all((p != before[name]).any() for name, p in model.policy.named_parameters())
