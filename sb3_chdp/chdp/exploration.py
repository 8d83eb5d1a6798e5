"""When and how CHDP explores: a rate that follows from the task, and the parts of a hybrid action varied each on its own."""

from typing import NamedTuple

import numpy as np
import torch as th

from sb3_chdp.chdp.policies import CHDPPolicy

# After so many steps, and some for each discrete action or value of a choice, every second action still explores
HALF_LIFE, HALF_LIFE_PER_ACTION = 500, 5
# Before so many episodes have ended nobody knows whether success is rare
MIN_EPISODES = 10
# Explored actions of an episode that always remain, and smallest and largest share of all actions that they may be
ACTIONS_PER_EPISODE, MIN_FINAL_RATE, MAX_FINAL_RATE = 1.0, 0.002, 0.5
# Returns that differ by a smaller part of their size are equal but for rounding
ROUNDING = 1e-6
# Smallest and largest standard deviation of the noise on scaled parameters
NOISE_SCALES = (0.03, 1.0)


class ReturnSums(NamedTuple):
    """
    What is known of the returns of all episodes so far.

    :ivar n: number of episodes
    :ivar mean: mean return
    :ivar absolute: sum of absolute differences, each from the mean of the episodes before
    :ivar square: sum of their squares
    :ivar cube: sum of their cubes
    """

    n: int = 0
    mean: float = 0.0
    absolute: float = 0.0
    square: float = 0.0
    cube: float = 0.0

    def add(self, value: float) -> "ReturnSums":
        """:return: the sums with one more return"""
        n, mean, absolute, square, cube = self
        d = value - mean if n > 0 and abs(value - mean) > ROUNDING * abs(mean) else 0.0
        return ReturnSums(n + 1, mean + (value - mean) / (n + 1), absolute + abs(d), square + d**2, cube + d**3)

    def informative_share(self) -> float:
        """
        Share of episodes whose return tells something, the participation ratio of the differences: 0 if all returns are equal,
        small if few are better than the others, 0.64 if they are normally distributed, 1 if half of the episodes succeed.

        :return: share in [0, 1]; 1 before ``MIN_EPISODES`` have ended, and if it is the worse returns that are rare
        """
        if self.n < MIN_EPISODES or self.cube < 0:
            return 1.0
        return self.absolute**2 / (self.n * self.square) if self.square > 0 else 0.0


def informative_steps(n_steps: int, returns: ReturnSums) -> float:
    """
    For how many steps some steps count in :func:`exploration_rate`: all, but fewer where less than half of the episodes tell
    something.

    :param n_steps: number of steps
    :param returns: returns of the episodes so far
    :return: n (2 p)^2 and at most n, p from :meth:`ReturnSums.informative_share`
    """
    return n_steps * min((2 * returns.informative_share()) ** 2, 1)


def exploration_rate(n_steps: int, n_informative: float, n_episodes: int, n_values: int) -> float:
    """
    The rate falls with the number n of informative steps as n0 / (n0 + n), n0 = ``HALF_LIFE`` + K ``HALF_LIFE_PER_ACTION``,
    whatever the length of the training; ``ACTIONS_PER_EPISODE`` of an episode keep exploring, and at least
    ``MIN_FINAL_RATE`` of all actions.

    :param n_steps: steps so far
    :param n_informative: informative steps so far, see :func:`informative_steps`
    :param n_episodes: episodes so far
    :param n_values: number K of discrete actions, in a factored space sum of the radices
    :return: probability of an exploratory action
    """
    half_life = HALF_LIFE + HALF_LIFE_PER_ACTION * n_values
    final = min(max(ACTIONS_PER_EPISODE * n_episodes / max(n_steps, 1), MIN_FINAL_RATE), MAX_FINAL_RATE)
    return max(half_life / (half_life + min(n_informative, n_steps)), final)


def reflect(x: np.ndarray) -> np.ndarray:
    """:return: x with what lies beyond -1 or 1 folded back; clipping would gather half of the noise around a bound on it"""
    x = np.where(x > 1, 2 - x, np.where(x < -1, -2 - x, x))
    return np.clip(x, -1, 1)


def random_parameters(rng: np.random.Generator, mask: np.ndarray) -> np.ndarray:
    """
    :param rng: random generator
    :param mask: (n, Pmax) 1 for the parameters that exist
    :return: (n, Pmax) scaled parameters, padding 0: half of the rows uniformly random; in the others each parameter is a bound
        with probability 1/2 (where good actions often lie), else uniform in between
    """
    reach = np.where(rng.random((len(mask), 1)) < 0.5, 2.0, 1.0)
    return np.clip(reach * rng.uniform(-1, 1, mask.shape), -1, 1) * mask


def vary_parts(
    policy: CHDPPolicy,
    features: th.Tensor,
    rows: np.ndarray,
    rng: np.random.Generator,
    masks: np.ndarray | None = None,
) -> np.ndarray:
    """
    Replace a part of each action, or all of it.

    With equal probability: a uniformly random discrete action with the parameters that the continuous policy draws for it;
    the same discrete action with random parameters; the same action with Gaussian noise on its parameters, whose standard
    deviation is log-uniform in ``NOISE_SCALES``; a uniformly random discrete action with random parameters. In a large
    parameter box of which a small part is of use, the last alone hardly ever tries what is better than the present action.
    Random parameters are those of :func:`random_parameters`.

    :param policy: the policies
    :param features: (n, features_dim) features of the observations
    :param rows: (n, columns) the policy's actions
    :param rng: random generator
    :param masks: (n, K) False for discrete actions that may not be taken, None if all may
    :return: (n, columns) rows
    """
    n, spec, columns = len(rows), policy.action_space.spec, policy.action_space.columns
    kinds = rng.integers(4, size=(n, 1))

    random = policy.random_rows(rng, n, masks)
    of_random_k = random.copy()
    with th.no_grad():
        k = th.as_tensor(columns.discrete_actions(random), device=policy.device)
        columns.view(of_random_k, "parameters")[:] = policy.acting_actor.sample_parameters(features, k).cpu().numpy()

    mask, mask_of_random = (spec.parameter_mask[spec.options_of(columns.discrete_actions(x))] for x in (rows, random))
    elsewhere, nearby = rows.copy(), rows.copy()
    columns.view(random, "parameters")[:] = random_parameters(rng, mask_of_random)
    columns.view(elsewhere, "parameters")[:] = random_parameters(rng, mask)
    low, high = np.log(NOISE_SCALES)
    scales = np.exp(rng.uniform(low, high, (n, 1)))
    noise = scales * rng.normal(size=mask.shape)
    columns.view(nearby, "parameters")[:] = reflect(columns.view(rows, "parameters") + noise) * mask
    return np.choose(kinds, [of_random_k, elsewhere, nearby, random])
