"""The twin critic of CHDP, and a network of the reward alone."""

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_chdp.common.encoding import RunningRanges, n_bins_of, ramps
from sb3_chdp.common.normalization import RunningNormalization

# Factor of the logits, which start small
SHARPNESS = 3.0
# On a processor, softmax over fewer entries is faster where they do not lie side by side
SLOW_SOFTMAX = 16
# Length of a choice's codeword for A at most; its entries are in [-1, 1]
LATENT_NORM = 2.0


class AttentionReads(nn.Module):
    """
    What a latent e reads of the features x: ``n_reads`` means of their entries, weighted by softmax(3 (W_j e + b_j)).

    A discrete action often concerns a part of the state, its channel or its product. An MLP on [x, e] has to learn for each
    action which part that is, and hardly carries it over to new states; attention picks entries out.

    :param n_inputs: width of x
    :param latent_dim: width of the latent
    :param n_reads: number of reads
    """

    def __init__(self, n_inputs: int, latent_dim: int, n_reads: int):
        super().__init__()
        self.n_inputs, self.n_reads = n_inputs, n_reads
        self.logits = nn.Linear(latent_dim, n_reads * n_inputs)

    def forward(self, x: th.Tensor, latents: th.Tensor) -> th.Tensor:
        """
        :param x: (B, n_inputs)
        :param latents: (B, latent_dim)
        :return: (B, n_reads)
        """
        logits = SHARPNESS * self.logits(latents).unflatten(1, (self.n_reads, self.n_inputs))
        if self.n_inputs < SLOW_SOFTMAX:
            weights = logits.transpose(1, 2).contiguous().softmax(dim=1).transpose(1, 2)
        else:
            weights = logits.softmax(dim=2)
        return th.bmm(weights, x[:, :, None]).squeeze(2)


def value_mlp(n_inputs: int, net_arch: list[int], activation_fn: type[nn.Module]) -> nn.Sequential:
    """:return: MLP with one output, and layer normalisation before the activation of its last hidden layer"""
    layers = create_mlp(n_inputs, -1, net_arch, activation_fn)
    if net_arch:
        layers.insert(-1, nn.LayerNorm(net_arch[-1]))
    return nn.Sequential(*layers, nn.Linear([n_inputs, *net_arch][-1], 1))


class QNetwork(nn.Module):
    """
    Q(s, e, a) = V(s) + A(s, e, a) for the latent e and the parameters a.

    The last hidden layers are normalised, which bounds Q where there is no data (Ball et al., 2023), not the ones before,
    which would lose how large their inputs are.

    A sees what the latent reads of the features, see :class:`AttentionReads`, and the products of all its entries with all
    parameters: what a parameter does depends on the discrete action, often by a factor. V sees where entries of the
    observation lie, see :func:`ramps`. V and A are not told apart further: V learns what does not depend on the action (as in
    Wang et al., 2016).

    Wide codewords are scaled down for A: with their products they would outweigh the features.

    :param features_dim: number of features of the state
    :param n_positions: number of entries of the observation whose positions stand behind the features
    :param latent_widths: (latent_dim,) how wide the codeword is that an entry of the latent belongs to
    :param n_parameters: number of parameters
    :param net_arch: hidden layers of A; V has one of half the width of the first
    :param activation_fn: activation function
    :param n_reads: number of reads, 0: none
    """

    latent_scale: th.Tensor

    def __init__(
        self,
        features_dim: int,
        n_positions: int,
        latent_widths: th.Tensor,
        n_parameters: int,
        net_arch: list[int],
        activation_fn: type[nn.Module],
        n_reads: int,
    ):
        super().__init__()
        self.features_dim, self.n_bins, latent_dim = features_dim, n_bins_of(n_positions), len(latent_widths)
        self.register_buffer("latent_scale", (LATENT_NORM / latent_widths.sqrt()).clamp(max=1), persistent=False)
        self.reads = AttentionReads(features_dim, latent_dim, n_reads) if n_reads else None
        value_arch = [width // 2 for width in net_arch[:1]]
        self.value = value_mlp(features_dim + self.n_bins * n_positions, value_arch, activation_fn)
        n_inputs = features_dim + n_parameters + latent_dim + n_reads + latent_dim * n_parameters
        self.advantage = value_mlp(n_inputs, net_arch, activation_fn)

    def forward(self, features: th.Tensor, latents: th.Tensor, parameters: th.Tensor) -> th.Tensor:
        """:return: (B * n, 1) values"""
        features, positions = features.split([self.features_dim, features.shape[1] - self.features_dim], dim=1)
        values = self.value(th.cat([features, ramps(positions, self.n_bins)], dim=1))
        n = latents.shape[0] // features.shape[0]
        if n > 1:
            features, values = features.repeat_interleave(n, dim=0), values.repeat_interleave(n, dim=0)
        reads = [] if self.reads is None else [self.reads(features, latents)]
        latents = self.latent_scale * latents
        products = (latents[:, :, None] * parameters[:, None]).flatten(1)
        return values + self.advantage(th.cat([features, parameters, latents, *reads, products], dim=1))

    @th.no_grad()
    def rescale(self, factor: th.Tensor, summand: th.Tensor) -> None:
        """Multiply the values by a factor and add a number."""
        for parameter in (*self.value[-1].parameters(), *self.advantage[-1].parameters()):
            parameter.mul_(factor)
        *_, bias = self.value[-1].parameters()
        bias.add_(summand)


class ReturnNetwork(nn.Module):
    """
    What the return of the episode before an action adds to the action's value, nothing at first: targets may know more than
    the policies do (as the critic of Pinto et al., 2017).

    Rewards often depend on what observations do not show, a bonus that is paid once per episode, say. Q is an average over
    both cases. In targets it makes going back look as if it earned the bonus once more.

    :param features_dim: number of features of the state
    :param args: further arguments of :class:`QNetwork`
    """

    def __init__(self, features_dim: int, *args: Any):
        super().__init__()
        self.normalization = RunningNormalization(1)
        self.network = QNetwork(features_dim + 1, *args)
        for parameter in (*self.network.value[-1].parameters(), *self.network.advantage[-1].parameters()):
            nn.init.zeros_(parameter)

    def forward(self, features: th.Tensor, latents: th.Tensor, parameters: th.Tensor, returns: th.Tensor) -> th.Tensor:
        """
        :param features: (B, features_dim + n_positions)
        :param latents: (B, latent_dim)
        :param parameters: (B, n_parameters) scaled parameters
        :param returns: (B, 1) sum of the episode's rewards before the action
        :return: (B, 1) summands, in the units of the critics
        """
        return self.network(th.cat([self.normalization(returns), features], dim=1), latents, parameters)


class HybridCritic(BaseModel):
    """
    Twin critic Q(s, latent, parameters), with the features of the state computed once for several calls.

    :param observation_space: observation space
    :param action_space: space of the action rows
    :param features_extractor: network to extract features
    :param q_networks: two networks of features, latents and parameters
    :param reward_network: such a network of the reward alone, for foresight below 1; None: foresight is always 1
    :param return_network: what returns add to the values; None: nothing
    :param ranges: where entries of observations lie; None: networks do not see it
    :param normalize_images: whether to divide images by 255

    :ivar foresight: weight in [0, 1] of what follows a reward in the choice of actions
    """

    features_extractor: BaseFeaturesExtractor
    optimizer: th.optim.Optimizer
    reward_network: nn.Module | None
    return_network: ReturnNetwork | None
    ranges: RunningRanges | None

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        features_extractor: BaseFeaturesExtractor,
        q_networks: list[nn.Module],
        reward_network: nn.Module | None = None,
        return_network: ReturnNetwork | None = None,
        ranges: RunningRanges | None = None,
        normalize_images: bool = True,
    ):
        super().__init__(
            observation_space, action_space, features_extractor=features_extractor, normalize_images=normalize_images
        )
        self.q_networks = nn.ModuleList(q_networks)
        self.reward_network = reward_network
        self.return_network = return_network
        self.ranges = ranges
        self.foresight = 1.0

    def features(self, obs: PyTorchObs) -> th.Tensor:
        """
        :param obs: (B, ...) observations, which ranges count in training mode
        :return: (B, features_dim + n_positions) their features, and where their entries lie
        """
        features = self.extract_features(obs, self.features_extractor)
        if self.ranges is None:
            return features
        if self.training:
            self.ranges.update(obs)
        return th.cat([features, self.ranges(obs)], dim=1)

    def q_values(self, features: th.Tensor, latents: th.Tensor, parameters: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param features: (B, ...) from :meth:`features`
        :param latents: (B * n, latent_dim), of n actions for each of the observations
        :param parameters: (B * n, n_parameters) scaled parameters
        :return: Q1 and Q2, each (B * n, 1), in the units of :class:`ValueScale`
        """
        q1, q2 = (q_net(features, latents, parameters) for q_net in self.q_networks)
        return q1, q2

    def scores(self, features: th.Tensor, latents: th.Tensor, parameters: th.Tensor) -> tuple[th.Tensor, ...]:
        """
        :return: what decides between actions, each (B * n, 1): :meth:`q_values`, with what follows the reward weighted
        """
        return self.weigh(self.q_values(features, latents, parameters), features, latents, parameters)

    def score1(self, features: th.Tensor, latents: th.Tensor, parameters: th.Tensor) -> th.Tensor:
        """:return: (B * n, 1) the first of :meth:`scores` alone"""
        return self.weigh((self.q_networks[0](features, latents, parameters),), features, latents, parameters)[0]

    def weigh(
        self, q_values: tuple[th.Tensor, ...], features: th.Tensor, latents: th.Tensor, parameters: th.Tensor
    ) -> tuple[th.Tensor, ...]:
        """:return: r + foresight (Q - r) for each of the values, r from the reward network"""
        if self.foresight == 1 or self.reward_network is None:
            return q_values
        rewards = self.reward_network(features, latents, parameters)
        return tuple(th.lerp(rewards, q, self.foresight) for q in q_values)

    def rescale(self, factor: th.Tensor, summands: th.Tensor) -> None:
        """Multiply the outputs by a factor and add numbers to values and rewards."""
        for network, summand in zip([*self.q_networks, self.reward_network], summands[[0, 0, 1]], strict=True):
            assert isinstance(network, QNetwork)
            network.rescale(factor, summand)
        if self.return_network is not None:
            self.return_network.network.rescale(factor, summands.new_zeros(()))

    def get_extra_state(self) -> th.Tensor:
        return th.tensor(self.foresight, dtype=th.float64)

    def set_extra_state(self, state: th.Tensor) -> None:
        self.foresight = state.item()
