"""PaperCHDP: what the published algorithm does otherwise."""

import inspect

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from torch.nn.utils import parameters_to_vector

from sb3_chdp import CHDP
from sb3_chdp.chdp import PaperCHDP
from tests.algorithms import calls_of, fast_model, filled_model, sample
from tests.hybrid_envs import HybridIdentityEnv, LayoutEnv, box, make_layout_env


@pytest.fixture
def model():
    return filled_model(algorithm_class=PaperCHDP)


def test_stored_latents_stay(model):
    """Though the codebook has moved, critics learn about the latents as they were."""
    with th.no_grad():
        model.actor.codebook.codewords.neg_()
    calls = calls_of(model.critic.q_networks[0])
    model.train(1, 32)
    stored = th.as_tensor(model.hybrid_space.columns.view(model.replay_buffer.actions[:60, 0], "latents"))
    assert (calls[0][1][:, None] == stored).all(dim=2).any(dim=1).all()


@pytest.mark.parametrize("layout", ["joint", "factored"])
def test_latents_of_forbidden_actions_give_way(layout):
    """To the nearest allowed codeword, with the gradient of what was drawn; others stay as they are."""
    env = LayoutEnv(spaces.Tuple((spaces.MultiDiscrete([2, 3]), box(-1, 1, 1))))
    actor = fast_model(PaperCHDP, env, action_layout=layout).actor
    codebook, drawn = actor.codebook, (2 * th.rand(200, actor.codebook.latent_dim) - 1).requires_grad_()
    actor.discrete_policy.sample = lambda features, noise=None: drawn
    masks = th.ones(200, 6 if layout == "joint" else 5, dtype=th.bool)
    masks[:, 0] = False
    free = codebook.quantize(drawn)
    latents, k = actor.sample_latents(th.zeros(200, 1), masks=masks)
    assert (codebook.quantize(latents) == k).all() and (k.view(200, -1)[:, 0] != 0).all()
    moved = (k != free).view(200, -1).any(dim=1)
    assert 0 < moved.sum() < 200 and th.equal(latents[~moved], drawn[~moved])
    assert th.equal(latents[moved], codebook.representative_latents(k)[moved])
    (gradient,) = th.autograd.grad(latents.sum(), drawn)
    assert (gradient == 1).all()


def test_latents_are_valued_with_the_stored_parameters(model):
    calls = calls_of(model.critic.q_networks[0])
    model.train(1, 32)
    critics, discrete, _ = calls
    assert th.equal(discrete[2], critics[2]) and (discrete[1] != critics[1]).any(dim=1).all()


def test_what_the_discrete_policy_draws_is_improved(model):
    """No uniformly random action, no stored one: two draws of the policy, before and after its step."""
    codewords = model.actor.codebook.codewords.detach().clone()
    calls = calls_of(model.critic.q_networks[0])
    model.train(1, 400)
    critics, discrete, continuous = (latents for _, latents, _ in calls)
    for other in (critics, discrete):
        assert (continuous != other).any(dim=1).float().mean() > 0.95
    assert not (continuous[:, None] == codewords).all(dim=2).any()


def test_critics_leave_the_codebook_alone():
    model = filled_model(algorithm_class=PaperCHDP)
    codewords, states = model.actor.codebook.codewords, []
    model.critic.q_networks[0].register_forward_pre_hook(lambda *_: states.append(codewords.detach().clone()))
    model.train(1, 32)
    assert all(th.equal(state, states[0]) for state in states) and not th.equal(codewords, states[0])


def test_it_explores_in_the_warm_up_alone(model):
    """Then one draw of its policies acts, and the critics are not asked."""
    columns = model.hybrid_space.columns
    assert len(np.unique(columns.discrete_actions(model.replay_buffer.actions[:60, 0]))) == 3
    model.learning_starts, model.gradient_steps = 60, 0
    asked = calls_of(model.critic_target.q_networks[0])
    policies = (model.actor.discrete_policy, model.actor.continuous_policy)
    chains = [calls_of(policy.noise_predictor) for policy in policies]
    model.learn(100, reset_num_timesteps=False, log_interval=10**6)
    assert model.logger.name_to_value["rollout/exploration_rate"] == 0
    assert not asked
    for calls in chains:
        assert len(calls) == 100 * model.n_diffusion_steps and all(len(x) == 1 for x, _ in calls)
    acted = model.replay_buffer.actions[60:160, 0]
    latents = th.as_tensor(columns.view(acted, "latents"))
    np.testing.assert_array_equal(model.actor.codebook.quantize(latents), columns.discrete_actions(acted))


def test_observations_are_as_they_are(model):
    data = sample(model)
    assert th.equal(model.critic.features(data.observations), data.observations)
    model.train(5, 32)
    assert th.equal(model.critic.features(data.observations), data.observations)


def test_replay_is_uniform():
    env = make_layout_env(observation_space=spaces.Dict(vector=spaces.Box(-1, 1, (2,))))
    assert type(fast_model(PaperCHDP).replay_buffer) is ReplayBuffer
    assert type(PaperCHDP("MultiInputPolicy", env, buffer_size=100).replay_buffer) is DictReplayBuffer


def test_policies_are_updated_every_time_at_a_constant_rate():
    model = filled_model(algorithm_class=PaperCHDP)
    model.train(1, 32)
    assert "train/continuous_loss" in model.logger.name_to_value
    model = PaperCHDP("MlpPolicy", HybridIdentityEnv(), learning_starts=0, seed=0, n_diffusion_steps=2)
    rate = model.critic.optimizer.param_groups[0]["lr"]
    model.learn(20)
    assert model.critic.optimizer.param_groups[0]["lr"] == rate


def test_gradients_are_bounded():
    """With large rewards, which PaperCHDP brings into no other units; Adam, which would hide it, is not used."""
    policy_kwargs = dict(net_arch=[16], optimizer_class=th.optim.SGD)
    model = filled_model(algorithm_class=PaperCHDP, policy_kwargs=policy_kwargs)
    model.replay_buffer.rewards[:] += 1e4
    before = parameters_to_vector(model.critic.q_networks.parameters()).detach()
    model.train(1, 32)
    step = (parameters_to_vector(model.critic.q_networks.parameters()) - before).norm().item() / 1e-3
    assert step == pytest.approx(model.max_grad_norm, rel=0.01)


def test_arguments_are_a_part_of_chdps():
    arguments, of_chdp = (inspect.signature(algorithm).parameters for algorithm in (PaperCHDP, CHDP))
    assert [name for name in of_chdp if name in arguments] == list(arguments)
