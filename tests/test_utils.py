from copy import deepcopy

import pytest
import torch as th
from torch import nn

from sb3_chdp.common.utils import TargetUpdate, nearest_row


@pytest.mark.parametrize("n_rows", [1, 5, 2048, 2049, 5000, 65_536])
def test_nearest_row_against_all_distances(n_rows):
    points, table = th.rand(50, 3) * 2 - 1, th.rand(n_rows, 3) * 2 - 1
    distances = th.cdist(points.double(), table.double()).square()
    found = distances.gather(1, nearest_row(points, table)[:, None]).squeeze(1)
    # Another row may be as near, up to the rounding of single precision
    th.testing.assert_close(found, distances.min(dim=1).values, atol=1e-6, rtol=0)
    assert th.equal(nearest_row(table[-50:], table), th.arange(n_rows)[-50:])


def test_target_update_moves_shared_parameters_once_and_copies_statistics():
    shared = nn.Sequential(nn.Linear(2, 2), nn.BatchNorm1d(2))
    networks = (nn.Sequential(shared, nn.Linear(2, 1)), nn.Sequential(shared, nn.Linear(2, 3)))
    targets = deepcopy(networks)
    before = deepcopy(networks)
    with th.no_grad():
        for p in nn.ModuleList(networks).parameters():
            p.add_(1)
    networks[0](th.randn(8, 2))
    TargetUpdate(networks, targets)(0.25)
    for network, target, old in zip(networks, targets, before, strict=True):
        for name, p in target.named_parameters():
            th.testing.assert_close(p, old.get_parameter(name) + 0.25)
        for name in ("0.1.running_mean", "0.1.running_var"):
            assert th.equal(target.get_buffer(name), network.get_buffer(name))
            assert not th.equal(target.get_buffer(name), old.get_buffer(name))
