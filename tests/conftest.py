import pytest
import torch as th

from tests.algorithms import ALGORITHMS

# Small networks: more threads are slower, and tests may run side by side
th.set_num_threads(1)


@pytest.fixture(params=ALGORITHMS, ids=lambda algorithm: algorithm.__name__)
def algorithm(request):
    return request.param
