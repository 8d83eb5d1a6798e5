"""What the replay buffer returns, with the columns of its rows named."""

from typing import NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs, ReplayBufferSamples

from sb3_chdp.common.buffers import Index, PrioritizedReplayBufferSamples
from sb3_chdp.common.hybrid_box import HybridBox
from sb3_chdp.common.rows import MASK_PARTS
from sb3_chdp.common.watkins_buffer import WatkinsReplayBufferSamples


class HybridReplaySamples(NamedTuple):
    """
    A batch with the columns of its action rows named.

    Shapes: actions (B, columns), the rows without masks and returns; of these discrete_actions (B,) int64, parameters
    (B, Pmax) in [-1, 1] with padding 0, or (B, P) those of all actions, latents (B, latent_dim), which may be 0 columns;
    rewards, dones, and with n-step returns discounts (B, 1); weights (B, 1) of a prioritised buffer and indices, where it
    stores them; masks and next_masks (B, K) boolean, which discrete actions the environment allowed in the state and in the
    next one, None without masking; returns and next_returns (B, 1), the sum of the episode's rewards before the action and
    with its reward, None if rows hold none; first_rewards, next_actions and next_indices are those of a
    :class:`WatkinsReplayBuffer`. In a factored space discrete_actions are (B, L) and masks (B, sum of the radices).
    """

    observations: PyTorchObs
    actions: th.Tensor
    discrete_actions: th.Tensor
    parameters: th.Tensor
    latents: th.Tensor
    next_observations: PyTorchObs
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor | float
    weights: th.Tensor | float = 1.0
    indices: Index | None = None
    masks: th.Tensor | None = None
    next_masks: th.Tensor | None = None
    returns: th.Tensor | None = None
    next_returns: th.Tensor | None = None
    first_rewards: th.Tensor | None = None
    next_actions: th.Tensor | None = None
    next_indices: Index | None = None


def name_columns(
    replay_data: ReplayBufferSamples | PrioritizedReplayBufferSamples | WatkinsReplayBufferSamples,
    action_space: HybridBox,
    gamma: float,
) -> HybridReplaySamples:
    """
    :param replay_data: what ``ReplayBuffer.sample`` returned
    :param action_space: the space of the stored rows
    :param gamma: discount factor, used if the buffer gives none (n-step buffers do)
    """
    columns, rows = action_space.columns, replay_data.actions
    return HybridReplaySamples(
        observations=replay_data.observations,
        actions=rows[:, : columns.action_width],
        discrete_actions=columns.discrete_actions(rows),
        parameters=columns.view(rows, "parameters"),
        latents=columns.view(rows, "latents") if "latents" in columns else rows[:, :0],
        next_observations=replay_data.next_observations,
        dones=replay_data.dones,
        rewards=replay_data.rewards,
        discounts=gamma if replay_data.discounts is None else replay_data.discounts,
        weights=getattr(replay_data, "weights", 1.0),
        indices=getattr(replay_data, "indices", None),
        first_rewards=getattr(replay_data, "first_rewards", None),
        next_actions=getattr(replay_data, "next_actions", None),
        next_indices=getattr(replay_data, "next_indices", None),
        **{
            name: columns.masks(rows, name) if name in MASK_PARTS else columns.view(rows, name)
            for name in action_space.state_parts
        },
    )
