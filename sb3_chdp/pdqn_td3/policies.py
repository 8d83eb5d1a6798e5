"""Policies of PDQN-TD3: a parameter actor, and twin Q-networks with an output per discrete action."""

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.td3.policies import Actor
from torch import nn
from torch.nn import functional as F

from sb3_chdp.common.hybrid_box import ConcatenatedBox
from sb3_chdp.common.policies import CnnFeatures, CombinedFeatures
from sb3_chdp.common.td3 import HybridTD3Policy, InvertingGradients


class ParameterActor(Actor):
    """
    Deterministic actor x(s) of the scaled parameters of all actions, (B, P) in [-1, 1].

    The arguments are those of SB3's TD3 actor, and

    :param inverting_gradients: True: linear outputs, clamped to [-1, 1], with inverted gradients; False: tanh
    :param passthrough: ``dict(weight=..., bias=...)`` of a fixed linear function of the features that is added to the
        linear outputs, (P, features_dim) and (P,), either may be missing
    """

    passthrough_weight: th.Tensor
    passthrough_bias: th.Tensor

    def __init__(
        self,
        *args: Any,
        inverting_gradients: bool = True,
        passthrough: dict[str, Any] | None = None,
        **kwargs: Any,
    ):
        super().__init__(*args, **kwargs)
        n_parameters = get_action_dim(self.action_space)
        self.mu = nn.Sequential(*create_mlp(self.features_dim, n_parameters, self.net_arch, self.activation_fn))
        self.squash = InvertingGradients() if inverting_gradients else nn.Tanh()
        shapes = {"weight": (n_parameters, self.features_dim), "bias": (n_parameters,)}
        if not set(passthrough or {}) <= set(shapes):
            raise ValueError(f"passthrough must have no keys but {list(shapes)}, got {list(passthrough or {})}")
        for name, shape in shapes.items():
            values = th.as_tensor((passthrough or {}).get(name, th.zeros(shape)), dtype=th.float32)
            if values.shape != shape:
                raise ValueError(f"passthrough[{name!r}] must have shape {shape}, got {tuple(values.shape)}")
            self.register_buffer(f"passthrough_{name}", values)

    def forward(self, obs: PyTorchObs) -> th.Tensor:
        features = self.extract_features(obs, self.features_extractor)
        outputs = self.mu(features) + F.linear(features, self.passthrough_weight, self.passthrough_bias)
        return self.squash(outputs)


class ParameterizedQNetwork(BaseModel):
    """
    Twin networks Q(s, x) with one output per discrete action.

    PDQN shows all parameters x to every output. MP-DQN (``multi_pass``) computes output k from the parameters of action k
    alone, the others being 0, so that no Q depends on the parameters of other actions. The K passes of MP-DQN differ in
    the input to the first layer only, and only output k of pass k is needed: both are computed as such.

    :param observation_space: observation space
    :param action_space: space of the action rows
    :param net_arch: hidden layers
    :param features_extractor: network to extract features
    :param features_dim: number of features
    :param activation_fn: activation function
    :param normalize_images: whether to divide images by 255
    :param multi_pass: whether to compute the Q-values as MP-DQN
    :param share_features_extractor: whether the features extractor is the actor's, and learns from the actor's loss alone
    :raises ValueError: for ``multi_pass`` without a hidden layer
    """

    features_extractor: BaseFeaturesExtractor
    parameter_index: th.Tensor
    parameter_mask: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: ConcatenatedBox,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.ReLU,
        normalize_images: bool = True,
        multi_pass: bool = False,
        share_features_extractor: bool = False,
    ):
        super().__init__(
            observation_space, action_space, features_extractor=features_extractor, normalize_images=normalize_images
        )
        if multi_pass and not net_arch:
            raise ValueError("multi_pass=True needs at least one hidden layer in net_arch of the Q-networks, got none")
        spec = action_space.spec
        self.features_dim = features_dim
        self.multi_pass = multi_pass
        self.share_features_extractor = share_features_extractor
        self.q_networks = nn.ModuleList(
            nn.Sequential(*create_mlp(features_dim + spec.n_parameters, spec.n_discrete_actions, net_arch, activation_fn))
            for _ in range(2)
        )
        self.register_buffer("parameter_index", th.tensor(spec.parameter_index), persistent=False)
        self.register_buffer("parameter_mask", th.tensor(spec.parameter_mask, dtype=th.float32), persistent=False)

    def features(self, obs: PyTorchObs) -> th.Tensor:
        """:return: (B, features_dim) features of the observations"""
        with th.set_grad_enabled(th.is_grad_enabled() and not self.share_features_extractor):
            return self.extract_features(obs, self.features_extractor)

    def forward(self, features: th.Tensor, parameters: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param features: (B, features_dim) from :meth:`features`
        :param parameters: (B, P) parameters of all actions
        :return: (B, K) values of all actions, of both networks
        """
        q1, q2 = (self._of_all(q_net, features, parameters) for q_net in self.q_networks)
        return q1, q2

    def q1_forward(self, features: th.Tensor, parameters: th.Tensor) -> th.Tensor:
        """:return: (B, K) values of all actions, of the first network alone"""
        return self._of_all(self.q_networks[0], features, parameters)

    def of_actions(self, features: th.Tensor, parameters: th.Tensor, k: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param features: (B, features_dim)
        :param parameters: (B, P)
        :param k: (B,) discrete actions
        :return: (B, 1) values of these actions, of both networks
        """
        if self.multi_pass:
            q1, q2 = (self._multi_pass(q_net, features, parameters, k[:, None]) for q_net in self.q_networks)
        else:
            q1, q2 = (values.gather(1, k[:, None]) for values in self(features, parameters))
        return q1, q2

    def _of_all(self, q_net: nn.Module, features: th.Tensor, parameters: th.Tensor) -> th.Tensor:
        """:return: (B, K) values of all actions, of one network"""
        if not self.multi_pass:
            values: th.Tensor = q_net(th.cat([features, parameters], dim=1))
            return values
        return self._multi_pass(q_net, features, parameters, th.arange(len(self.parameter_mask), device=features.device)[None])

    def _multi_pass(self, q_net: nn.Module, features: th.Tensor, parameters: th.Tensor, k: th.Tensor) -> th.Tensor:
        """:return: (B, M) values of the (B, M) or (1, M) actions k, each computed from its own parameters, of one network"""
        columns = self.parameter_index[k]
        index = columns.flatten(1).expand(parameters.shape[0], -1)
        own_parameters = parameters.gather(1, index).view(parameters.shape[0], *columns.shape[1:]) * self.parameter_mask[k]
        first, *hidden, last = q_net.children()
        assert isinstance(first, nn.Linear) and isinstance(last, nn.Linear)
        state_part = F.linear(features, first.weight[:, : self.features_dim], first.bias)
        parameter_weights = first.weight[:, self.features_dim :].t()[columns]
        if len(k) == 1:  # the same actions for all
            parameter_part = th.einsum("bmp,mpu->bmu", own_parameters, parameter_weights[0])
        else:
            parameter_part = th.einsum("bmp,bmpu->bmu", own_parameters, parameter_weights)
        units = nn.Sequential(*hidden)(state_part[:, None] + parameter_part)
        return (units * last.weight[k]).sum(dim=2) + last.bias[k]


def mask_values(q_values: th.Tensor, masks: th.Tensor | None) -> th.Tensor:
    """:return: (B, K) values, minus infinity for discrete actions that may not be taken"""
    return q_values if masks is None else q_values.masked_fill(~masks, -th.inf)


class PDQNTD3Policy(HybridTD3Policy):
    """
    Policy class (with both actor and critic) for PDQN-TD3: k is the action of highest Q1 with the actor's parameters.

    The arguments are those of :class:`stable_baselines3.td3.policies.TD3Policy` (there are always two critics), and

    :param inverting_gradients: see :class:`ParameterActor`
    :param passthrough: see :class:`ParameterActor`
    :param multi_pass: see :class:`ParameterizedQNetwork`
    """

    action_space: ConcatenatedBox
    actor: ParameterActor
    actor_target: ParameterActor
    critic: ParameterizedQNetwork  # type: ignore[assignment]
    critic_target: ParameterizedQNetwork  # type: ignore[assignment]

    def __init__(
        self,
        *args: Any,
        inverting_gradients: bool = True,
        passthrough: dict[str, Any] | None = None,
        multi_pass: bool = False,
        **kwargs: Any,
    ):
        self.passthrough = passthrough
        self.multi_pass = multi_pass
        super().__init__(*args, inverting_gradients=inverting_gradients, **kwargs)

    def _build(self, lr_schedule: Schedule) -> None:
        spec = self.action_space.spec
        self.actor_kwargs["action_space"] = spaces.Box(-1.0, 1.0, (spec.n_parameters,))
        super()._build(lr_schedule)

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> ParameterActor:
        actor_kwargs = self._update_features_extractor(self.actor_kwargs, features_extractor)
        return ParameterActor(**actor_kwargs, inverting_gradients=self.inverting_gradients, passthrough=self.passthrough).to(
            self.device
        )

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        critic_kwargs = self._update_features_extractor(self.critic_kwargs, features_extractor)
        n_critics = critic_kwargs.pop("n_critics")
        if n_critics != 2:
            raise ValueError(f"n_critics must be 2 for PDQN-TD3, got {n_critics}")
        return ParameterizedQNetwork(**critic_kwargs, multi_pass=self.multi_pass).to(self.device)

    def _predict(
        self, observation: PyTorchObs, deterministic: bool = False, action_masks: th.Tensor | None = None
    ) -> th.Tensor:
        parameters = self.actor(observation)
        q1 = self.critic.q1_forward(self.critic.features(observation), parameters)
        k = mask_values(q1, action_masks).argmax(dim=1)
        return self.action_space.columns.pack(discrete_actions=k, parameters=parameters)

    def mask_outputs(self, outputs: th.Tensor, action_masks: th.Tensor | None) -> th.Tensor:
        """:return: the outputs, parameters that leave the choice to the Q-networks"""
        return outputs

    def _noisy_rows(self, obs: PyTorchObs, noise: th.Tensor, action_masks: th.Tensor | None) -> th.Tensor:
        rows = self._predict(obs, action_masks=action_masks)
        # k is the best action for the parameters without noise
        parameters = self.action_space.columns.view(rows, "parameters")
        parameters.add_(noise).clamp_(-1, 1)
        return rows

    def _get_constructor_parameters(self) -> dict[str, Any]:
        own = dict(passthrough=self.passthrough, multi_pass=self.multi_pass)
        return {**super()._get_constructor_parameters(), **own}


MlpPolicy = PDQNTD3Policy


class CnnPolicy(CnnFeatures, PDQNTD3Policy):
    """:class:`PDQNTD3Policy` for images."""


class MultiInputPolicy(CombinedFeatures, PDQNTD3Policy):
    """:class:`PDQNTD3Policy` for dict observations."""
