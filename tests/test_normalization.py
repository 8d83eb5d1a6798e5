"""Observations in any units: what the features extractor makes of them."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_chdp import CHDP
from sb3_chdp.common.normalization import (
    WHITENED_GAIN,
    NormalizedCombinedExtractor,
    NormalizedExtractor,
    RunningNormalization,
)
from tests.algorithms import fast_model
from tests.hybrid_envs import HybridIdentityEnv, LayoutEnv, box, layouts

N = 6
UNITS = pytest.mark.parametrize("unit", [1e-3, 1.0, 1e5])


def batches(n_batches=300, size=64, seed=0):
    """Correlated vectors: two entries differ by little, of what they share."""
    generator = th.Generator().manual_seed(seed)
    x = th.randn(n_batches, size, N, generator=generator, dtype=th.float64)
    x[..., 1] = x[..., 0] + 0.3 * x[..., 1]
    return x


def trained(x):
    """:return: an extractor, in evaluation mode, that has counted the batches"""
    extractor = NormalizedExtractor(box(-np.inf, np.inf, N))
    for batch in x:
        extractor(batch.float())
    return extractor.train(False)


def split(features):
    """:return: normalised and whitened entries"""
    return features[:, :N], features[:, N:]


def test_centered_scaled_and_whitened():
    x = batches() * th.tensor([1, 5, 0.1, 30, 1, 2]) + th.tensor([3, 0, 1, -40, 0, 1])
    x = x[:100].flatten(0, 1).float()
    extractor = trained(batches() * th.tensor([1, 5, 0.1, 30, 1, 2]) + th.tensor([3, 0, 1, -40, 0, 1]))
    features = extractor(x)
    assert features.shape[1] == extractor.features_dim == 2 * N
    scaled, whitened = split(features)
    for part in (scaled, whitened):
        assert part.mean(dim=0).numpy() == pytest.approx(0, abs=0.1)
    # One factor for all entries
    ratios = (scaled.std(dim=0) / x.std(dim=0)).numpy()
    assert ratios == pytest.approx(ratios[0], rel=0.02)
    assert scaled.var(dim=0).mean().item() == pytest.approx(1, abs=0.05)
    assert (th.corrcoef(scaled.T) - th.eye(N)).abs().max() > 0.8, "the test is of correlated entries"
    assert (th.cov(whitened.T) / WHITENED_GAIN**2 - th.eye(N)).abs().max() < 0.15


@UNITS
@pytest.mark.parametrize("offset", [0.0, 100.0])
def test_units_and_offsets_do_not_matter(unit, offset):
    x = batches()
    expected = trained(x)(x[0].float())
    # The offset is in the units too: float32 resolves no less
    moved = unit * (x + offset)
    th.testing.assert_close(trained(moved)(moved[0].float()), expected, atol=0.01, rtol=0.01)


@pytest.mark.parametrize("value", [0.0, 1e-3, 7.0, -1e5])
def test_constant_entries_are_safe(value):
    x = batches()
    x[..., 2] = value
    extractor = trained(x)
    features = extractor(x[0].float())
    normalized, whitened = split(features)
    assert th.isfinite(features).all()
    assert normalized[:, 2].abs().max() < 0.1 and whitened[:, 2].abs().max() < 0.3
    # Another value than ever before is far off, and bounded
    other = x[0].clone()
    other[:, 2] = value + 1e4
    features = extractor(other.float())
    assert th.isfinite(features).all() and features.abs().max() <= 10


def test_a_batch_of_one_and_a_vector_of_one():
    single = NormalizedExtractor(box(-1, 1, 1))
    assert single.features_dim == 1
    for value in (3.0, 4.0, 5.0):
        assert th.isfinite(single(th.tensor([[value]]))).all()


def test_long_vectors_are_not_whitened():
    n = 2000
    extractor = NormalizedExtractor(box(-1, 1, n))
    assert extractor.features_dim == 2 * n
    scaled, standardized = extractor(5 * th.randn(64, n) + 3).split(n, dim=1)
    for part, spread in ((scaled, 1.0), (standardized, WHITENED_GAIN)):
        assert part.mean(dim=0).abs().max() < 1e-3
        assert part.std().item() == pytest.approx(spread, abs=0.02)


def test_statistics_are_frozen_in_evaluation():
    x = batches()
    extractor = trained(x[:10])
    before = {name: value.clone() for name, value in extractor.state_dict().items()}
    first = extractor(1000 * x[20].float())
    assert th.equal(extractor(1000 * x[20].float()), first)
    assert all(th.equal(value, before[name]) for name, value in extractor.state_dict().items())


def test_late_batches_change_little():
    """Statistics are averages over a long time, not over the last batches."""
    x = batches()
    extractor = trained(x)
    before = extractor(x[0].float())
    extractor.train()
    for batch in x[:20]:
        extractor(batch.float() + 3)
    assert (extractor.train(False)(x[0].float()) - before).abs().max() < 0.5


def test_dict_observations():
    image = spaces.Box(0, 255, (3, 36, 36), np.uint8)
    space = spaces.Dict(vector=box(-np.inf, np.inf, 3), choice=spaces.Discrete(4), image=image)
    extractor = NormalizedCombinedExtractor(space, cnn_output_dim=16)
    assert extractor.features_dim == 2 * 3 + 2 * 4 + 16
    observations = {
        "vector": 1e4 * th.randn(64, 3) + 1e5,
        "choice": th.eye(4)[th.randint(4, (64,))],
        "image": th.rand(64, 3, 36, 36),
    }
    for _ in range(20):
        features = extractor(observations)
    assert features.shape == (64, extractor.features_dim)
    assert th.isfinite(features).all() and features.abs().max() <= 10
    frozen = extractor.train(False)(observations)
    one = {key: value[:1] for key, value in observations.items()}
    th.testing.assert_close(extractor(one), frozen[:1])


def env_of_units(unit=1.0, offset=0.0, dict_observations=False):
    space = box(-np.inf, np.inf, 2)

    class Units(LayoutEnv):
        def observation(self):
            x = (unit * (self.np_random.uniform(-1, 1, 2) + offset)).astype(np.float32)
            return {"vector": x} if dict_observations else x

        def reset(self, **kwargs):
            return self.observation(), super().reset(**kwargs)[1]

        def step(self, action):
            return self.observation(), *super().step(action)[1:]

    return Units(layouts()["shared"], spaces.Dict(vector=space) if dict_observations else space)


def extractors(model):
    return model.critic.features_extractor, model.critic_target.features_extractor


@pytest.mark.parametrize("policy", ["MlpPolicy", "MultiInputPolicy"])
def test_in_a_policy(policy, tmp_path):
    """Training counts, targets take over, predictions count nothing, and files keep the statistics."""
    env = env_of_units(1e4, 10.0, policy == "MultiInputPolicy")
    model = CHDP(policy, env, learning_starts=20, n_diffusion_steps=2, seed=0).learn(60)
    online, target = (extractor.state_dict() for extractor in extractors(model))
    (mean_name,) = [name for name in online if name.endswith("running_mean")]
    np.testing.assert_allclose(online[mean_name], 1e5, rtol=0.03)
    observations, _ = model.policy.obs_to_tensor(env.observation())
    for extractor in extractors(model):
        extractor.train(False)
    first, second = (extractor(observations).numpy() for extractor in extractors(model))
    np.testing.assert_allclose(first, second, atol=0.2)

    before = {name: value.clone() for name, value in target.items()}
    obs = [env.observation() for _ in range(4)]
    actions = [model.predict(one, deterministic=True)[0] for one in obs]
    assert all(th.equal(value, before[name]) for name, value in extractors(model)[1].state_dict().items())
    model.save(tmp_path / "model")
    model.policy.save(tmp_path / "policy")
    for loaded in (CHDP.load(tmp_path / "model"), type(model.policy).load(tmp_path / "policy")):
        for one, action in zip(obs, actions, strict=True):
            np.testing.assert_equal(loaded.predict(one, deterministic=True)[0], action)


def test_targets_take_over_the_statistics_of_each_update():
    model = fast_model(env=HybridIdentityEnv(), policy_delay=1).learn(60)
    online, target = (dict(extractor.named_buffers()) for extractor in extractors(model))
    assert online and all(th.equal(value, target[name]) for name, value in online.items())


def test_another_extractor_may_take_its_place():
    model = fast_model(policy_kwargs=dict(features_extractor_class=FlattenExtractor, net_arch=[16])).learn(40)
    assert model.critic.features_extractor.features_dim == 4
    assert not any(isinstance(module, RunningNormalization) for module in model.critic.features_extractor.modules())
