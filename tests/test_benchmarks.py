"""The scripts beside the published results."""

import sys
from pathlib import Path

import numpy as np
import pytest

import sb3_chdp

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import release  # noqa: E402

TINY = {
    "chdp": dict(n_diffusion_steps=2, learning_starts=40, buffer_size=300),
    "hyar_td3": dict(learning_starts=40, buffer_size=300, representation_warmup_steps=3),
}


@pytest.mark.parametrize("algo", ["chdp", "hyar_td3"])
def test_published_models_act_as_the_trained_ones(algo, tmp_path):
    cls = sb3_chdp.ALGORITHMS[algo].load_class()
    cls("MlpPolicy", "HardMove4-v0", seed=0, device="cpu", **TINY[algo]).learn(120).save(tmp_path / "trained.zip")
    trained, small = (cls.load(tmp_path / "trained.zip", device="cpu") for _ in range(2))
    release.shrink(small)
    release.save_compressed(small, tmp_path / "small.zip")
    assert (tmp_path / "small.zip").stat().st_size < 0.5 * (tmp_path / "trained.zip").stat().st_size
    published = cls.load(tmp_path / "small.zip", device="cpu")
    obs = np.random.uniform(-1, 1, (20, 4)).astype(np.float32)
    for expected, action in zip(*(model.predict(obs, deterministic=True)[0] for model in (trained, published)), strict=True):
        assert expected[0] == action[0]
        np.testing.assert_array_equal(expected[1][expected[0]], action[1][action[0]])
