"""TD3 in the latent space of HyAR's action representation."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import FloatSchedule

from sb3_chdp.common.arguments import RATE, Accepted, of_networks, whole
from sb3_chdp.common.hybrid_box import HybridBox
from sb3_chdp.common.product_table import block_widths
from sb3_chdp.common.samples import HybridReplaySamples
from sb3_chdp.common.spaces import HybridActionSpec
from sb3_chdp.common.td3 import HybridTD3
from sb3_chdp.common.utils import gradient_step
from sb3_chdp.hyar_td3.policies import CnnPolicy, HyARTD3Policy, MlpPolicy, MultiInputPolicy
from sb3_chdp.hyar_td3.representation import ActionBatch

# Size of the sample that the latent bounds are fitted to
BOUNDS_SAMPLE = 5000


class HyARTD3(HybridTD3):
    """
    TD3 on Hybrid Action Representations (HyAR-TD3)

    Discrete actions are embedded by a table, parameters by a conditional VAE that also predicts the change of the state;
    TD3 acts in the space of both. The representation is trained on the first ``learning_starts`` steps, which are random,
    and further on all data; stored latents are checked, and replaced if they have lost their meaning.

    Paper: Li et al. (2022), https://arxiv.org/abs/2109.05490. Reference scripts: HyAR repository.

    Differences from the reference scripts:
        1. the random steps that train the representation count as ``num_timesteps``, and are learnt from by TD3 too (there
           they are extra: 5000 or 20000 episodes); one buffer serves both;
        2. the buffer holds z as it was decoded (there scaled to bounds that move on later), and the check of stored latents
           decodes that z (there the scaled one);
        3. one Adam for the representation (there a new one for every batch);
        4. relabelled z are the encoder's means (there samples); log standard deviations in [-4, 4] (there up to 15);
        5. parameters that an action does not have are no targets of the reconstruction;
        6. latent bounds have a least width;
        7. ``representation_steps`` batches after ``representation_freq`` gradient steps (there one batch per ten episodes);
        8. uniformly random actions with a decreasing probability (``exploration_*``) instead of noise that falls from 1.0
           to 0.1 (``exploration_noise=LinearSchedule(1.0, 0.1, 0.2)`` and initial and final rate 0: the scripts);
        9. plain policy gradients; ``inverting_gradients=True`` for inverted ones; no clipping of gradient norms, no
           additional update per episode.

    With n-step returns the representation predicts the change of the state over n steps. Observations other than vectors
    are represented by the features of the target critic. ``optimize_memory_usage`` is not supported.

    The parameters are those of :class:`HybridTD3`, all but the first three by keyword, and

    :param buffer_size: size of the replay buffer, which also feeds the representation
    :param learning_starts: number of random steps at first; the representation is warmed up on them
    :param target_policy_noise: standard deviation of the noise on the target latents
    :param embedding_dim: width of the embedding of a discrete action, at most that of one choice of a factored space
    :param parameter_latent_dim: width of the latent z of the parameters
    :param representation_learning_rate: learning rate of the representation
    :param representation_batch_size: its minibatch size
    :param representation_warmup_steps: its gradient steps before TD3 begins
    :param representation_freq: it is updated again before a call of ``train`` if TD3 has made so many gradient steps since
    :param representation_steps: number of its gradient steps then
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    accepted_arguments: ClassVar[dict[str, Accepted]] = {
        # Such a buffer gives the first state of the next episode for what follows the last action of one
        "optimize_memory_usage": Accepted("False, HyARTD3 needs all next states", lambda value: value in (False,)),
        "embedding_dim": of_networks(whole(1)),
        "parameter_latent_dim": of_networks(whole(1)),
        "representation_learning_rate": RATE,
        "representation_batch_size": whole(1),
        "representation_warmup_steps": whole(1),
        "representation_freq": whole(1),
        "representation_steps": whole(1),
    }
    policy: HyARTD3Policy

    def __init__(
        self,
        policy: str | type[HyARTD3Policy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        *,
        buffer_size: int = 1_000_000,  # 1e6
        learning_starts: int = 5000,
        target_policy_noise: float = 0.1,
        embedding_dim: int = 6,
        parameter_latent_dim: int = 6,
        representation_learning_rate: float | Schedule = 1e-4,
        representation_batch_size: int = 64,
        representation_warmup_steps: int = 5000,
        representation_freq: int = 500,
        representation_steps: int = 5,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ):
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            target_policy_noise=target_policy_noise,
            _init_setup_model=False,
            **kwargs,
        )
        self.embedding_dim = embedding_dim
        self.parameter_latent_dim = parameter_latent_dim
        self.representation_learning_rate = representation_learning_rate
        self.representation_batch_size = representation_batch_size
        self.representation_warmup_steps = representation_warmup_steps
        self.representation_freq = representation_freq
        self.representation_steps = representation_steps
        # Number of gradient steps of TD3 at which the representation is updated next; the first time it is warmed up
        self._next_representation_update = 0

        if _init_setup_model:
            self._setup_model()

    def _make_hybrid_space(self, action_layout: str) -> HybridBox:
        radices = HybridActionSpec(self.action_space, action_layout).radices
        latent_dim = sum(block_widths(radices, self.embedding_dim)) + self.parameter_latent_dim
        return HybridBox(self.action_space, action_layout, latent_dim, self._state_parts())

    def _network_kwargs(self) -> dict[str, Any]:
        return {**super()._network_kwargs(), "embedding_dim": self.embedding_dim}

    def _setup_model(self) -> None:
        super()._setup_model()
        self.representation_lr_schedule = FloatSchedule(self.representation_learning_rate)

    def train(self, gradient_steps: int, batch_size: int = 128) -> None:
        if self._n_updates >= self._next_representation_update:
            warm_up = self._next_representation_update == 0
            if warm_up and self.verbose >= 1:
                print(f"Learning the representation of actions for {self.representation_warmup_steps} gradient steps")
            self._train_representation(self.representation_warmup_steps if warm_up else self.representation_steps)
            self._next_representation_update = self._n_updates + self.representation_freq
        super().train(gradient_steps, batch_size)

    def _critic_loss(self, replay_data: HybridReplaySamples) -> th.Tensor:
        # To the critics, an action is the latents that stand for it under the present representation
        latents, kept = self.policy.representation.relabel(self._action_batch(replay_data), replay_data.latents)
        kept_embeddings, kept_z = kept.float().mean(dim=0).tolist()
        self.logger.record_mean("train/kept_embeddings", kept_embeddings)
        self.logger.record_mean("train/kept_parameter_latents", kept_z)
        return super()._critic_loss(replay_data._replace(actions=latents))

    def _action_batch(self, replay_data: HybridReplaySamples) -> ActionBatch:
        """:return: what the representation needs to know of a batch"""
        features = self.policy.state_features(replay_data.observations)
        changes = self.policy.state_features(replay_data.next_observations) - features
        return ActionBatch(features, replay_data.discrete_actions, replay_data.parameters, changes)

    def _sample_actions(self, batch_size: int) -> ActionBatch:
        return self._action_batch(self._sample_batch(batch_size))

    def _train_representation(self, gradient_steps: int) -> None:
        """
        Update the representation on stored transitions, and its latent bounds after that.

        :param gradient_steps: number of updates
        """
        optimizer, representation = self.policy.representation_optimizer, self.policy.representation
        self._update_own_learning_rate(optimizer, "representation_learning_rate", self.representation_lr_schedule)
        losses = []
        for _ in range(gradient_steps):
            loss = representation.loss(self._sample_actions(self.representation_batch_size))
            gradient_step(loss, [optimizer], name="representation_loss")
            losses.append(loss.item())
        representation.update_bounds(self._sample_actions(BOUNDS_SAMPLE))
        self.logger.record("train/representation_loss", np.mean(losses[-100:]))
        self.logger.record("train/representation_error", representation.usual_error.item())

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, tensors = super()._get_torch_save_params()
        return [*state_dicts, "policy.representation_optimizer"], tensors
