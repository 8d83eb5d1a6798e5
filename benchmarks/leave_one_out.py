"""
What each addition of CHDP to the published algorithm is good for: CHDP without it. ``MlpPolicy`` only. In this folder:

    sb3-chdp benchmark --gym-packages leave_one_out --algos chdp chdp_without_returns --envs HardMove6-v0 --steps 15000
"""

from typing import Any, ClassVar

import numpy as np
import torch as th
from ablations import register_ablations
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_chdp.chdp import CHDP
from sb3_chdp.chdp.candidates import Selection
from sb3_chdp.chdp.critic import HybridCritic, QNetwork
from sb3_chdp.chdp.policies import CHDPPolicy
from sb3_chdp.common.encoding import RunningRanges
from sb3_chdp.common.samples import HybridReplaySamples

Aliases = dict[str, type[BasePolicy]]


class PlainPolicy(CHDPPolicy):
    """Observations as they are."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{"features_extractor_class": FlattenExtractor, **kwargs})


class UnscaledPolicy(CHDPPolicy):
    """Values in the units of the rewards."""

    adapts_values: ClassVar[bool] = False


class UnknownRanges(RunningRanges):
    """They stay unknown: all positions are 0."""

    def update(self, obs: PyTorchObs) -> None:
        pass


class UnplacedPolicy(CHDPPolicy):
    """Critics do not see where entries of observations lie."""

    def _make_critic(self, *args: Any) -> HybridCritic:
        critic = super()._make_critic(*args)
        critic.ranges = UnknownRanges(self.observation_space)
        return critic


class UnreadingPolicy(CHDPPolicy):
    """Actions do not say what is read of the state."""

    n_reads = 0


class WideLatentsPolicy(CHDPPolicy):
    """Critics see codewords as they are."""

    def _make_critic(self, *args: Any) -> HybridCritic:
        critic = super()._make_critic(*args)
        for network in critic.modules():
            if isinstance(network, QNetwork):
                network.latent_scale.fill_(1)
        return critic


class HopefulPolicy(CHDPPolicy):
    """Random actions do not count in the values of next states."""

    random_share: ClassVar[float] = 0.0


class SingleDrawPolicy(CHDPPolicy):
    """One draw of the policies acts, and is the next action."""

    def _make_selections(self) -> tuple[Selection, Selection, Selection]:
        one = Selection(n_drawn=1)
        return one, one, one


class FarsightedPolicy(CHDPPolicy):
    """What follows a reward always counts."""

    def set_foresight(self, weight: float) -> None:
        pass


class WithoutNormalization(CHDP):
    """With :class:`PlainPolicy`."""

    policy_aliases: ClassVar[Aliases] = {"MlpPolicy": PlainPolicy}


class WithoutValueScale(CHDP):
    """With :class:`UnscaledPolicy`."""

    policy_aliases: ClassVar[Aliases] = {"MlpPolicy": UnscaledPolicy}


class WithoutPositions(CHDP):
    """With :class:`UnplacedPolicy`."""

    policy_aliases: ClassVar[Aliases] = {"MlpPolicy": UnplacedPolicy}


class WithoutReads(CHDP):
    """With :class:`UnreadingPolicy`."""

    policy_aliases: ClassVar[Aliases] = {"MlpPolicy": UnreadingPolicy}


class WithoutLatentScale(CHDP):
    """With :class:`WideLatentsPolicy`."""

    policy_aliases: ClassVar[Aliases] = {"MlpPolicy": WideLatentsPolicy}


class WithoutRandomShare(CHDP):
    """With :class:`HopefulPolicy`."""

    policy_aliases: ClassVar[Aliases] = {"MlpPolicy": HopefulPolicy}


class WithoutCandidates(CHDP):
    """With :class:`SingleDrawPolicy`."""

    policy_aliases: ClassVar[Aliases] = {"MlpPolicy": SingleDrawPolicy}


class WithoutForesight(CHDP):
    """With :class:`FarsightedPolicy`."""

    policy_aliases: ClassVar[Aliases] = {"MlpPolicy": FarsightedPolicy}


class WithoutReturns(CHDP):
    """The values of next states do not depend on what the episode has returned."""

    knows_returns: ClassVar[bool] = False


class WithoutLongReturns(CHDP):
    """Returns of one step."""

    default_buffer_classes: ClassVar[tuple[type[ReplayBuffer], type[ReplayBuffer]] | None] = None


class WithoutUniform(CHDP):
    """The continuous policy is improved for the actions of the discrete policy alone."""

    uniform_fraction: ClassVar[float] = 0.0


class WithoutLearntCodewords(CHDP):
    """The critics' loss leaves the codebook alone."""

    critics_train_codebook: ClassVar[bool] = False


class WithoutComparison(CHDP):
    """The discrete policy follows the gradient of Q at the latents that it draws, with the stored parameters (eq. 7)."""

    def _discrete_policy_loss(self, replay_data: HybridReplaySamples, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        latents, _ = self.actor.draw_latents(features, masks=replay_data.masks)
        diffusion_loss = self.actor.latent_loss(replay_data.latents, features)
        return diffusion_loss, -self.critic.score1(features, latents, replay_data.parameters).mean()


class WithoutParts(CHDP):
    """Exploratory actions are random as a whole."""

    def _exploratory_rows(
        self, rows: np.ndarray, envs: np.ndarray, rng: np.random.Generator, masks: np.ndarray | None
    ) -> np.ndarray:
        return self.policy.random_rows(rng, len(envs), None if masks is None else masks[envs])


# By name; CHDP itself has everything
LEFT_OUT: dict[str, type[CHDP]] = {
    "chdp_without_normalization": WithoutNormalization,
    "chdp_without_value_scale": WithoutValueScale,
    "chdp_without_positions": WithoutPositions,
    "chdp_without_reads": WithoutReads,
    "chdp_without_latent_scale": WithoutLatentScale,
    "chdp_without_random_share": WithoutRandomShare,
    "chdp_without_candidates": WithoutCandidates,
    "chdp_without_foresight": WithoutForesight,
    "chdp_without_returns": WithoutReturns,
    "chdp_without_long_returns": WithoutLongReturns,
    "chdp_without_uniform": WithoutUniform,
    "chdp_without_learnt_codewords": WithoutLearntCodewords,
    "chdp_without_comparison": WithoutComparison,
    "chdp_without_parts": WithoutParts,
}
register_ablations(LEFT_OUT)
