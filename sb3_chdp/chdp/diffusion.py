"""Denoising diffusion over vectors in [-1, 1]. There is no reinforcement learning in this file."""

import math

import numpy as np
import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn
from torch.nn import functional as F

# Of the variance preserving noise schedule
BETA_MIN, BETA_MAX = 0.1, 10.0
# Width of the embedding of the step
TIME_DIM = 16


class NoiseSchedule:
    """
    Constants of the forward and the reverse process: the discretised variance preserving process of Xiao et al. (2022),
    with the variance beta_i of the paper in the reverse steps. Index 0 is the first noising step, the paper's i = 1.

    :param n_steps: number N of denoising steps
    """

    def __init__(self, n_steps: int):
        i = np.arange(1, n_steps + 1)
        betas = 1 - np.exp(-BETA_MIN / n_steps - 0.5 * (BETA_MAX - BETA_MIN) * (2 * i - 1) / n_steps**2)
        alphas = 1 - betas
        alphas_cumprod = np.cumprod(alphas)
        alphas_cumprod_prev = np.append(1.0, alphas_cumprod[:-1])
        # x_i = signal * x_0 + spread * noise
        self.signal: list[float] = np.sqrt(alphas_cumprod).tolist()
        self.spread: list[float] = np.sqrt(1 - alphas_cumprod).tolist()
        # Mean of x_{i-1} given x_0 and x_i
        self.mean_start: list[float] = (betas * np.sqrt(alphas_cumprod_prev) / (1 - alphas_cumprod)).tolist()
        self.mean_x: list[float] = ((1 - alphas_cumprod_prev) * np.sqrt(alphas) / (1 - alphas_cumprod)).tolist()
        self.sigma: list[float] = np.sqrt(betas).tolist()


class NoisePredictor(nn.Module):
    """
    MLP eps(x_i, i, condition), whose first layer has a part for x, one for the step and one for the condition.

    In a chain the condition's part is computed once, and the parts of all N steps once for all rows.

    :param dim: width of x
    :param condition_dim: width of the condition
    :param n_steps: number N of denoising steps
    :param net_arch: hidden layers, at least one
    :param activation_fn: activation function
    """

    sinusoids: th.Tensor

    def __init__(self, dim: int, condition_dim: int, n_steps: int, net_arch: list[int], activation_fn: type[nn.Module]):
        super().__init__()
        if not net_arch:
            raise ValueError("net_arch of the diffusion policies must have at least one hidden layer, got []")
        frequencies = th.exp(-math.log(10_000) * th.arange(TIME_DIM // 2) / (TIME_DIM // 2 - 1))
        angles = th.arange(1, n_steps + 1)[:, None] * frequencies
        self.register_buffer("sinusoids", th.cat([angles.sin(), angles.cos()], dim=1), persistent=False)
        self.time_mlp = nn.Sequential(nn.Linear(TIME_DIM, 2 * TIME_DIM), activation_fn(), nn.Linear(2 * TIME_DIM, TIME_DIM))
        self.of_x = nn.Linear(dim, net_arch[0], bias=False)
        self.of_step = nn.Linear(TIME_DIM, net_arch[0])
        self.of_condition = nn.Linear(condition_dim, net_arch[0], bias=False)
        # As the one layer that they stand for
        bound = 1 / math.sqrt(dim + TIME_DIM + condition_dim)
        for parameter in (self.of_x.weight, *self.of_step.parameters(), self.of_condition.weight):
            nn.init.uniform_(parameter, -bound, bound)
        self.trunk = nn.Sequential(activation_fn(), *create_mlp(net_arch[0], dim, net_arch[1:], activation_fn))

    def contexts(self, condition: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param condition: (B, condition_dim)
        :return: what the condition (B, H) and what each of the N steps (N, H) adds to the first layer
        """
        return self.of_condition(condition), self.of_step(self.time_mlp(self.sinusoids))

    def forward(self, x: th.Tensor, context: th.Tensor) -> th.Tensor:
        """
        :param x: (B, dim) noisy sample
        :param context: (B, H) sum of what condition and step add to the first layer
        :return: (B, dim) predicted noise
        """
        return self.trunk(th.addmm(context, x, self.of_x.weight.t()))


class DiffusionModel(nn.Module):
    """
    Conditional denoising diffusion model of a vector in [-1, 1]^dim.

    :param dim: width of the vector
    :param condition_dim: width of the condition
    :param n_steps: number N of denoising steps
    :param net_arch: hidden layers of the noise predictor
    :param activation_fn: activation function
    """

    levels: th.Tensor
    injected_sigmas: th.Tensor

    def __init__(
        self, dim: int, condition_dim: int, n_steps: int, net_arch: list[int], activation_fn: type[nn.Module] = nn.SiLU
    ):
        super().__init__()
        self.dim, self.n_steps = dim, n_steps
        self.schedule = NoiseSchedule(n_steps)
        self.noise_predictor = NoisePredictor(dim, condition_dim, n_steps, net_arch, activation_fn)
        levels = th.tensor([self.schedule.signal, self.schedule.spread])
        self.register_buffer("levels", levels, persistent=False)
        sigmas = th.tensor(self.schedule.sigma[:0:-1], dtype=th.float32)
        self.register_buffer("injected_sigmas", sigmas[:, None, None], persistent=False)

    def sample(self, condition: th.Tensor, mask: th.Tensor | None = None, noise: th.Tensor | None = None) -> th.Tensor:
        """
        Run the whole reverse chain; gradients flow through it.

        Each step is the paper's, written through the x_0 that the predicted noise stands for, so that it can be clipped.

        :param condition: (B, condition_dim)
        :param mask: (B, dim) 1 for the entries that exist, None if all do; the others stay 0
        :param noise: (N, B, dim) standard normal: the start x_N, then what steps N to 2 inject; drawn if None
        :return: (B, dim) x_0 in [-1, 1]
        """
        if noise is None:
            noise = th.randn((self.n_steps, len(condition), self.dim), device=condition.device)
        schedule = self.schedule
        by_condition, by_step = self.noise_predictor.contexts(condition)
        x = noise[0] if mask is None else noise[0] * mask
        # Of the steps N to 2
        injected = (noise[1:] * self.injected_sigmas).unbind()
        for i in reversed(range(self.n_steps)):
            predicted = self.noise_predictor(x, by_condition + by_step[i])
            signal = schedule.signal[i]
            # signal * x_0, clipped as x_0 is to [-1, 1]
            scaled_start = th.sub(x, predicted, alpha=schedule.spread[i]).clamp(-signal, signal)
            if i == 0:
                x = scaled_start / signal
            else:
                from_x = th.add(injected[-i], x, alpha=schedule.mean_x[i])
                x = th.add(from_x, scaled_start, alpha=schedule.mean_start[i] / signal)
            if mask is not None:
                x = x * mask
        return x

    def diffusion_loss(self, x_start: th.Tensor, condition: th.Tensor, mask: th.Tensor | None = None) -> th.Tensor:
        """
        Eq. 2, L_d = E |eps - eps_theta(sqrt(alpha_bar_i) x_0 + sqrt(1 - alpha_bar_i) eps, i)|^2 for uniformly random steps i.

        :param x_start: (B, dim) clean samples
        :param condition: (B, condition_dim)
        :param mask: (B, dim) 1 for the entries that exist, None if all do
        """
        i = th.randint(self.n_steps, (len(x_start),), device=x_start.device)
        noise = th.randn_like(x_start)
        signal, spread = self.levels[:, i, None]
        x = signal * x_start + spread * noise
        by_condition, by_step = self.noise_predictor.contexts(condition)
        if mask is None:
            return F.mse_loss(self.noise_predictor(x, by_condition + by_step[i]), noise)
        errors = self.noise_predictor(x * mask, by_condition + by_step[i]) - noise
        return (errors.square() * mask).sum() / mask.sum().clamp(min=1)
