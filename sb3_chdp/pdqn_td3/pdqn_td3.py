"""Parametrised deep Q-network with TD3, and its multi-pass variant."""

from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, ReplayBufferSamples, Schedule
from stable_baselines3.common.utils import FloatSchedule, update_learning_rate
from torch.nn import functional as F

from sb3_chdp.common.hybrid_box import ConcatenatedBox, HybridBox
from sb3_chdp.common.td3 import HybridTD3
from sb3_chdp.common.utils import TargetUpdate
from sb3_chdp.pdqn_td3.policies import (
    CnnPolicy,
    MlpPolicy,
    MultiInputPolicy,
    ParameterActor,
    ParameterizedQNetwork,
    PDQNTD3Policy,
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
        actor's outputs, see :class:`ParameterActor`
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy: PDQNTD3Policy  # type: ignore[assignment]
    actor: ParameterActor
    actor_target: ParameterActor
    critic: ParameterizedQNetwork  # type: ignore[assignment]
    critic_target: ParameterizedQNetwork  # type: ignore[assignment]

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

    def _make_hybrid_space(self) -> HybridBox:
        return ConcatenatedBox(self.action_space, self.action_layout)

    def _network_kwargs(self) -> dict[str, Any]:
        return {**super()._network_kwargs(), "multi_pass": self.multi_pass, "passthrough": self.passthrough}

    def _setup_model(self) -> None:
        super()._setup_model()
        self.actor_lr_schedule = FloatSchedule(self.actor_learning_rate)
        self.update_targets = TargetUpdate([self.actor, self.critic], [self.actor_target, self.critic_target])

    def train(self, gradient_steps: int, batch_size: int = 128) -> None:
        # Switch to train mode (this affects batch norm / dropout)
        self.policy.set_training_mode(True)
        # Update learning rates according to their schedules
        self._update_learning_rate(self.critic.optimizer)
        actor_learning_rate = self.actor_lr_schedule(self._current_progress_remaining)
        update_learning_rate(self.actor.optimizer, actor_learning_rate)

        critic_losses, actor_losses = [], []
        for _ in range(gradient_steps):
            self._n_updates += 1
            assert self.replay_buffer is not None
            replay_data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)

            critic_loss = self._critic_loss(replay_data)
            critic_losses.append(critic_loss.detach())
            self.critic.optimizer.zero_grad()
            critic_loss.backward()
            self.critic.optimizer.step()

            # Delayed policy updates
            if self._n_updates % self.policy_delay == 0:
                actor_loss = self._actor_loss(replay_data)
                actor_losses.append(actor_loss.detach())
                self.actor.optimizer.zero_grad()
                actor_loss.backward()
                self.actor.optimizer.step()

                self.update_targets(self.tau)

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/actor_learning_rate", actor_learning_rate)
        self.logger.record("train/critic_loss", th.stack(critic_losses).mean().item())
        if actor_losses:
            self.logger.record("train/actor_loss", th.stack(actor_losses).mean().item())

    def _critic_loss(self, replay_data: ReplayBufferSamples) -> th.Tensor:
        """Squared Bellman errors of both Q-networks, with the target max_k min_i Q_i(s', x(s') + noise)_k."""
        discounts = self.gamma if replay_data.discounts is None else replay_data.discounts
        with th.no_grad():
            # Parameters according to the target actor, with clipped noise
            next_parameters = self.actor_target(replay_data.next_observations)
            noise = th.randn_like(next_parameters) * self.target_policy_noise
            noise = noise.clamp(-self.target_noise_clip, self.target_noise_clip)
            next_parameters = (next_parameters + noise).clamp(-1, 1)
            next_features = self.critic_target.features(replay_data.next_observations)
            next_q_values = th.min(*self.critic_target(next_features, next_parameters)).max(dim=1, keepdim=True)[0]
            target_q_values = replay_data.rewards + (1 - replay_data.dones) * discounts * next_q_values
        k, parameters = replay_data.actions[:, 0].long(), replay_data.actions[:, 1:]
        q1, q2 = self.critic.of_actions(self.critic.features(replay_data.observations), parameters, k)
        return F.mse_loss(q1, target_q_values) + F.mse_loss(q2, target_q_values)

    def _actor_loss(self, replay_data: ReplayBufferSamples) -> th.Tensor:
        """The negative sum of Q1 over all discrete actions, with the actor's parameters."""
        with th.no_grad():
            features = self.critic.features(replay_data.observations)
        q1, _ = self.critic(features, self.actor(replay_data.observations))
        return -q1.sum(dim=1).mean()

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "update_targets"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "actor.optimizer", "critic.optimizer"], []
