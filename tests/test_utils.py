import pytest
import torch as th

from sb3_chdp.common.utils import nearest_row


@pytest.mark.parametrize("n_rows", [1, 5, 2048, 2049, 5000, 65_536])
def test_nearest_row_against_all_distances(n_rows):
    points, table = th.rand(50, 3) * 2 - 1, th.rand(n_rows, 3) * 2 - 1
    distances = th.cdist(points.double(), table.double()).square()
    found = distances.gather(1, nearest_row(points, table)[:, None]).squeeze(1)
    # Another row may be as near, up to the rounding of single precision
    th.testing.assert_close(found, distances.min(dim=1).values, atol=1e-6, rtol=0)
    assert th.equal(nearest_row(table[-50:], table), th.arange(n_rows)[-50:])
