"""
How far CHDP trusts what its critics say about the future: where actions have no influence on it, that is noise.

Beside the critics a network learns the rewards: the difference is what follows. Exploratory actions are random draws, so that
only their effect tells what comes of one from what comes of others: what the networks claim of it can be compared with what
did.
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
N_ERRORS = 1.0


class Claims(NamedTuple):
    """
    Exploratory actions, and what the critics say about them.

    :ivar rows: (n, columns) the actions
    :ivar envs: (n,) indices of their environments
    :ivar rewards: (n,) how much more reward each is said to get than others on average
    :ivar follows: (n,) how much more is said to follow it than follows others on average
    :ivar expected: (n,) what others are said to be worth on average
    """

    rows: np.ndarray
    envs: np.ndarray
    rewards: np.ndarray
    follows: np.ndarray
    expected: np.ndarray


class ForesightSums(NamedTuple):
    """
    Sums of products of claims r and f, about the reward and what follows, and the difference y of what came from what was
    expected; old ones fade.
    """

    n: float = 0.0
    rr: float = 0.0
    rf: float = 0.0
    ff: float = 0.0
    ry: float = 0.0
    fy: float = 0.0
    yy: float = 0.0

    def add(self, r: float, f: float, y: float) -> "ForesightSums":
        """:return: the sums with one more claim"""
        kept, products = 1 - 1 / N_REMEMBERED, (1.0, r * r, r * f, f * f, r * y, f * y, y * y)
        return ForesightSums(*(kept * a + b for a, b in zip(self, products, strict=True)))

    def weight(self) -> float:
        """
        How much what follows is to count in the choice of actions: less than 1 if not even half of what is claimed about it
        comes true, while what is claimed about rewards does. Critics that are wrong about both have no choice to offer.

        Least squares of y on both claims: an error about the reward that one about what follows makes up for is none.

        :return: weight in [0, 1], of the coefficients of r and f, doubled, and with the benefit of the doubt for f
        """
        n, rr, rf, ff, ry, fy, yy = self
        determinant = rr * ff - rf * rf
        if n < MIN_CLAIMS or determinant <= 1e-6 * rr * ff:
            return 1.0
        of_rewards, of_follows = (ff * ry - rf * fy) / determinant, (rr * fy - rf * ry) / determinant
        variance = max(yy - of_rewards * ry - of_follows * fy, 0) / (n * determinant)
        follows = np.clip(2 * (of_follows + N_ERRORS * np.sqrt(variance * rr)), 0, 1)
        rewards = np.clip(2 * (of_rewards - N_ERRORS * np.sqrt(variance * ff)), 0, 1)
        return float(1 - rewards * (1 - follows))


def expected_outcomes(policy: CHDPPolicy, features: th.Tensor, rows: np.ndarray) -> th.Tensor:
    """:return: (n, 2) values and rewards that the target networks expect of actions, in the critics' units"""
    columns, actions = policy.action_space.columns, th.as_tensor(rows, device=policy.device)
    latents = policy.acting_actor.codebook.representative_latents(columns.discrete_actions(actions))
    critic, parameters = policy.critic_target, columns.view(actions, "parameters")
    values = th.stack(critic.q_values(features, latents, parameters)).mean(dim=0)
    assert critic.reward_network is not None, "PaperCHDP does not explore"
    return th.cat([values, critic.reward_network(features, latents, parameters)], dim=1)


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
    expected = expected_outcomes(policy, features, drawn).view(-1, n_draws, 2).cpu().numpy()
    # Two means, or their error would be an agreement of claim and outcome
    some, others = expected[:, 1 : 1 + N_OTHERS].mean(axis=1), expected[:, 1 + N_OTHERS :].mean(axis=1)
    values, rewards = (expected[:, 0] - some).T
    return Claims(drawn[::n_draws], envs, rewards, values - rewards, others[:, 0])
