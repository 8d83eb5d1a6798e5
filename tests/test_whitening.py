"""The features extractor that whitens observations."""

import pytest
import torch as th
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor

from sb3_chdp import CHDP
from sb3_chdp.chdp.whitening import BATCHES_PER_UPDATE, MAX_DEVIATION, SHRINKAGE, WhiteningExtractor
from tests.algorithms import FAST_CHDP, filled_model
from tests.fitting import unexplained
from tests.hybrid_envs import HybridIdentityEnv, box


def close_pair(n: int) -> tuple[th.Tensor, th.Tensor]:
    """:return: (n, 3) two entries that differ by a twentieth at most and a constant one, and the (n, 1) scaled difference"""
    place, difference = 2 * th.rand(n, 1) - 1, 2 * th.rand(n, 1) - 1
    return th.cat([place, place + 0.05 * difference, th.full((n, 1), 7.0)], dim=1), difference


def test_whitened_entries_vary_alike_in_all_directions():
    th.manual_seed(0)
    # Units do not matter
    for unit in (1.0, 1000.0):
        extractor = WhiteningExtractor(box(-1, 1, 3))
        for _ in range(50 * BATCHES_PER_UPDATE):
            extractor(unit * close_pair(64)[0])
        extractor.eval()
        obs = unit * close_pair(10_000)[0]
        flat, whitened = extractor(obs).split(3, dim=1)
        assert extractor.features_dim == 6 and (flat == obs).all()
        assert whitened.mean(dim=0).abs().max() < 0.1 and whitened[:, 2].abs().max() < 0.01
        variances = th.linalg.eigvalsh(th.cov(obs.T))
        expected = variances / (variances + SHRINKAGE * variances.mean())
        th.testing.assert_close(th.linalg.eigvalsh(th.cov(whitened.T)), expected, atol=0.05, rtol=0)
        assert extractor(1e6 * obs)[:, 3:].abs().max() == MAX_DEVIATION


def test_only_training_changes_the_statistics():
    extractor = WhiteningExtractor(box(-1, 1, 3))
    extractor.eval()
    extractor(close_pair(64)[0])
    assert extractor.running_count == 0
    extractor.train()
    for _ in range(BATCHES_PER_UPDATE + 1):
        extractor(close_pair(64)[0])
    assert extractor.running_count == 2


def test_networks_see_small_differences():
    """A difference of a fortieth of the range of its entries: whitened, a network fits it within 200 steps."""
    left = []
    for extractor in (FlattenExtractor(box(-1, 1, 3)), WhiteningExtractor(box(-1, 1, 3))):
        th.manual_seed(0)
        net = th.nn.Sequential(extractor, th.nn.Linear(extractor.features_dim, 64), th.nn.SiLU(), th.nn.Linear(64, 1))

        def batch(net=net):
            obs, difference = close_pair(256)
            return net(obs), difference

        left.append(unexplained(net, batch, 200))
    assert left[0] > 0.8 and left[1] < 0.1


@pytest.mark.parametrize("shared", [False, True])
def test_targets_take_over_the_statistics(shared):
    model = filled_model(policy_kwargs=dict(whitening=True, net_arch=[8], share_features_extractor=shared))
    model.train(BATCHES_PER_UPDATE + 1, 32)
    for network, target in ((model.actor, model.actor_target), (model.critic, model.critic_target)):
        ours, theirs = network.features_extractor, target.features_extractor
        assert ours.running_count > 0 and (ours.running_transform == theirs.running_transform).all()
        assert (ours.running_mean == theirs.running_mean).all()


def test_whitening_is_for_flat_observations():
    message = "whitening=True is for flat observations, .*FlattenExtractor, got CombinedExtractor"
    policy_kwargs = dict(whitening=True, features_extractor_class=CombinedExtractor)
    with pytest.raises(ValueError, match=message):
        CHDP("MlpPolicy", HybridIdentityEnv(), **{**FAST_CHDP, "policy_kwargs": policy_kwargs})
