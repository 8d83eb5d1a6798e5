"""
Noise that is a function of the observation: the same for the same observation every time, unrelated for any other.

It is arithmetic on 64-bit floats that every runtime knows, so that exported models draw the same noise.
"""

import math
from functools import cache

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

# Numbers in [0, 1) that an observation is reduced to
N_PHASES = 4
# Single precision, in which exporters keep constants, holds all of these exactly.
# What is smaller counts on a linear scale, the rest on a logarithmic one
SMALL_ENTRY = 2.0**-20
# Together they enlarge differences between observations some 100,000 times: noise is unrelated from a difference of 1e-4 on.
# Rounding errors, which no two runtimes share, grow likewise, and have to stay small
OBSERVATION_FREQUENCY, MIXING, VALUE_FREQUENCY = 64.0, 2.0, 256
# What keeps noise below 4.4 in size, where rounding errors would show
SMALLEST = 2.0**-14
FULL_TURN = float(np.float32(2 * math.pi))


@cache
def _observation_frequencies(n_entries: int) -> np.ndarray:
    """:return: (1 + n_entries, N_PHASES), the same on every machine: NumPy has frozen this generator"""
    frequencies = np.random.RandomState(0).uniform(-OBSERVATION_FREQUENCY, OBSERVATION_FREQUENCY, (1 + n_entries, N_PHASES))
    return frequencies / math.sqrt(n_entries)


@cache
def _value_frequencies(n_values: int, seed: int) -> np.ndarray:
    """:return: (N_PHASES, n_values) whole numbers: a phase just below 1 and one just above 0 are neighbours"""
    return np.random.RandomState(seed).randint(1, VALUE_FREQUENCY, (N_PHASES, n_values)).astype(np.float64)


def _fractions(observations: PyTorchObs, n_values: int, seed: int) -> th.Tensor:
    """
    The entries of an observation, on a logarithmic scale, are added up with large random weights. Of the sums the fractions
    count, the phases. They are mixed by a sine, without which observations of few bits have related numbers. The numbers
    are the fractions of whole multiples of the phases.

    :return: (B, n_values) uniform float64 numbers in [0, 1)
    """
    # Sorted, as the order of the keys depends on where a dict comes from
    parts = [observations[key] for key in sorted(observations)] if isinstance(observations, dict) else [observations]
    entries = th.cat([part.reshape(part.shape[0], -1).double() for part in parts], dim=1)
    scaled = entries.sign() * (1 + entries.abs() / SMALL_ENTRY).log()
    frequencies = th.as_tensor(_observation_frequencies(entries.shape[1]), device=entries.device)
    phases = _fraction(scaled @ frequencies[1:] + frequencies[0])
    others = th.cat([phases[:, 1:], phases[:, :1]], dim=1)
    phases = _fraction(phases + MIXING * (FULL_TURN * others).sin())
    return _fraction(phases @ th.as_tensor(_value_frequencies(n_values, seed), device=entries.device))


def _fraction(numbers: th.Tensor) -> th.Tensor:
    return numbers - numbers.floor()


def repeatable_noise(observations: PyTorchObs, *shape: int, seed: int = 0) -> th.Tensor:
    """
    Standard normal noise that depends on each observation alone, not on the rest of the batch.

    Numbers that look uniform are made of the observation, and two of them make two normal ones (Box and Muller, 1958).

    :param observations: batch of B observations: numbers of any kind, flat, images or a dict of these
    :param shape: of what each observation gets
    :param seed: another one gives unrelated noise
    :return: (B, *shape) float32 noise
    """
    n_pairs = math.ceil(math.prod(shape) / 2)
    radii, angles = _fractions(observations, 2 * n_pairs, seed).split(n_pairs, dim=1)
    radii = (-2 * radii.clamp(min=SMALLEST).log()).sqrt()
    # Not all runtimes know the cosine of 64-bit floats
    angles = th.cat([angles + 0.25, angles], dim=1)
    noise = th.cat([radii, radii], dim=1) * (FULL_TURN * angles).sin()
    return noise[:, : math.prod(shape)].float().reshape(-1, *shape)
