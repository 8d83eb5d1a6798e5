import multiprocessing
import os

import pytest
import torch as th
from hypothesis import settings

from tests.algorithms import ALGORITHMS, OFF_POLICY_ALGORITHMS

# Most tests compare with tensors on the processor; those of a GPU are in test_gpu.py
os.environ.setdefault("CUDA_VISIBLE_DEVICES", "")
# No windows
os.environ.update(MPLBACKEND="Agg", SDL_VIDEODRIVER="dummy")
# For once: pytest --hypothesis-profile=thorough
settings.register_profile("thorough", max_examples=10_000)
# Small networks: more threads are slower, and tests may run side by side
th.set_num_threads(1)
# Else every environment of every SubprocVecEnv, and every command, imports them anew (torch._dynamo: every optimizer does)
multiprocessing.set_forkserver_preload(
    ["stable_baselines3", "torch._dynamo", "tests.hybrid_envs", "rl_zoo3.exp_manager", "seaborn"]
)


@pytest.fixture(params=ALGORITHMS, ids=lambda algorithm: algorithm.__name__)
def algorithm(request):
    return request.param


@pytest.fixture(params=OFF_POLICY_ALGORITHMS, ids=lambda algorithm: algorithm.__name__)
def off_policy_algorithm(request):
    return request.param
