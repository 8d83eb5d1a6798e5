"""The twin critic of CHDP."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import ContinuousCritic
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_chdp.common.checks import check_at_least


def chebyshev_features(x: th.Tensor, degree: int) -> th.Tensor:
    """
    Chebyshev polynomials T_1 to T_degree of every entry. The slope of T_n is n^2 at -1 and 1, and up to about n in between:
    they tell apart values that are close to each other, best near the bounds.

    :param x: (B, n) values in [-1, 1]
    :param degree: highest degree, at least 1
    :return: (B, n * degree) values in [-1, 1], those of degree 1, x itself, first
    """
    polynomials = [th.ones_like(x), x]
    for _ in range(degree - 1):
        polynomials.append(2 * x * polynomials[-1] - polynomials[-2])
    return th.cat(polynomials[1:], dim=1) if degree > 1 else x


class HybridCritic(ContinuousCritic):
    """
    SB3's twin critic Q(s, latent, parameters), with the features of the state computed once for several calls.

    :param observation_space: observation space
    :param latent_dim: width of the latent
    :param n_parameters: number of parameters
    :param net_arch: hidden layers
    :param features_extractor: network to extract features
    :param features_dim: number of features
    :param activation_fn: activation function
    :param normalize_images: whether to divide images by 255
    :param layer_norm: whether every hidden layer is followed by layer normalisation, which bounds Q where there is no data
        (Ball et al., 2023)
    :param parameter_degree: highest degree of the Chebyshev polynomials of the parameters that the networks see, see
        :func:`chebyshev_features`
    :param bilinear: whether the networks see the products of all entries of the latent with all parameters as well: what a
        parameter does depends on the discrete action, often by a factor
    :raises ValueError: if ``parameter_degree`` is less than 1
    """

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        latent_dim: int,
        n_parameters: int,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.ReLU,
        normalize_images: bool = True,
        layer_norm: bool = False,
        parameter_degree: int = 1,
        bilinear: bool = False,
    ):
        check_at_least(1, parameter_degree=parameter_degree)
        action_dim = latent_dim + n_parameters * (parameter_degree + latent_dim * bilinear)
        super().__init__(
            observation_space,
            spaces.Box(-np.inf, np.inf, (action_dim,)),
            net_arch,
            features_extractor,
            features_dim,
            activation_fn=activation_fn,
            normalize_images=normalize_images,
            n_critics=2,
            share_features_extractor=False,
        )
        self.parameter_degree = parameter_degree
        self.bilinear = bilinear
        if layer_norm:
            for i in range(self.n_critics):
                modules: list[type[nn.Module]] = [nn.LayerNorm]
                q_net = create_mlp(features_dim + action_dim, 1, net_arch, activation_fn, post_linear_modules=modules)
                self.q_networks[i] = nn.Sequential(*q_net)
                self.add_module(f"qf{i}", self.q_networks[i])

    def features(self, obs: PyTorchObs) -> th.Tensor:
        """:return: (B, features_dim) features of the observations"""
        return self.extract_features(obs, self.features_extractor)

    def _q_input(self, features: th.Tensor, latents: th.Tensor, parameters: th.Tensor) -> th.Tensor:
        parts = [features, latents, chebyshev_features(parameters, self.parameter_degree)]
        if self.bilinear:
            parts.append((latents[:, :, None] * parameters[:, None, :]).flatten(1))
        return th.cat(parts, dim=1)

    def q_values(self, features: th.Tensor, latents: th.Tensor, parameters: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param features: (B, features_dim) from :meth:`features`
        :param latents: (B, latent_dim)
        :param parameters: (B, n_parameters) scaled parameters
        :return: Q1 and Q2, each (B, 1)
        """
        q_input = self._q_input(features, latents, parameters)
        q1, q2 = (q_net(q_input) for q_net in self.q_networks)
        return q1, q2

    def q1_values(self, features: th.Tensor, latents: th.Tensor, parameters: th.Tensor) -> th.Tensor:
        """:return: (B, 1) Q1 alone, see :meth:`q_values`"""
        return self.q_networks[0](self._q_input(features, latents, parameters))
