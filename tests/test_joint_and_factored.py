"""Several discrete choices with few combinations may be read either way: what both forms say of one action is the same."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_chdp import HybridActionSpec
from sb3_chdp.common.hybrid_box import ConcatenatedBox, ScoreBox
from sb3_chdp.common.masks import read_masks
from sb3_chdp.hppo.distributions import HybridDistribution
from tests.hybrid_envs import box

RADICES = (3, 2, 2, 2, 4)
SPACE = spaces.Dict(
    {
        "a": spaces.MultiDiscrete([3, 2], start=[-1, 5]),
        "b": spaces.MultiBinary(2),
        "c": spaces.Discrete(4, start=2),
        "x": box(-1, 3, 2),
    }
)
LAYOUTS = ("joint", "factored")


def joint_index(digits):
    return np.ravel_multi_index(tuple(np.asarray(digits, dtype=int).T), RADICES)


def sums(of_values):
    """:return: (n, 96) for every combination the sum of what its values have in (n, 13)"""
    digits = np.stack(np.unravel_index(np.arange(np.prod(RADICES)), RADICES), axis=1)
    return of_values[:, np.cumsum((0, *RADICES[:-1])) + digits].sum(axis=2)


def test_rows_are_of_the_same_native_actions():
    joint, factored = (HybridActionSpec(SPACE, layout) for layout in LAYOUTS)
    SPACE.seed(0)
    for _ in range(100):
        action = SPACE.sample()
        one, other = joint.to_row(action), factored.to_row(action)
        assert one[0] == joint_index(other[: len(RADICES)]) and (one[1:] == other[len(RADICES) :]).all()
        np.testing.assert_equal(joint.to_native(one), factored.to_native(other))


@pytest.mark.parametrize("seed", range(3))
def test_masks_allow_the_same_actions_with_the_same_chances(seed):
    rng, n = np.random.default_rng(seed), 20_000
    masks = rng.random((1, sum(RADICES))) < 0.6
    masks[:, np.cumsum((0, *RADICES[:-1]))] = True
    counts = []
    for layout in LAYOUTS:
        spec = HybridActionSpec(SPACE, layout)
        choices = spec.sample_choices(rng, n, np.repeat(read_masks(spec, masks, 1), n, axis=0))
        counts.append(np.bincount(choices if layout == "joint" else joint_index(choices), minlength=96))
    allowed = sums(masks.astype(int))[0] == len(RADICES)
    for count in counts:
        assert ((count > 0) == allowed).all()
        assert np.abs(count[allowed] - n / allowed.sum()).max() < 5 * np.sqrt(n / allowed.sum())


@pytest.mark.parametrize("masked", [False, True])
def test_distributions_agree(masked):
    """The logits of a combination are the sums of those of its values."""
    rng, n = np.random.default_rng(0), 50
    logits, means, log_std = rng.normal(size=(n, sum(RADICES))), rng.normal(size=(n, 2)), th.full((2,), -0.5)
    masks = rng.random((n, sum(RADICES))) < 0.6
    masks[:, np.cumsum((0, *RADICES[:-1]))] = True
    said = []
    for layout, scores in zip(LAYOUTS, (sums(logits), logits), strict=True):
        space = ConcatenatedBox(SPACE, layout)
        outputs = th.as_tensor(np.concatenate([scores, means], axis=1))
        distribution = HybridDistribution(space).proba_distribution(outputs, log_std.double())
        if masked:
            distribution.apply_masking(read_masks(space.spec, masks, n))
        natives = space.to_native(distribution.mode().numpy())
        rows = distribution.mode()
        said.append((natives, distribution.log_prob(rows), distribution.entropy()))
    (natives, log_probs, entropies), (others, other_log_probs, other_entropies) = said
    np.testing.assert_equal(natives, others)
    th.testing.assert_close(log_probs, other_log_probs)
    th.testing.assert_close(entropies, other_entropies)


def test_scores_choose_the_same_actions():
    rng = np.random.default_rng(0)
    scores, parameters = rng.uniform(-1, 1, (200, sum(RADICES))), rng.uniform(-1, 1, (200, 2))
    # Scores are in [-1, 1]
    of_joint = np.concatenate([sums(scores) / len(RADICES), parameters], axis=1)
    joint = ScoreBox(SPACE, "joint").to_native(of_joint)
    np.testing.assert_equal(joint, ScoreBox(SPACE, "factored").to_native(np.concatenate([scores, parameters], axis=1)))
