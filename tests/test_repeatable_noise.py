"""The noise of deterministic predictions: a function of the observation that looks like chance."""

import numpy as np
import pytest
import torch as th
from scipy import stats

from sb3_chdp.chdp.repeatable_noise import repeatable_noise

B, N = 4_000, 40
RNG = np.random.default_rng(0)


def floats(values):
    return th.as_tensor(np.asarray(values), dtype=th.float32)


OBSERVATIONS = {
    "uniform": floats(RNG.uniform(-1, 1, (B, 3))),
    "one number": floats(RNG.uniform(-1, 1, (B, 1))),
    "trajectory": floats(np.cumsum(RNG.normal(0, 1e-3, (B, 3)), axis=0)),
    "line": floats(1 + 1e-4 * np.arange(B)[:, None] * np.ones((1, 4))),
    "tiny": floats(RNG.uniform(-1e-4, 1e-4, (B, 3))),
    "large": floats(1e6 + RNG.uniform(-1e3, 1e3, (B, 3))),
    "whole": th.arange(B),
    "bits": th.as_tensor((np.arange(B)[:, None] >> np.arange(12)) & 1),
    "pixels": th.as_tensor(RNG.integers(0, 256, (B, 3, 4, 4)), dtype=th.uint8),
    "dict": {"a": floats(RNG.uniform(-1, 1, (B, 2))), "kind": th.as_tensor(RNG.integers(3, size=B))},
}


@pytest.fixture(params=OBSERVATIONS)
def observations(request):
    return OBSERVATIONS[request.param]


def rows_of(observations, rows):
    return {key: part[rows] for key, part in observations.items()} if isinstance(observations, dict) else observations[rows]


def largest_correlation(values):
    """:return: of two different columns"""
    correlations = np.corrcoef(values.T)
    return np.abs(correlations[~np.eye(len(correlations), dtype=bool)]).max()


def test_over_observations(observations):
    """Every number is standard normal, and unrelated to the others and to those of the next observation."""
    noise = repeatable_noise(observations, N).numpy()
    # The smallest of N p-values
    assert min(stats.kstest(column, "norm").pvalue for column in noise.T) > 1e-3 / N
    limit = 5.5 / np.sqrt(B)
    assert largest_correlation(noise) < limit and largest_correlation(noise**2) < limit
    for lag in (1, 2, 7):
        assert max(abs(np.corrcoef(column[:-lag], column[lag:])[0, 1]) for column in noise.T) < limit


def test_the_order_of_keys_makes_no_difference():
    parts = OBSERVATIONS["dict"]
    swapped = {key: parts[key] for key in reversed(parts)}
    assert th.equal(repeatable_noise(parts, 5), repeatable_noise(swapped, 5))


def test_within_an_observation(observations):
    """The chains of one observation are as unrelated as those of different ones."""
    noise = repeatable_noise(rows_of(observations, slice(0, 100)), 20, 2, 25).numpy()
    assert noise.shape == (100, 20, 2, 25)
    flat = noise.reshape(100, -1)
    p_values = [stats.kstest(values, "norm").pvalue for values in flat]
    assert min(p_values) > 1e-5 and stats.kstest(p_values, "uniform").pvalue > 1e-4
    for lag in (1, 25, 50, 500):
        assert max(abs(np.corrcoef(values[:-lag], values[lag:])[0, 1]) for values in flat) < 6 / np.sqrt(500)


def test_the_same_alone_and_in_a_batch(observations):
    batch = repeatable_noise(rows_of(observations, slice(0, 50)), 200)
    alone = th.cat([repeatable_noise(rows_of(observations, slice(i, i + 1)), 200) for i in range(50)])
    th.testing.assert_close(alone, batch, atol=1e-5, rtol=0)
    assert th.equal(batch, repeatable_noise(rows_of(observations, slice(0, 50)), 200))


def test_zeros_are_an_observation_like_others():
    noise = repeatable_noise(th.zeros(2, 3), 2_000).numpy()
    assert (noise[0] == noise[1]).all() and stats.kstest(noise[0], "norm").pvalue > 1e-3


def test_the_type_of_numbers_does_not_matter():
    whole = th.arange(12).reshape(4, 3)
    expected = repeatable_noise(whole, 5)
    for dtype in (th.uint8, th.int32, th.float32, th.float64):
        assert th.equal(repeatable_noise(whole.to(dtype), 5), expected)


def test_another_seed():
    observations = OBSERVATIONS["uniform"]
    pair = th.cat([repeatable_noise(observations, 20, seed=seed) for seed in (0, 1)], dim=1).numpy()
    assert largest_correlation(pair) < 5.5 / np.sqrt(B)


def test_frozen():
    """A model decides tomorrow as today."""
    expected = [[0.389095, -0.034483, 0.945737, -0.065379]]
    np.testing.assert_allclose(repeatable_noise(th.tensor([[0.5, -2.0]]), 4).numpy(), expected, atol=1e-6)


class Noise(th.nn.Module):
    def forward(self, observations):
        return repeatable_noise(observations, 300)


def test_onnx(tmp_path):
    ort = pytest.importorskip("onnxruntime")
    observations = floats(RNG.normal(0, 10, (500, 17)))
    size = {0: th.export.Dim("n")}
    program = th.export.export(Noise(), (observations[:2],), dynamic_shapes=(size,))
    th.onnx.export(program, f=str(tmp_path / "noise.onnx"), verbose=False)
    session = ort.InferenceSession(str(tmp_path / "noise.onnx"), providers=["CPUExecutionProvider"])
    (exported,) = session.run(None, {session.get_inputs()[0].name: observations.numpy()})
    np.testing.assert_allclose(exported, Noise()(observations), atol=1e-5)
    th.testing.assert_close(program.module()(observations), Noise()(observations), atol=1e-5, rtol=0)
