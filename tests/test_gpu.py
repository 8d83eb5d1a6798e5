"""
Models on a GPU: CUDA_VISIBLE_DEVICES=0 python -m pytest tests/test_gpu.py

The other tests compare with tensors on the processor, so that conftest.py hides GPUs by default.
"""

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env

from tests.algorithms import make_model
from tests.hybrid_envs import MaskedEnv, make_layout_env

pytestmark = pytest.mark.skipif(not th.cuda.is_available(), reason="no GPU to be seen")


@pytest.mark.parametrize("env", ["nested", "masked", "HardMove4-v0"])
def test_trained_there_and_used_elsewhere(algorithm, env, tmp_path):
    make = {"nested": lambda: make_layout_env("nested"), "masked": MaskedEnv}.get(env, env)
    model = make_model(algorithm, make_vec_env(make, 2), device="cuda").learn(60)
    assert model.policy.device.type == "cuda"
    model.save(tmp_path / "model")
    observations = np.stack([model.observation_space.sample() for _ in range(50)])
    rows = model.policy.predict_rows(observations, deterministic=True)
    on_cpu = algorithm.load(tmp_path / "model", device="cpu").policy.predict_rows(observations, deterministic=True)
    same = np.isclose(rows, on_cpu, atol=1e-5).all(axis=1)
    # Two actions may be worth the same
    assert same.mean() >= 0.96
    algorithm.load(tmp_path / "model", env=model.get_env(), device="cuda").learn(20, reset_num_timesteps=False)
