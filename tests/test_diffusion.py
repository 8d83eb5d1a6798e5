"""The diffusion models on their own, against numbers and distributions that are known."""

import itertools

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_chdp.chdp.diffusion import DiffusionModel, NoisePredictor, NoiseSchedule


def betas_of(n_steps):
    """:return: (N,) beta_i of the variance preserving process, with b_min 0.1 and b_max 10"""
    i = np.arange(1, n_steps + 1)
    return 1 - np.exp(-0.1 / n_steps - 0.5 * 9.9 * (2 * i - 1) / n_steps**2)


def test_schedule_by_hand():
    # N = 2: beta_i = 1 - exp(-0.05 - 4.95 (2i - 1) / 4)
    schedule = NoiseSchedule(2)
    beta_1, beta_2 = 1 - np.exp(-0.05 - 1.2375), 1 - np.exp(-0.05 - 3.7125)
    np.testing.assert_allclose([beta_1, beta_2], [0.7240397, 0.9767742], rtol=1e-6)
    np.testing.assert_allclose([beta_1, beta_2], betas_of(2), rtol=1e-12)
    np.testing.assert_allclose(schedule.sigma, np.sqrt([beta_1, beta_2]), rtol=1e-12)
    abar_1, abar_2 = 1 - beta_1, (1 - beta_1) * (1 - beta_2)
    np.testing.assert_allclose(schedule.signal, np.sqrt([abar_1, abar_2]))
    np.testing.assert_allclose(schedule.spread, np.sqrt([1 - abar_1, 1 - abar_2]))
    # The first step has no noise before it: its posterior is x_0 itself
    np.testing.assert_allclose(schedule.mean_start, [1.0, beta_2 * np.sqrt(abar_1) / (1 - abar_2)])
    np.testing.assert_allclose(schedule.mean_x, [0.0, (1 - abar_1) * np.sqrt(1 - beta_2) / (1 - abar_2)])


class KnownNoise(NoisePredictor):
    """Predicts what :meth:`DiffusionModel.sample` ought to take away: a function of x_i and the step, given as a tensor."""

    def __init__(self, predict, n_steps):
        nn.Module.__init__(self)
        self.predict, self.n_steps = predict, n_steps

    def contexts(self, condition):
        return th.zeros(len(condition), 1), th.arange(self.n_steps)[:, None]

    def forward(self, x, context):
        return self.predict(x, int(context[0]))


def test_reverse_step_equals_the_papers():
    """Where nothing is clipped, x_{i-1} = (x_i - beta_i / sqrt(1 - abar_i) eps) / sqrt(alpha_i) + sqrt(beta_i) z."""
    n_steps, betas = 5, betas_of(5)
    abar = np.cumprod(1 - betas)
    model, seen = DiffusionModel(4, 1, n_steps, [4]), []

    def predict(x, i):
        # The noise that stands for an x_0 well inside [-1, 1]
        eps = (x - abar[i] ** 0.5 * 0.1 * th.tanh(x)) / (1 - abar[i]) ** 0.5
        seen.append((i, x, eps))
        return eps

    model.noise_predictor = KnownNoise(predict, n_steps)
    noise = th.randn(n_steps, 64, 4)
    x_0 = model.sample(th.zeros(64, 1), noise=noise)
    assert [i for i, *_ in seen] == [4, 3, 2, 1, 0] and (seen[0][1] == noise[0]).all()
    samples = [x for _, x, _ in seen[1:]] + [x_0]
    for (i, x, eps), after in zip(seen, samples, strict=True):
        expected = (x - betas[i] / (1 - abar[i]) ** 0.5 * eps) / (1 - betas[i]) ** 0.5
        if i > 0:
            expected = expected + betas[i] ** 0.5 * noise[n_steps - i]
        th.testing.assert_close(after, expected.float(), atol=2e-5, rtol=1e-4)


def test_samples_are_in_the_box():
    """However far off the predicted noise is."""
    model = DiffusionModel(3, 2, 5, [16])
    with th.no_grad():
        for parameter in model.parameters():
            parameter.mul_(20)
    x = model.sample(5 * th.randn(100, 2))
    assert x.abs().max() <= 1


def test_chain_with_a_linear_denoiser_gives_the_analytic_gaussian():
    """With the exact noise predictor of Gaussian data every step is affine in x: mean and variance follow by hand."""
    mean, std, n_steps = 0.2, 0.1, 15
    betas = betas_of(n_steps)
    abar = np.cumprod(1 - betas)

    def predict(x, i):
        variance = abar[i] * std**2 + 1 - abar[i]
        return (1 - abar[i]) ** 0.5 * (x - abar[i] ** 0.5 * mean) / variance

    model = DiffusionModel(1, 1, n_steps, [4])
    model.noise_predictor = KnownNoise(predict, n_steps)
    th.manual_seed(0)
    m, v = 0.0, 1.0
    for i in reversed(range(n_steps)):
        alpha = 1 - betas[i]
        gain = (1 - abar[i]) / (abar[i] * std**2 + 1 - abar[i])  # eps = gain / sqrt(1 - abar) (x - sqrt(abar) mean)
        a = (1 - (1 - alpha) / (1 - abar[i]) * gain) / alpha**0.5
        b = (1 - alpha) / (1 - abar[i]) * gain * abar[i] ** 0.5 * mean / alpha**0.5
        m, v = a * m + b, a * a * v + (betas[i] if i > 0 else 0.0)
    with th.no_grad():
        x = model.sample(th.zeros(40_000, 1))
    assert x.mean().item() == pytest.approx(m, abs=4e-3)
    assert x.std().item() == pytest.approx(v**0.5, rel=0.03)
    assert m == pytest.approx(mean, abs=0.02)


def test_diffusion_loss_alone_recovers_two_modes():
    """Given condition +1 the data lie at -0.6 and +0.6, given -1 at 0 only."""
    th.manual_seed(0)
    model = DiffusionModel(1, 1, 15, [64, 64])
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


def test_step_and_condition_change_the_prediction():
    predictor, x = DiffusionModel(3, 2, 4, [16, 16]).noise_predictor, th.randn(5, 3)
    by_condition, by_step = predictor.contexts(th.randn(5, 2))
    outputs = [predictor(x, by_condition + step) for step in by_step]
    assert all((a - b).abs().max() > 1e-5 for a, b in itertools.pairwise(outputs))
    assert (outputs[0] - predictor(x, by_step[0].expand(5, -1))).abs().max() > 1e-5


def test_parts_of_the_first_layer_are_one_layer_on_the_concatenation():
    predictor, x, condition = DiffusionModel(3, 2, 4, [16, 16]).noise_predictor, th.randn(5, 3), th.randn(5, 2)
    embedding = predictor.time_mlp(predictor.sinusoids)[2].expand(5, -1)
    parts = (predictor.of_x, predictor.of_step, predictor.of_condition)
    weight = th.cat([part.weight for part in parts], dim=1)
    hidden = th.nn.functional.linear(th.cat([x, embedding, condition], dim=1), weight, predictor.of_step.bias)
    by_condition, by_step = predictor.contexts(condition)
    th.testing.assert_close(predictor(x, by_condition + by_step[2]), predictor.trunk(hidden))


@pytest.mark.parametrize("masked", [False, True])
def test_gradients_flow_through_the_whole_chain(masked):
    """Those of the condition against finite differences, and every parameter gets one."""
    th.manual_seed(0)
    model = DiffusionModel(3, 2, 6, [8], nn.Tanh).double()
    noise, mask = 0.3 * th.randn(6, 4, 3).double(), th.tensor([[1.0, 0.0, 1.0]]).double() if masked else None
    condition = th.randn(4, 2).double().requires_grad_()
    assert th.autograd.gradcheck(lambda c: model.sample(c, mask, noise), (condition,))
    gradients = th.autograd.grad(model.sample(condition, mask, noise).square().sum(), list(model.parameters()))
    assert all(gradient.abs().max() > 0 for gradient in gradients)


def test_padding_never_matters():
    """Values in padded entries change neither the sample nor the loss, and padded entries come out as 0."""
    model = DiffusionModel(3, 2, 5, [16])
    condition, mask = th.randn(6, 2), th.tensor([[1.0, 1.0, 0.0]]).expand(6, 3)
    noise = th.randn(5, 6, 3)
    changed = noise.clone()
    changed[..., 2] += 5.0
    first, second = model.sample(condition, mask, noise), model.sample(condition, mask, changed)
    assert (first == second).all() and not first[:, 2].any()
    x = th.rand(6, 3) * 2 - 1
    other = x.clone()
    other[:, 2] = 0.7
    losses = []
    for start in (x, other):
        th.manual_seed(0)
        losses.append(model.diffusion_loss(start, condition, mask))
    assert losses[0] == losses[1]


def test_diffusion_loss_is_the_error_of_the_predicted_noise():
    """Without its noise, x_i = signal x_0: a predictor that knows x_0 has no loss, one that says 0 has a loss of 1."""
    model = DiffusionModel(2, 1, 5, [4])
    x_start = (th.rand(4000, 2) * 2 - 1) * 0.5
    abar = np.cumprod(1 - betas_of(5))
    seen = []

    class Exact(KnownNoise):
        def forward(self, x, context):
            seen.append(context[:, 0].long())
            signal = th.as_tensor(abar, dtype=th.float32)[context[:, 0].long(), None]
            return (x - signal.sqrt() * x_start) / (1 - signal).sqrt()

    model.noise_predictor = Exact(None, 5)
    assert model.diffusion_loss(x_start, th.zeros(4000, 1)) < 1e-9
    # Every step is as likely
    assert th.bincount(seen[0], minlength=5).min() > 700
    model.noise_predictor = KnownNoise(lambda x, i: th.zeros_like(x), 5)
    assert model.diffusion_loss(x_start, th.zeros(4000, 1)).item() == pytest.approx(1, abs=0.1)
