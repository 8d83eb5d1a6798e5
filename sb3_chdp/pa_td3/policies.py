"""Policies of PA-TD3: an MLP with a tanh output of K scores and P parameters."""

from sb3_chdp.common.policies import CnnFeatures, CombinedFeatures
from sb3_chdp.common.td3 import HybridTD3Policy


class PATD3Policy(HybridTD3Policy):
    """
    Policy class (with both actor and critic) for PA-TD3: what the actor puts out are rows of scores and parameters.

    The arguments are those of :class:`HybridTD3Policy`.
    """


MlpPolicy = PATD3Policy


class CnnPolicy(CnnFeatures, PATD3Policy):
    """:class:`PATD3Policy` for images."""


class MultiInputPolicy(CombinedFeatures, PATD3Policy):
    """:class:`PATD3Policy` for dict observations."""
