"""The diffusion models on their own, against numbers and distributions that are known."""

import itertools

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_chdp.chdp.denoising import denoise
from sb3_chdp.chdp.diffusion import DeterministicModel, DiffusionModel, NoiseSchedule, cosine_beta_schedule


def test_vp_schedule_by_hand():
    # N = 2, b_min 0.1, b_max 10: beta_i = 1 - exp(-0.05 - 4.95 (2i - 1) / 4)
    schedule = NoiseSchedule(2)
    beta_1, beta_2 = 1 - np.exp(-0.05 - 1.2375), 1 - np.exp(-0.05 - 3.7125)
    np.testing.assert_allclose(schedule.betas, [beta_1, beta_2], rtol=1e-12)
    np.testing.assert_allclose(schedule.betas, [0.7240397, 0.9767742], rtol=1e-6)
    abar_1, abar_2 = 1 - beta_1, (1 - beta_1) * (1 - beta_2)
    np.testing.assert_allclose(schedule.alphas_cumprod, [abar_1, abar_2])
    # The first step has no noise before it: its posterior is x_0 itself
    np.testing.assert_allclose(schedule.posterior_mean_coef1, [1.0, beta_2 * np.sqrt(abar_1) / (1 - abar_2)])
    np.testing.assert_allclose(schedule.posterior_mean_coef2, [0.0, (1 - abar_1) * np.sqrt(1 - beta_2) / (1 - abar_2)])
    np.testing.assert_allclose(schedule.sigmas, np.sqrt([beta_1, beta_2]))
    small = NoiseSchedule(2, variance_type="fixed_small")
    np.testing.assert_allclose(small.sigmas, [0.0, np.sqrt(beta_2 * (1 - abar_1) / (1 - abar_2))])


def test_other_schedules():
    np.testing.assert_allclose(NoiseSchedule(3, "linear").betas, [1e-4, 0.01005, 0.02])
    # Remaining signal of the cosine schedule at half time: cos^2((0.5 + s) / (1 + s) pi / 2) / cos^2(s / (1 + s) pi / 2)
    s = 0.008
    half = np.prod(1 - cosine_beta_schedule(10)[:5])
    expected = (np.cos((0.5 + s) / (1 + s) * np.pi / 2) / np.cos(s / (1 + s) * np.pi / 2)) ** 2
    assert half == pytest.approx(expected)


@pytest.mark.parametrize(
    "kwargs, message", [({"n_steps": 0}, "n_diffusion_steps"), ({"n_steps": 3, "beta_schedule": "sine"}, "beta_schedule")]
)
def test_bad_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        NoiseSchedule(**kwargs)
    with pytest.raises(ValueError, match="variance_type"):
        NoiseSchedule(3, variance_type="learned")


def test_reverse_step_equals_the_papers():
    """Without clipping, the mean through x_0 is (x - (1 - alpha) / sqrt(1 - abar) eps) / sqrt(alpha)."""
    schedule = NoiseSchedule(5)
    for i in range(5):
        noise = 0.1 * th.randn(64, 4)
        x = schedule.sqrt_alphas_cumprod[i] * (th.rand(64, 4) - 0.5) + schedule.sqrt_one_minus_alphas_cumprod[i] * noise
        alpha = 1 - schedule.betas[i]
        expected = (x - (1 - alpha) / schedule.sqrt_one_minus_alphas_cumprod[i] * noise) / alpha**0.5
        mean = denoise([schedule.steps[i]], x[None], None, lambda x, i, noise=noise: noise)
        th.testing.assert_close(mean, expected, atol=2e-5, rtol=1e-4)


class OptimalPredictor(th.nn.Module):
    """The exact noise predictor of data that are Gaussian with the given mean and standard deviation."""

    def __init__(self, schedule, mean, std):
        super().__init__()
        self.schedule, self.mean, self.std = schedule, mean, std

    def for_chain(self, condition):
        return self

    def forward(self, x, i):
        abar = self.schedule.alphas_cumprod[i]
        variance = abar * self.std**2 + 1 - abar
        return (1 - abar) ** 0.5 * (x - abar**0.5 * self.mean) / variance


@pytest.mark.parametrize("variance_type", ["fixed_small", "fixed_large"])
def test_chain_with_a_linear_denoiser_gives_the_analytic_gaussian(variance_type):
    mean, std, n_steps = 0.2, 0.1, 15
    model = DiffusionModel(1, 1, n_steps, [4], variance_type=variance_type)
    model.noise_predictor = OptimalPredictor(model.schedule, mean, std)
    th.manual_seed(0)
    # Every step is affine in x: propagate mean and variance by hand
    schedule, m, v = model.schedule, 0.0, 1.0
    for i in reversed(range(n_steps)):
        abar, alpha = schedule.alphas_cumprod[i], 1 - schedule.betas[i]
        gain = (1 - abar) / (abar * std**2 + 1 - abar)  # eps = gain / sqrt(1 - abar) (x - sqrt(abar) mean)
        a = (1 - (1 - alpha) / (1 - abar) * gain) / alpha**0.5
        b = (1 - alpha) / (1 - abar) * gain * abar**0.5 * mean / alpha**0.5
        m, v = a * m + b, a * a * v + (schedule.sigmas[i] ** 2 if i > 0 else 0.0)
    with th.no_grad():
        x = model.sample(th.zeros(40_000, 1))
    assert x.mean().item() == pytest.approx(m, abs=4e-3)
    assert x.std().item() == pytest.approx(v**0.5, rel=0.03)
    assert m == pytest.approx(mean, abs=0.02)


@pytest.mark.slow
def test_diffusion_loss_alone_recovers_two_modes():
    """Given condition +1 the data lie at -0.6 and +0.6, given -1 at 0 only."""
    th.manual_seed(0)
    model = DiffusionModel(1, 1, 15, [64, 64], variance_type="fixed_small")
    optimizer = th.optim.Adam(model.parameters(), lr=2e-3)
    for _ in range(3000):
        condition = th.randint(2, (256, 1)).float() * 2 - 1
        modes = (th.randint(2, (256, 1)).float() * 2 - 1) * 0.6
        x = th.where(condition > 0, modes, th.zeros(())) + 0.03 * th.randn(256, 1)
        optimizer.zero_grad()
        model.diffusion_loss(x, condition).backward()
        optimizer.step()
    with th.no_grad():
        two = model.sample(th.ones(2000, 1))
        one = model.sample(-th.ones(2000, 1))
    near = (two.abs() - 0.6).abs() < 0.2
    assert near.float().mean() > 0.85
    assert 0.35 < (two > 0).float().mean() < 0.65
    assert (one.abs() < 0.2).float().mean() > 0.9


def test_time_and_condition_change_the_prediction():
    model = DiffusionModel(3, 2, 4, [16, 16])
    predictor, x = model.noise_predictor, th.randn(5, 3)
    context = predictor.condition_context(th.randn(5, 2))
    outputs = [predictor(x, context + time) for time in predictor.time_context()]
    assert all((a - b).abs().max() > 1e-5 for a, b in itertools.pairwise(outputs))
    assert (predictor(x, context) - predictor(x, 0 * context)).abs().max() > 1e-5


def test_split_first_layer_equals_the_layer_on_the_concatenation():
    model = DiffusionModel(3, 2, 4, [16, 16])
    predictor, x, condition, i = model.noise_predictor, th.randn(5, 3), th.randn(5, 2), 2
    embedding = predictor.time_mlp(predictor.sinusoids)[i].expand(5, -1)
    weight = th.cat([predictor.x_weight, predictor.time_weight, predictor.condition_weight], dim=1)
    hidden = th.cat([x, embedding, condition], dim=1) @ weight.t() + predictor.bias
    actual = predictor(x, predictor.condition_context(condition) + predictor.time_context()[i])
    th.testing.assert_close(actual, predictor.trunk(hidden))


@pytest.mark.parametrize("net_arch", [[16], [16, 8], [8, 16, 8]], ids=str)
@pytest.mark.parametrize("activation_fn", [nn.SiLU, nn.ReLU, nn.Tanh, nn.Mish])
@pytest.mark.parametrize("masked", [False, True])
def test_written_out_gradients_equal_autograd(net_arch, activation_fn, masked):
    model = DiffusionModel(3, 2, 6, net_arch, activation_fn)
    predictor, schedule = model.noise_predictor, model.schedule
    condition, noise = th.randn(20, 2, requires_grad=True), model.draw_noise(20)
    mask = (th.rand(20, 3) < 0.6).float() if masked else None
    context, times = predictor.condition_context(condition), predictor.time_context()
    x = noise[0]
    for i in reversed(range(6)):
        x = x if mask is None else x * mask
        abar, coefficients = schedule.alphas_cumprod[i], (schedule.posterior_mean_coef1[i], schedule.posterior_mean_coef2[i])
        x_start = ((x - (1 - abar) ** 0.5 * predictor(x, context + times[i])) / abar**0.5).clamp(-1, 1)
        x = coefficients[0] * x_start + coefficients[1] * x
        x = x + schedule.sigmas[i] * noise[i] if i > 0 else x
    plain = x.clamp(-1, 1) if mask is None else x.clamp(-1, 1) * mask
    fast = model.sample(condition, noise, mask)
    th.testing.assert_close(fast, plain, atol=1e-5, rtol=0)
    with th.no_grad():
        th.testing.assert_close(model.sample(condition, noise, mask), plain, atol=1e-5, rtol=0)
    inputs, weights = [condition, *model.parameters()], th.randn(20, 3)
    for mine, theirs in zip(*(th.autograd.grad((s * weights).sum(), inputs) for s in (fast, plain)), strict=True):
        th.testing.assert_close(mine, theirs, atol=1e-4, rtol=1e-3)


def test_padding_never_matters():
    """Values in padded entries change neither the sample nor the loss, and padded entries come out as 0."""
    model = DiffusionModel(3, 2, 5, [16])
    condition, mask = th.randn(6, 2), th.tensor([[1.0, 1.0, 0.0]]).expand(6, 3)
    noise = model.draw_noise(6)
    changed = noise.clone()
    changed[..., 2] += 5.0
    first, second = model.sample(condition, noise, mask), model.sample(condition, changed, mask)
    assert (first == second).all() and not first[:, 2].any()
    x = th.rand(6, 3) * 2 - 1
    other = x.clone()
    other[:, 2] = 0.7
    losses = []
    for start in (x, other):
        th.manual_seed(0)
        losses.append(model.diffusion_loss(start, condition, mask))
    assert losses[0] == losses[1]


def test_deterministic_model():
    model = DeterministicModel(2, 3, [8], exploration_noise=0.5)
    condition = th.randn(7, 3)
    quiet = model.draw_noise(7, th.Generator())
    assert (model.sample(condition, quiet) == model.mlp(condition)).all()
    assert (model.sample(condition) != model.sample(condition)).any()
    assert model.diffusion_loss(th.zeros(7, 2), condition) == 0
