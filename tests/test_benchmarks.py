"""The scripts beside the published results."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch as th
from torch import nn

import sb3_chdp
from sb3_chdp.chdp.diffusion import DiffusionModel

BENCHMARKS = Path(__file__).parent.parent / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import dql_style  # noqa: E402
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


def test_chains_in_the_style_of_diffusion_q_learning_are_ours():
    """What the speed is measured against computes the same numbers, gradients included."""
    ours = DiffusionModel(3, 4, 5, [16, 16], nn.Mish)
    theirs = dql_style.DQLDiffusion(3, 4, 5, [16, 16], nn.Mish)
    predictor = ours.noise_predictor
    for mine, other in ((0, 1), (2, 3)):
        theirs.time_mlp[other].load_state_dict(predictor.time_mlp[mine].state_dict())
    first = th.cat([predictor.x_weight, predictor.time_weight, predictor.condition_weight], dim=1)
    theirs.mid_layer[0].load_state_dict({"weight": first.detach(), "bias": predictor.bias.detach()})
    theirs.mid_layer[2].load_state_dict(predictor.trunk[1].state_dict())
    theirs.final_layer.load_state_dict(predictor.trunk[3].state_dict())
    noise, gradients = ours.draw_noise(6), []
    condition = th.randn(6, 4, requires_grad=True)
    samples = [model.sample(condition, noise) for model in (ours, theirs)]
    th.testing.assert_close(*samples, atol=1e-5, rtol=0)
    for sample in samples:
        gradients.append(th.autograd.grad(sample.square().sum(), condition)[0])
    th.testing.assert_close(*gradients, atol=1e-4, rtol=1e-3)
