"""Deterministic policies as modules that PyTorch and ONNX can export."""

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_chdp.common.hybrid_box import ConcatenatedBox
from sb3_chdp.common.policies import HybridPolicy


class ExportablePolicy(nn.Module):
    """
    What ``model.predict(observation, deterministic=True)`` decides, in numbers, for ``torch.onnx.export`` and the like.

    :param policy: ``model.policy``; it is put into evaluation mode
    :raises TypeError: if the policy is not one of this package
    """

    parameter_index: th.Tensor
    low: th.Tensor
    high: th.Tensor

    def __init__(self, policy: HybridPolicy):
        super().__init__()
        if not isinstance(policy, HybridPolicy):
            raise TypeError(f"policy must be model.policy of a model of sb3_chdp, got {type(policy).__name__}")
        self.policy = policy
        spec = policy.action_space.spec
        self.register_buffer("parameter_index", th.tensor(spec.parameter_index, device=policy.device))
        for name, bounds in (("low", spec.centre - spec.half_range), ("high", spec.centre + spec.half_range)):
            self.register_buffer(name, th.tensor(bounds, dtype=th.float32, device=policy.device))
        self.eval()

    def forward(self, observation: PyTorchObs) -> tuple[th.Tensor, th.Tensor]:
        """
        :param observation: n observations, as the environment gives them; images have their channels first
        :return: (n,) int64 discrete actions k, (n, L) of a factored space; (n, Pmax) their parameters in the units of the
            action space, those of nested boxes one after the other, 0 behind the last one
        """
        rows, columns = self.policy._predict(observation, deterministic=True), self.policy.action_space.columns
        k, scaled = columns.discrete_actions(rows), columns.view(rows, "parameters")
        options = self.policy.action_space.spec.options_of(k)
        if isinstance(self.policy.action_space, ConcatenatedBox):
            # Rows with the parameters of all actions
            scaled = scaled.gather(1, self.parameter_index[options])
        low, high = self.low[options], self.high[options]
        # Clamped once more: rounding must not lead out of the box
        parameters = low + (high - low) * (scaled.clamp(-1, 1) + 1) / 2
        return k, parameters.maximum(low).minimum(high)
