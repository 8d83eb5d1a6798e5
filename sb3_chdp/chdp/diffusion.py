"""Denoising diffusion over vectors in [-1, 1]. There is no reinforcement learning in this file."""

import math
from collections.abc import Callable

import numpy as np
import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn
from torch.nn import functional as F

from sb3_chdp.chdp.denoising import ChainMLP, DenoisingChain, StepConstants, denoise
from sb3_chdp.common.checks import check_at_least, check_one_of


def vp_beta_schedule(n_steps: int, beta_min: float = 0.1, beta_max: float = 10.0) -> np.ndarray:
    """
    Discretised variance preserving process (Xiao et al., 2022; the default of Diffusion Q-learning).

    :param n_steps: number N of denoising steps
    :return: (N,) betas
    """
    i = np.arange(1, n_steps + 1)
    return 1 - np.exp(-beta_min / n_steps - 0.5 * (beta_max - beta_min) * (2 * i - 1) / n_steps**2)


def linear_beta_schedule(n_steps: int, beta_start: float = 1e-4, beta_end: float = 2e-2) -> np.ndarray:
    """Linear betas (Ho et al., 2020)."""
    return np.linspace(beta_start, beta_end, n_steps)


def cosine_beta_schedule(n_steps: int, s: float = 0.008) -> np.ndarray:
    """Betas of a squared cosine for the remaining signal (Nichol and Dhariwal, 2021)."""
    t = np.arange(n_steps + 1) / n_steps
    alphas_cumprod = np.cos((t + s) / (1 + s) * np.pi / 2) ** 2
    return np.clip(1 - alphas_cumprod[1:] / alphas_cumprod[:-1], 0, 0.999)


BETA_SCHEDULES: dict[str, Callable[[int], np.ndarray]] = {
    "vp": vp_beta_schedule,
    "linear": linear_beta_schedule,
    "cosine": cosine_beta_schedule,
}
VARIANCE_TYPES = ("fixed_large", "fixed_small")


class NoiseSchedule:
    """
    Constants of the forward and the reverse process, as Python floats for use in loops.

    Index i = 0 is the first noising step (the paper's i = 1).

    :param n_steps: number N of denoising steps
    :param beta_schedule: "vp", "linear" or "cosine"
    :param variance_type: variance of the reverse step: "fixed_large" is beta_i (the paper), "fixed_small" that of the
        posterior q(x_{i-1} | x_i, x_0)
    """

    def __init__(self, n_steps: int, beta_schedule: str = "vp", variance_type: str = "fixed_large"):
        check_at_least(1, n_diffusion_steps=n_steps)
        check_one_of(BETA_SCHEDULES, beta_schedule=beta_schedule)
        check_one_of(VARIANCE_TYPES, variance_type=variance_type)
        self.n_steps = n_steps
        betas = BETA_SCHEDULES[beta_schedule](n_steps)
        alphas = 1 - betas
        alphas_cumprod = np.cumprod(alphas)
        alphas_cumprod_prev = np.append(1.0, alphas_cumprod[:-1])
        posterior_variance = betas * (1 - alphas_cumprod_prev) / (1 - alphas_cumprod)

        self.betas: list[float] = betas.tolist()
        self.alphas_cumprod: list[float] = alphas_cumprod.tolist()
        self.sqrt_alphas_cumprod: list[float] = np.sqrt(alphas_cumprod).tolist()
        self.sqrt_one_minus_alphas_cumprod: list[float] = np.sqrt(1 - alphas_cumprod).tolist()
        self.sqrt_recip_alphas_cumprod: list[float] = np.sqrt(1 / alphas_cumprod).tolist()
        self.sqrt_recipm1_alphas_cumprod: list[float] = np.sqrt(1 / alphas_cumprod - 1).tolist()
        self.posterior_mean_coef1: list[float] = (betas * np.sqrt(alphas_cumprod_prev) / (1 - alphas_cumprod)).tolist()
        self.posterior_mean_coef2: list[float] = ((1 - alphas_cumprod_prev) * np.sqrt(alphas) / (1 - alphas_cumprod)).tolist()
        variance = betas if variance_type == "fixed_large" else posterior_variance
        self.sigmas: list[float] = np.sqrt(variance).tolist()
        self.steps = [
            StepConstants(th.tensor(recip), recipm1, th.tensor(coef_start), coef_x, sigma)
            for recip, recipm1, coef_start, coef_x, sigma in zip(
                self.sqrt_recip_alphas_cumprod,
                self.sqrt_recipm1_alphas_cumprod,
                self.posterior_mean_coef1,
                self.posterior_mean_coef2,
                self.sigmas,
                strict=True,
            )
        ]


class NoisePredictor(nn.Module):
    """
    MLP eps(x_i, i, condition) with its first layer split into a part for x, one for the time and one for the condition.

    In a chain the condition's part is computed once, and the parts of all N times once for all rows.

    :param dim: width of x
    :param condition_dim: width of the condition
    :param n_steps: number N of denoising steps
    :param net_arch: hidden layers
    :param activation_fn: activation function
    :param time_dim: width of the time embedding
    """

    sinusoids: th.Tensor

    def __init__(
        self,
        dim: int,
        condition_dim: int,
        n_steps: int,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.SiLU,
        time_dim: int = 16,
    ):
        super().__init__()
        if not net_arch:
            raise ValueError("net_arch of the diffusion policies must have at least one hidden layer, got []")
        frequencies = th.exp(-math.log(10_000) * th.arange(time_dim // 2) / (time_dim // 2 - 1))
        angles = th.arange(1, n_steps + 1)[:, None] * frequencies
        self.register_buffer("sinusoids", th.cat([angles.sin(), angles.cos()], dim=1), persistent=False)
        self.time_mlp = nn.Sequential(nn.Linear(time_dim, 2 * time_dim), activation_fn(), nn.Linear(2 * time_dim, time_dim))
        # Initialised as the one layer that it stands for
        first_layer = nn.Linear(dim + time_dim + condition_dim, net_arch[0])
        w_x, w_time, w_condition = first_layer.weight.detach().split([dim, time_dim, condition_dim], dim=1)
        self.x_weight = nn.Parameter(w_x.clone())
        self.time_weight = nn.Parameter(w_time.clone())
        self.condition_weight = nn.Parameter(w_condition.clone())
        self.bias = nn.Parameter(first_layer.bias.detach().clone())
        self.activation = activation_fn()
        self.trunk = nn.Sequential(self.activation, *create_mlp(net_arch[0], dim, net_arch[1:], activation_fn))

    def time_context(self) -> th.Tensor:
        """:return: (N, H) contributions of the N times to the first layer"""
        return F.linear(self.time_mlp(self.sinusoids), self.time_weight, self.bias)

    def condition_context(self, condition: th.Tensor) -> th.Tensor:
        """
        :param condition: (B, condition_dim)
        :return: (B, H) its contribution to the first layer
        """
        return F.linear(condition, self.condition_weight)

    def chain_inputs(self, condition: th.Tensor) -> tuple[th.Tensor, ...]:
        """
        :param condition: (B, condition_dim)
        :return: contributions of condition and times to the first layer, its weight for x, and the further layers' parameters
        """
        return self.condition_context(condition), self.time_context(), self.x_weight, *self.trunk.parameters()

    def for_chain(self, condition: th.Tensor) -> Callable[[th.Tensor, int], th.Tensor]:
        """
        :param condition: (B, condition_dim)
        :return: function that predicts the noise (B, dim) in x_i (B, dim) at step i, without gradient
        """
        context, times, x_weight, *layers = self.chain_inputs(condition)
        return ChainMLP(self.activation, context, times, [x_weight, *layers[0::2]], layers[1::2])

    def forward(self, x: th.Tensor, context: th.Tensor) -> th.Tensor:
        """
        :param x: (B, dim) noisy sample
        :param context: (B, H) sum of the contributions of time and condition
        :return: (B, dim) predicted noise
        """
        return self.trunk(th.addmm(context, x, self.x_weight.t()))


class DiffusionModel(nn.Module):
    """
    Conditional denoising diffusion model of a vector in [-1, 1]^dim.

    :param dim: width of the vector
    :param condition_dim: width of the condition
    :param n_steps: number N of denoising steps
    :param net_arch: hidden layers of the noise predictor
    :param activation_fn: activation function
    :param beta_schedule: see :class:`NoiseSchedule`
    :param variance_type: see :class:`NoiseSchedule`
    """

    _levels: th.Tensor

    def __init__(
        self,
        dim: int,
        condition_dim: int,
        n_steps: int,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.SiLU,
        beta_schedule: str = "vp",
        variance_type: str = "fixed_large",
    ):
        super().__init__()
        self.dim = dim
        self.schedule = NoiseSchedule(n_steps, beta_schedule, variance_type)
        self.noise_predictor = NoisePredictor(dim, condition_dim, n_steps, net_arch, activation_fn)
        levels = [self.schedule.sqrt_alphas_cumprod, self.schedule.sqrt_one_minus_alphas_cumprod]
        self.register_buffer("_levels", th.tensor(levels, dtype=th.float32), persistent=False)

    def draw_noise(self, n: int, generator: th.Generator | None = None) -> th.Tensor:
        """
        :param n: number of chains
        :param generator: random generator, the global one of the model's device if None
        :return: (N, n, dim) noise for :meth:`sample`: the start x_N, then what is injected at steps 1 to N - 1
        """
        device = self._levels.device
        if generator is not None:
            return th.randn((self.schedule.n_steps, n, self.dim), generator=generator).to(device)
        return th.randn((self.schedule.n_steps, n, self.dim), device=device)

    def sample(self, condition: th.Tensor, noise: th.Tensor | None = None, mask: th.Tensor | None = None) -> th.Tensor:
        """
        Run the whole reverse chain; gradients flow through it.

        :param condition: (B, condition_dim)
        :param noise: (N, B, dim) from :meth:`draw_noise`, drawn if None
        :param mask: (B, dim) 1 for the entries that exist, None if all do; the others stay 0
        :return: (B, dim) x_0 in [-1, 1]
        """
        if noise is None:
            noise = self.draw_noise(len(condition))
        steps, predictor = self.schedule.steps, self.noise_predictor
        if th.is_grad_enabled():
            x = DenoisingChain.apply(steps, predictor.activation, noise, mask, *predictor.chain_inputs(condition))
        else:
            x = denoise(steps, noise, mask, predictor.for_chain(condition))
        x = x.clamp(-1, 1)
        return x if mask is None else x * mask

    def q_sample(self, x_start: th.Tensor, i: th.Tensor, noise: th.Tensor) -> th.Tensor:
        """
        Forward process.

        :param x_start: (B, dim) clean samples
        :param i: (B,) indices of the steps
        :param noise: (B, dim) standard normal noise
        :return: (B, dim) x_i
        """
        signal, spread = self._levels[:, i, None]
        return signal * x_start + spread * noise

    def diffusion_loss(self, x_start: th.Tensor, condition: th.Tensor, mask: th.Tensor | None = None) -> th.Tensor:
        """
        L_d (eq. standard_diffusion_loss): mean squared error of the predicted noise at uniformly random steps.

        :param x_start: (B, dim) clean samples
        :param condition: (B, condition_dim)
        :param mask: (B, dim) 1 for the entries that exist, None if all do
        """
        i = th.randint(self.schedule.n_steps, (x_start.shape[0],), device=x_start.device)
        noise = th.randn_like(x_start)
        x = self.q_sample(x_start, i, noise)
        if mask is not None:
            x = x * mask
        predictor = self.noise_predictor
        predicted = predictor(x, predictor.condition_context(condition) + predictor.time_context()[i])
        if mask is None:
            return F.mse_loss(predicted, noise)
        return ((predicted - noise).square() * mask).sum() / mask.sum().clamp(min=1)


class DeterministicModel(nn.Module):
    """
    The ablation "without diffusion": a tanh MLP of the same trunk with the interface of :class:`DiffusionModel`.

    :param dim: width of the vector
    :param condition_dim: width of the condition
    :param net_arch: hidden layers
    :param activation_fn: activation function
    :param exploration_noise: standard deviation of the Gaussian noise on samples that are not deterministic
    """

    def __init__(
        self,
        dim: int,
        condition_dim: int,
        net_arch: list[int],
        activation_fn: type[nn.Module] = nn.SiLU,
        exploration_noise: float = 0.1,
    ):
        super().__init__()
        self.dim = dim
        self.exploration_noise = exploration_noise
        self.mlp = nn.Sequential(*create_mlp(condition_dim, dim, net_arch, activation_fn, squash_output=True))

    def draw_noise(self, n: int, generator: th.Generator | None = None) -> th.Tensor:
        """:return: (n, dim) exploration noise for :meth:`sample`, 0 if a generator asks for a repeatable sample"""
        device = next(self.parameters()).device
        if generator is not None:
            return th.zeros((n, self.dim), device=device)
        return self.exploration_noise * th.randn((n, self.dim), device=device)

    def sample(self, condition: th.Tensor, noise: th.Tensor | None = None, mask: th.Tensor | None = None) -> th.Tensor:
        """See :meth:`DiffusionModel.sample`; the noise is (B, dim)."""
        if noise is None:
            noise = self.draw_noise(len(condition))
        x = (self.mlp(condition) + noise).clamp(-1, 1)
        return x if mask is None else x * mask

    def diffusion_loss(self, x_start: th.Tensor, condition: th.Tensor, mask: th.Tensor | None = None) -> th.Tensor:
        """:return: 0, there is nothing to denoise"""
        return th.zeros((), device=condition.device)
