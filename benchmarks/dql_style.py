"""
The chains of CHDP as the public Diffusion Q-learning code writes them, to measure against.

The networks are those of that code: sinusoidal time embedding and its MLP in every step, one concatenated input, Mish; the
constants of a step are gathered per row. Losses, critics and optimizers are CHDP's own.
"""

import math
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from torch import nn
from torch.nn import functional as F

from sb3_chdp import CHDP
from sb3_chdp.chdp.diffusion import NoiseSchedule
from sb3_chdp.chdp.policies import CHDPPolicy

TIME_DIM = 16


class SinusoidalEmbedding(nn.Module):
    def forward(self, t: th.Tensor) -> th.Tensor:
        half = TIME_DIM // 2
        frequencies = th.exp(th.arange(half, device=t.device) * -(math.log(10_000) / (half - 1)))
        angles = t[:, None] * frequencies[None, :]
        return th.cat((angles.sin(), angles.cos()), dim=-1)


def extract(values: th.Tensor, t: th.Tensor, x: th.Tensor) -> th.Tensor:
    """:return: (B, 1, ...) the constant of every row's step"""
    return values.gather(-1, t).reshape(t.shape[0], *((1,) * (x.ndim - 1)))


class DQLDiffusion(nn.Module):
    """
    The interface of :class:`sb3_chdp.chdp.diffusion.DiffusionModel`.

    :param dim: width of the vector
    :param condition_dim: width of the condition
    :param n_steps: number N of denoising steps
    :param net_arch: hidden layers
    :param activation_fn: activation function
    """

    def __init__(self, dim: int, condition_dim: int, n_steps: int, net_arch: list[int], activation_fn: type[nn.Module]):
        super().__init__()
        self.dim, self.n_steps = dim, n_steps
        self.time_mlp = nn.Sequential(
            SinusoidalEmbedding(), nn.Linear(TIME_DIM, 2 * TIME_DIM), activation_fn(), nn.Linear(2 * TIME_DIM, TIME_DIM)
        )
        layers: list[nn.Module] = []
        width = dim + TIME_DIM + condition_dim
        for units in net_arch:
            layers += [nn.Linear(width, units), activation_fn()]
            width = units
        self.mid_layer, self.final_layer = nn.Sequential(*layers), nn.Linear(width, dim)
        schedule = NoiseSchedule(n_steps)
        for name in (
            "sqrt_alphas_cumprod",
            "sqrt_one_minus_alphas_cumprod",
            "sqrt_recip_alphas_cumprod",
            "sqrt_recipm1_alphas_cumprod",
            "posterior_mean_coef1",
            "posterior_mean_coef2",
            "sigmas",
        ):
            self.register_buffer(name, th.tensor(getattr(schedule, name), dtype=th.float32), persistent=False)

    def predict_noise(self, x: th.Tensor, t: th.Tensor, condition: th.Tensor) -> th.Tensor:
        return self.final_layer(self.mid_layer(th.cat([x, self.time_mlp(t.float() + 1), condition], dim=1)))

    def draw_noise(self, n: int, generator: th.Generator | None = None) -> th.Tensor:
        return th.randn((self.n_steps, n, self.dim), generator=generator)

    def sample(self, condition: th.Tensor, noise: th.Tensor | None = None, mask: th.Tensor | None = None) -> th.Tensor:
        batch_size = len(condition)
        x = th.randn((batch_size, self.dim)) if noise is None else noise[0]
        for i in reversed(range(self.n_steps)):
            t = th.full((batch_size,), i, dtype=th.long)
            predicted = self.predict_noise(x, t, condition)
            x_recon = extract(self.sqrt_recip_alphas_cumprod, t, x) * x
            x_recon = (x_recon - extract(self.sqrt_recipm1_alphas_cumprod, t, x) * predicted).clamp(-1, 1)
            mean = extract(self.posterior_mean_coef1, t, x) * x_recon + extract(self.posterior_mean_coef2, t, x) * x
            injected = th.randn_like(x) if noise is None else noise[i]
            nonzero = (1 - (t == 0).float()).reshape(batch_size, *((1,) * (x.ndim - 1)))
            x = mean + nonzero * extract(self.sigmas, t, x) * injected
        return x.clamp(-1, 1)

    def diffusion_loss(self, x_start: th.Tensor, condition: th.Tensor, mask: th.Tensor | None = None) -> th.Tensor:
        t = th.randint(0, self.n_steps, (len(x_start),))
        noise = th.randn_like(x_start)
        x = extract(self.sqrt_alphas_cumprod, t, x_start) * x_start
        x = x + extract(self.sqrt_one_minus_alphas_cumprod, t, x_start) * noise
        return F.mse_loss(self.predict_noise(x, t, condition), noise)


class DQLStylePolicy(CHDPPolicy):
    """CHDP's policy with the chains of Diffusion Q-learning."""

    def _make_model(self, dim: int, condition_dim: int, net_arch: list[int]) -> Any:
        return DQLDiffusion(dim, condition_dim, self.n_diffusion_steps, net_arch, self.activation_fn)


class DQLStyleCHDP(CHDP):
    """CHDP with the chains of Diffusion Q-learning; for actions without padding."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MlpPolicy": DQLStylePolicy}
