"""Policies of PA-TD3: an MLP with a tanh output of K scores and P parameters."""

from typing import Any

from stable_baselines3.common.torch_layers import CombinedExtractor, NatureCNN

from sb3_chdp.common.td3 import ScoreTD3Policy


class PATD3Policy(ScoreTD3Policy):
    """Policy class (with both actor and critic) for PA-TD3, see :class:`ScoreTD3Policy`."""


MlpPolicy = PATD3Policy


class CnnPolicy(PATD3Policy):
    """:class:`PATD3Policy` for images: ``features_extractor_class`` is :class:`NatureCNN` by default."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{"features_extractor_class": NatureCNN, **kwargs})


class MultiInputPolicy(PATD3Policy):
    """:class:`PATD3Policy` for dict observations: ``features_extractor_class`` is :class:`CombinedExtractor` by default."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **{"features_extractor_class": CombinedExtractor, **kwargs})
