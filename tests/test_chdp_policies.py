"""The codebook of CHDP, and how its policies act."""

import itertools

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_chdp import CHDP
from sb3_chdp.chdp.codebook import Codebook
from sb3_chdp.chdp.critic import HybridCritic, chebyshev_features
from sb3_chdp.common.utils import hash_observations
from tests.algorithms import FAST_CHDP, filled_model
from tests.fitting import unexplained
from tests.hybrid_envs import LayoutEnv, box, make_layout_env


@settings(max_examples=50, deadline=None)
@given(k=st.integers(1, 40), dim=st.integers(1, 10), seed=st.integers(0, 1000))
def test_nearest_codeword_against_brute_force(k, dim, seed):
    th.manual_seed(seed)
    codebook = Codebook(k, dim)
    latents = th.rand(30, dim) * 2 - 1
    distances = (latents[:, None] - codebook.codewords.detach()).square().sum(dim=2)
    chosen = distances.gather(1, codebook.quantize(latents)[:, None])
    th.testing.assert_close(chosen, distances.min(dim=1, keepdim=True).values, atol=1e-5, rtol=1e-5)


def test_codebook_stays_where_the_latents_are():
    model = filled_model()
    with th.no_grad():
        model.actor.codebook.codewords[0] = 0.9999
    model.codebook_lr_factor = 500.0
    model._setup_model()
    model.replay_buffer = filled_model().replay_buffer
    model.train(3, 32)
    assert model.actor.codebook.codewords.abs().max() <= 1


def test_padding_reaches_nothing():
    """Rows, replay buffer and critic see 0 for parameters that the action does not have."""
    model = filled_model(make_layout_env("nested"))
    mask = model.hybrid_space.spec.mask
    data = model._sample_batch(64)
    assert not data.parameters[~th.as_tensor(mask[data.discrete_actions])].any()
    rows = model.policy.predict_rows(np.random.uniform(-1, 1, (200, 2)).astype(np.float32))
    k = rows[:, 0].astype(int)
    assert not rows[:, 1:3][~mask[k]].any() and np.abs(rows[:, 1:]).max() <= 1
    features = model.policy.actor_features(data.observations)
    for action in range(3):
        actions = th.full((64,), action)
        parameters = model.actor.sample_parameters(features, actions)
        assert not parameters[:, mask[action].sum() :].any()


def make_critic(latent_dim=3, **kwargs):
    observation_space = box(-1, 1, 2)
    extractor = FlattenExtractor(observation_space)
    return HybridCritic(observation_space, latent_dim, 1, [64, 64], extractor, extractor.features_dim, th.nn.SiLU, **kwargs)


@pytest.mark.parametrize("degree", [1, 2, 5])
def test_chebyshev_features_are_cosines(degree):
    x = 2 * th.rand(20, 3) - 1
    expected = th.cat([th.cos(n * th.arccos(x)) for n in range(1, degree + 1)], dim=1)
    th.testing.assert_close(chebyshev_features(x, degree), expected, atol=1e-5, rtol=1e-5)


def test_critic_tells_apart_parameters_near_a_bound():
    """A peak of 1/30 of the range, 1/40 from the bound: degree 4 fits it within 200 steps, degree 1 does not."""
    left = []
    for degree in (1, 4):
        th.manual_seed(0)
        critic = make_critic(parameter_degree=degree, layer_norm=True)

        def batch(critic=critic):
            parameters = 2 * th.rand(256, 1) - 1
            target = th.exp(-(((parameters + 0.95) / 0.03) ** 2))
            return critic.q1_values(th.zeros(256, 2), th.zeros(256, 3), parameters), target

        left.append(unexplained(critic.q_networks[0], batch, 200))
    assert left[0] > 0.4 and left[1] < 0.1


def test_critic_tells_apart_what_a_parameter_does():
    """Each of 64 discrete actions has its own factor of the parameter: products of both fit it within 300 steps."""
    left = []
    for bilinear in (False, True):
        th.manual_seed(0)
        critic = make_critic(latent_dim=32, bilinear=bilinear)
        codewords, factors = 2 * th.rand(64, 32) - 1, th.randn(64, 1)

        def batch(critic=critic, codewords=codewords, factors=factors):
            k, parameters = th.randint(64, (256,)), 2 * th.rand(256, 1) - 1
            return critic.q1_values(th.zeros(256, 2), codewords[k], parameters), factors[k] * parameters

        left.append(unexplained(critic.q_networks[0], batch, 300))
    assert left[0] > 0.2 and left[1] < 0.02


def test_parameter_degree_must_be_positive():
    with pytest.raises(ValueError, match="parameter_degree must be a whole number of at least 1, got 0"):
        make_critic(parameter_degree=0)


def test_action_noise_spares_padding_and_is_clipped():
    from stable_baselines3.common.noise import NormalActionNoise

    noise = NormalActionNoise(np.zeros(2), 10 * np.ones(2))
    kwargs = {**FAST_CHDP, "exploration_initial_eps": 0, "exploration_final_eps": 0}
    model = CHDP("MlpPolicy", make_layout_env("nested"), action_noise=noise, **kwargs)
    model.learn(60)
    data = model._sample_batch(64)
    mask = th.as_tensor(model.hybrid_space.spec.mask[data.discrete_actions])
    assert not data.parameters[~mask].any() and data.parameters.abs().max() <= 1


def test_deterministic_predictions_repeat():
    model = filled_model()
    obs = np.random.uniform(-1, 1, (5, 4)).astype(np.float32)
    first = model.policy.predict_rows(obs, deterministic=True)
    np.testing.assert_array_equal(model.policy.predict_rows(obs, deterministic=True), first)
    # The same for an observation on its own as among others
    for one, row in zip(obs, first, strict=True):
        np.testing.assert_allclose(model.policy.predict_rows(one, deterministic=True), row, atol=1e-5)
    assert (model.policy.predict_rows(obs) != first).any()


def test_noise_of_deterministic_predictions_depends_on_the_observation():
    vectors, images = th.rand(1000, 4), th.randint(256, (1000, 1, 6, 6), dtype=th.uint8)
    for observations in (vectors, images, {"v": vectors, "i": images}):
        hashes = hash_observations(observations)
        assert hashes.shape == (1000,) and len((hashes % 1024).unique()) > 550  # 637 of 1024 expected
        if isinstance(observations, th.Tensor):
            assert (hash_observations(observations[5:7]) == hashes[5:7]).all()
    # A small change is enough
    assert (hash_observations(vectors + 1e-6) != hash_observations(vectors)).float().mean() > 0.99


@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("uniform_fraction", [0.0, 0.5])
def test_the_best_candidate_acts(uniform_fraction, deterministic):
    model = filled_model(n_action_candidates=8, uniform_fraction=uniform_fraction)
    obs = np.random.uniform(-1, 1, (6, 4)).astype(np.float32)
    candidates = {}
    actor = model.actor_target if deterministic else model.actor
    original = actor.sample_parameters

    def spy(features, k, noise):
        candidates["k"], candidates["parameters"] = k, original(features, k, noise)
        return candidates["parameters"]

    actor.sample_parameters = spy
    q_values, q_networks = [], model.critic_target.q_values
    model.critic_target.q_values = lambda *args: q_values.append(q_networks(*args)) or q_values[-1]
    rows = model.policy.predict_rows(obs, deterministic)
    best = th.min(*q_values[0]).view(6, 8).argmax(dim=1)
    for column, name in ((0, "k"), (1, "parameters")):
        np.testing.assert_allclose(rows[:, column], candidates[name].view(6, 8)[th.arange(6), best])
    assert (model.actor.codebook.quantize(th.as_tensor(rows[:, 2:])).numpy() == rows[:, 0]).all()
    # Four uniform candidates cover three actions
    covered = candidates["k"].view(6, 8)[:, :4].sort(dim=1).values.diff(dim=1).count_nonzero(dim=1)
    assert uniform_fraction == 0 or (covered == 2).all()


@pytest.mark.parametrize("deterministic", [False, True])
def test_random_candidates_find_what_the_policies_miss(deterministic):
    """With a critic that values parameters near 0.7 alone, and policies that never draw such."""
    model = filled_model(n_action_candidates=1)
    with th.no_grad():
        for parameter in model.actor_target.continuous_policy.parameters():
            parameter.zero_()
        model.actor.continuous_policy.load_state_dict(model.actor_target.continuous_policy.state_dict())

    def q_values(features, latents, parameters):
        assert len(features) == len(latents) == len(parameters)
        return (-(parameters - 0.7).abs(),) * 2

    model.critic_target.q_values = q_values
    obs = np.random.uniform(-1, 1, (50, 4)).astype(np.float32)
    errors = []
    for model.policy.n_random_candidates in (0, 64):
        rows = model.policy.predict_rows(obs, deterministic)
        errors.append(np.abs(rows[:, 1] - 0.7).mean())
        assert (model.actor.codebook.quantize(th.as_tensor(rows[:, 2:])).numpy() == rows[:, 0]).all()
        again = model.policy.predict_rows(obs, deterministic)
        assert (rows == again).all() == deterministic
    assert errors[1] < 0.1 < errors[0]


def test_deterministic_actions_are_refined():
    """Variations of the best action come nearer to the best parameters; the discrete action and padding stay."""
    parameters = spaces.Tuple((box(-1, 1, 1), box(-1, 1, 2)))
    model = filled_model(LayoutEnv(spaces.Tuple((spaces.Discrete(2), parameters))))
    spec, columns = model.hybrid_space.spec, model.hybrid_space.columns
    assert not spec.mask.all()
    model.critic_target.q_values = lambda features, latents, parameters: (-(parameters[:, :1] - 0.7).abs(),) * 2
    obs = np.random.uniform(-1, 1, (50, 2)).astype(np.float32)
    errors = {}
    for model.policy.n_refinement_candidates, deterministic in itertools.product((0, 32), (False, True)):
        rows = model.policy.predict_rows(obs, deterministic)
        k, parameters = columns.discrete_actions(rows), columns.view(rows, "parameters")
        errors[model.policy.n_refinement_candidates, deterministic] = np.abs(parameters[:, 0] - 0.7).mean()
        assert (model.actor.codebook.quantize(th.as_tensor(columns.view(rows, "latents"))).numpy() == k).all()
        assert (parameters[~spec.mask[k].astype(bool)] == 0).all()
        assert np.abs(parameters).max() <= 1
        assert (rows == model.policy.predict_rows(obs, deterministic)).all() == deterministic
    # Of 32 variations with a standard deviation of 0.1 the best is about 0.2 nearer
    assert errors[32, True] < errors[0, True] - 0.15
    assert errors[32, False] > 0.7 * errors[0, False]
    assert model.policy._get_constructor_parameters()["n_refinement_candidates"] == 32


@pytest.mark.parametrize("k_total", [2, 1000])
def test_random_rows_decode_to_their_action(k_total):
    env = LayoutEnv(spaces.Tuple((spaces.Discrete(k_total), box(-1, 1, 1))))
    model = CHDP("MlpPolicy", env, **FAST_CHDP)
    rows = model.policy.random_rows(np.random.default_rng(0), 500)
    decoded = model.actor.codebook.quantize(th.as_tensor(rows[:, 2:]))
    assert (decoded.numpy() == rows[:, 0]).mean() > 0.97  # a few cells are too small for the noise
    assert np.abs(rows[:, 1:]).max() <= 1


def test_the_codebook_follows_the_learning_rate():
    model = filled_model(learning_rate=lambda progress: 0.01 * progress, codebook_lr_factor=0.5)
    model._current_progress_remaining = 0.1
    model.train(1, 32)
    assert model.policy.continuous_optimizer.param_groups[0]["lr"] == pytest.approx(1e-3)
    assert model.policy.codebook_optimizer.param_groups[0]["lr"] == pytest.approx(5e-4)
