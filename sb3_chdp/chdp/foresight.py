"""
How far CHDP trusts what its critics say about the future: where actions have no influence on it, that is noise.

The critics learn rewards beside values: the difference is what follows. Exploratory actions are random draws, so that only
their effect tells what follows one from what follows others: what the critics claim of it can be compared with what did.
"""

from typing import NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_chdp.chdp.exploration import vary_parts
from sb3_chdp.chdp.policies import CHDPPolicy

# Other exploratory actions for each mean
N_OTHERS = 16
# About so many of the latest claims count; with fewer than that at first nobody knows
N_REMEMBERED, MIN_CLAIMS = 500, 10
# Standard errors by which the benefit of the doubt exceeds the estimate
N_ERRORS = 2.0


class Claims(NamedTuple):
    """
    Exploratory actions, and what the critics say about them.

    :ivar rows: (n, columns) the actions
    :ivar envs: (n,) indices of their environments
    :ivar advantages: (n,) how much more is said to follow each than follows others on average
    :ivar expected: (n,) what is said to follow others on average
    """

    rows: np.ndarray
    envs: np.ndarray
    advantages: np.ndarray
    expected: np.ndarray


class ForesightSums(NamedTuple):
    """
    Sums over claimed advantages x and the differences y of what did follow from what was expected; old ones fade.

    :ivar n: number of claims
    :ivar xx: sum of squares of x
    :ivar xy: sum of products
    :ivar yy: sum of squares of y
    """

    n: float = 0.0
    xx: float = 0.0
    xy: float = 0.0
    yy: float = 0.0

    def add(self, x: float, y: float) -> "ForesightSums":
        """:return: the sums with one more claim"""
        kept = 1 - 1 / N_REMEMBERED
        return ForesightSums(*(kept * a + b for a, b in zip(self, (1.0, x * x, x * y, y * y), strict=True)))

    def weight(self) -> float:
        """
        How much what follows is to count in the choice of actions: less than 1 if not even half of what is claimed comes true.

        :return: twice the slope of y over x, with the benefit of the doubt, within [0, 1]
        """
        n, xx, xy, yy = self
        if n < MIN_CLAIMS or xx == 0:
            return 1.0
        slope = xy / xx
        error = np.sqrt(max(yy - slope * xy, 0) / (n * xx))
        return float(np.clip(2 * (slope + N_ERRORS * error), 0, 1))


def what_follows(policy: CHDPPolicy, features: th.Tensor, rows: np.ndarray) -> th.Tensor:
    """:return: (n,) discounted values that the target critics expect after actions, mean of both, in the critics' units"""
    columns, actions = policy.action_space.columns, th.as_tensor(rows, device=policy.device)
    latents, parameters = columns.view(actions, "latents"), columns.view(actions, "parameters")
    values, rewards = th.stack(policy.critic_target.outputs(features, latents, parameters)).mean(dim=0).unbind(dim=1)
    return values - rewards


@th.no_grad()
def explore(
    policy: CHDPPolicy,
    observation: PyTorchObs,
    rows: np.ndarray,
    envs: np.ndarray,
    rng: np.random.Generator,
    masks: np.ndarray | None = None,
) -> Claims:
    """
    Draw exploratory actions, and ask the critics about them.

    :param policy: the networks
    :param observation: observations of all environments
    :param rows: (n, columns) what the policy would do in those that explore
    :param envs: (n,) their indices
    :param rng: random generator
    :param masks: (n, K) False for discrete actions that may not be taken, None if all may
    """
    n_draws = 1 + 2 * N_OTHERS
    features = policy.critic_target.features(observation)[envs].repeat_interleave(n_draws, dim=0)
    masks = None if masks is None else np.repeat(masks, n_draws, axis=0)
    drawn = vary_parts(policy, features, np.repeat(rows, n_draws, axis=0), rng, masks)
    follows = what_follows(policy, features, drawn).view(-1, n_draws).cpu().numpy()
    # Two means, or their error would be an agreement of claim and outcome
    some, others = follows[:, 1 : 1 + N_OTHERS].mean(axis=1), follows[:, 1 + N_OTHERS :].mean(axis=1)
    return Claims(drawn[::n_draws], envs, follows[:, 0] - some, others)
