"""Parametrised deep Q-network with TD3, and its multi-pass variant."""

from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, Schedule
from stable_baselines3.common.utils import FloatSchedule

from sb3_chdp.common.arguments import A_DICT, RATE, SWITCH, Accepted, of_networks, optional
from sb3_chdp.common.hybrid_box import ConcatenatedBox, HybridBox
from sb3_chdp.common.samples import HybridReplaySamples
from sb3_chdp.common.td3 import HybridTD3
from sb3_chdp.pdqn_td3.policies import (
    CnnPolicy,
    MlpPolicy,
    MultiInputPolicy,
    ParameterizedQNetwork,
    PDQNTD3Policy,
    mask_values,
)


class PDQNTD3(HybridTD3):
    """
    Parametrised Deep Q-Network with TD3 (PDQN-TD3) and, with ``multi_pass=True``, MP-DQN-TD3

    An actor gives the parameters of all discrete actions; Q-networks that see them all score every action, and the
    action of highest Q1 is taken. The Q-networks learn by Q-learning, the actor ascends the sum of Q1 over all actions.

    Papers: Xiong et al. (2018), https://arxiv.org/abs/1810.06394 (PDQN); Bester et al. (2019),
    https://arxiv.org/abs/1905.04388 (MP-DQN); Fujimoto et al. (2018), https://arxiv.org/abs/1802.09477 (TD3).
    Reference scripts: HyAR repository.

    Differences from the reference scripts:
        1. two independent Q-networks (there the second one ends in the first one's output layer);
        2. target max_k min_i Q_i instead of min_i max_k Q_i, with target smoothing (``target_policy_noise=0``: none) and
           delayed updates of actor and targets (``policy_delay=1``: every time);
        3. one ``tau`` of 0.005 for both targets;
        4. exploring steps draw k and all parameters uniformly, others have Gaussian noise on the parameters (there noise
           of standard deviation 2e-4 is all the exploration that the parameters get);
        5. the exploration rate falls over a fraction of the training instead of 1000 episodes;
        6. parameters are clamped to [-1, 1] before the environment and the replay buffer see them;
        7. no expert prior: ``passthrough`` of the actor is None unless it is given;
        8. no clipping of gradient norms;
        9. the K passes of ``multi_pass`` share what they have in common; the values are the same.

    The parameters are those of :class:`HybridTD3`, all but the first three by keyword, and

    :param gamma: the discount factor
    :param actor_learning_rate: learning rate of the actor; ``learning_rate`` is the one of the Q-networks
    :param inverting_gradients: True: the actor's outputs are linear and clamped to [-1, 1], with inverted gradients;
        False: tanh and plain gradients
    :param multi_pass: whether Q of an action sees the parameters of that action only (MP-DQN)
    :param passthrough: ``dict(weight=..., bias=...)`` of a fixed linear function of the observation that is added to the
        actor's outputs, see :class:`sb3_chdp.pdqn_td3.policies.ParameterActor`
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    accepted_arguments: ClassVar[dict[str, Accepted]] = {
        "actor_learning_rate": RATE,
        "multi_pass": of_networks(SWITCH),
        "passthrough": of_networks(optional(A_DICT)),
    }
    policy: PDQNTD3Policy
    critic: ParameterizedQNetwork
    critic_target: ParameterizedQNetwork
    takes_factored = False

    def __init__(
        self,
        policy: str | type[PDQNTD3Policy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-3,
        *,
        actor_learning_rate: float | Schedule = 1e-4,
        gamma: float = 0.95,
        inverting_gradients: bool = True,
        multi_pass: bool = False,
        passthrough: dict[str, Any] | None = None,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ):
        super().__init__(
            policy,
            env,
            learning_rate,
            gamma=gamma,
            inverting_gradients=inverting_gradients,
            _init_setup_model=False,
            **kwargs,
        )
        self.actor_learning_rate = actor_learning_rate
        self.multi_pass = multi_pass
        self.passthrough = passthrough

        if _init_setup_model:
            self._setup_model()

    def _make_hybrid_space(self, action_layout: str) -> HybridBox:
        return ConcatenatedBox(self.action_space, action_layout, self._state_parts())

    def _network_kwargs(self) -> dict[str, Any]:
        return {**super()._network_kwargs(), "multi_pass": self.multi_pass, "passthrough": self.passthrough}

    def _setup_model(self) -> None:
        super()._setup_model()
        self.actor_lr_schedule = FloatSchedule(self.actor_learning_rate)

    def _update_learning_rates(self) -> None:
        self._update_learning_rate(self.critic.optimizer)
        self._update_own_learning_rate(self.actor.optimizer, "actor_learning_rate", self.actor_lr_schedule)

    def _next_q_values(self, next_obs: PyTorchObs, next_masks: th.Tensor | None) -> th.Tensor:
        """:return: (B, 1) max_k min_i Q_i(s', x(s') + noise)_k of the targets, k over the allowed actions"""
        next_parameters = self._smoothed_target_actions(next_obs, next_masks)
        q1, q2 = self.critic_target(self.critic_target.features(next_obs), next_parameters)
        return mask_values(th.min(q1, q2), next_masks).max(dim=1, keepdim=True).values

    def _current_q_values(self, replay_data: HybridReplaySamples) -> tuple[th.Tensor, ...]:
        features = self.critic.features(replay_data.observations)
        return self.critic.of_actions(features, replay_data.parameters, replay_data.discrete_actions)

    def _actor_loss(self, replay_data: HybridReplaySamples) -> th.Tensor:
        """:return: the negative sum of Q1 over all allowed discrete actions, with the actor's parameters"""
        with th.no_grad():
            features = self.critic.features(replay_data.observations)
        q1 = self.critic.q1_forward(features, self.actor(replay_data.observations))
        return -(q1 if replay_data.masks is None else q1 * replay_data.masks).sum(dim=1).mean()
