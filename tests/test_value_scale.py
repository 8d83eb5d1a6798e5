"""The units of the critics' values."""

import numpy as np
import pytest
import torch as th

from sb3_chdp import CHDP
from sb3_chdp.chdp import PaperCHDP
from sb3_chdp.chdp.value_scale import LARGEST_LOSS, MIN_UPDATE_WEIGHT, ValueScale, bounded_mean
from tests.algorithms import filled_model, sample
from tests.hybrid_envs import HybridIdentityEnv


@pytest.mark.parametrize("spread", [1e-3, 1.0, 1e4])
def test_outputs_have_zero_mean_and_values_unit_variance(spread):
    value_scale, generator = ValueScale(), th.Generator().manual_seed(0)
    # Values of mean -30 and standard deviation 5, rewards of mean 10 and standard deviation 2
    targets = spread * (th.tensor([5.0, 2.0]) * th.randn(600, 64, 2, generator=generator) + th.tensor([-30.0, 10.0]))
    for batch in targets:
        value_scale.update(batch)
    assert value_scale.center.tolist() == pytest.approx([-30 * spread, 10 * spread], rel=0.05)
    assert value_scale.scale.item() == pytest.approx(5 * spread, rel=0.05)
    outputs = value_scale.outputs(targets)
    np.testing.assert_allclose(outputs.std(dim=(0, 1)), [1, 0.4], rtol=0.05)
    assert outputs.mean(dim=(0, 1)).abs().max() < 0.1
    values = value_scale.values(outputs[..., :1]).float()
    th.testing.assert_close(values, targets[..., :1], rtol=1e-4, atol=1e-4 * spread)


def test_rare_disasters_do_not_hide_other_differences():
    value_scale, generator = ValueScale(), th.Generator().manual_seed(0)
    targets = 5 * th.randn(600, 64, 2, generator=generator) - 30
    disasters = th.rand(600, 64, generator=generator) < 1e-3
    targets[disasters] = -1e6
    value_scale.start(targets[:2].flatten(0, 1)[:, :1], th.zeros(128, 1))
    assert -32 < value_scale.center[0] < -28
    for batch in targets:
        value_scale.update(batch)
    assert 5 <= value_scale.scale <= 11
    assert value_scale.center.tolist() == pytest.approx([-30, -30], abs=1)
    outputs = value_scale.outputs(targets[300:])
    assert (outputs[disasters[300:]] == -LARGEST_LOSS).all()
    assert 0.4 < outputs[~disasters[300:]].std() < 1.1


@pytest.mark.parametrize("share", [0.2, 0.02, 0.002])
def test_rare_successes_count_in_full(share):
    value_scale = ValueScale()
    targets = th.zeros(1000, 2)
    targets[: round(1000 * share)] = 50.0
    for _ in range(3):
        value_scale.update(targets)
    assert value_scale.scale.item() == pytest.approx(targets[:, 0].std(correction=0).item(), rel=0.01)
    outputs = value_scale.outputs(targets)[:, :1]
    th.testing.assert_close(value_scale.values(outputs).float(), targets[:, :1], rtol=0, atol=1e-3)


@pytest.mark.parametrize(("fall_of_batch", "fall"), [(0.5, 0.0), (0.0, 100.0)])
def test_values_that_fall_are_no_disasters(fall_of_batch, fall):
    """Neither slowly, nor all at once."""
    value_scale, generator = ValueScale(), th.Generator().manual_seed(0)
    targets = th.randn(2000, 64, 2, generator=generator) - fall_of_batch * th.arange(2000)[:, None, None]
    targets[1000:] -= fall
    for batch in targets:
        value_scale.update(batch)
    outputs = value_scale.outputs(targets[-1])
    assert outputs.min() > -LARGEST_LOSS
    assert outputs.mean().abs() < 3
    assert value_scale.scale == value_scale.variance.sqrt()


def test_bounded_mean():
    x = th.arange(100.0)[:, None]
    assert bounded_mean(x).item() == pytest.approx(49.5)
    x[0] = -1e9
    assert -60 < bounded_mean(x).item() < 50
    # Nothing lies above the median: there is no unit to bound with
    assert bounded_mean(th.tensor([[0.0], [0.0], [-3.0]])).item() == pytest.approx(-1)


class Disasters(HybridIdentityEnv):
    """One of 200 rewards is a disaster, whatever the action."""

    n_steps = 0

    def step(self, action):
        obs, reward, *end = super().step(action)
        self.n_steps += 1
        return obs, reward - 1e6 * (self.n_steps % 200 == 0), *end


def test_learns_in_spite_of_rare_disasters():
    model = filled_model(Disasters(), n_transitions=400)
    model.train(400, 32)
    env = HybridIdentityEnv()
    obs, rewards = env.reset(seed=1)[0], []
    for _ in range(200):
        obs, reward, *_ = env.step(model.predict(obs, deterministic=True)[0])
        rewards.append(reward)
    # 0.09 by chance
    assert np.mean(rewards) > 0.35


def test_what_untrained_critics_put_out_is_no_value():
    value_scale = ValueScale()
    assert value_scale.values(th.randn(9, 1)).abs().max() < 1e-6
    assert value_scale.update(1e4 * th.randn(64, 2)) is None


@pytest.mark.parametrize(
    ("discount", "share_of_ends", "expected"),
    [(0.9, 0.0, 20.0), (0.9, 0.5, 2 / 0.55), (1.0, 0.25, 8.0), (1.0, 0.0, 200.0), (0.0, 0.0, 2.0)],
)
def test_values_start_at_that_of_an_average_state(discount, share_of_ends, expected):
    value_scale = ValueScale()
    discounts = th.full((100, 1), discount)
    discounts[: round(100 * share_of_ends)] = 0
    value_scale.start(th.tensor([[1.0], [3.0]]).repeat(50, 1), discounts)
    assert value_scale.values(th.randn(9, 1)).flatten().tolist() == pytest.approx([expected] * 9, rel=1e-5)


def test_rewards_that_are_no_numbers_do_not_start_values():
    value_scale = ValueScale()
    value_scale.start(th.tensor([[1.0], [th.inf]]), th.full((2, 1), 0.9))
    assert value_scale.center.tolist() == [0.0, 0.0]


def test_a_first_reward_after_none_is_bounded():
    value_scale = ValueScale()
    for _ in range(100):
        value_scale.update(th.zeros(64, 2))
    targets = th.zeros(64, 2)
    targets[0] = 1e5  # a value of a batch in which it is alone
    value_scale.update(targets)
    assert value_scale.outputs(targets)[:, 0].abs().max() <= np.sqrt(64 / MIN_UPDATE_WEIGHT)


@pytest.mark.parametrize("target", [False, True])
def test_values_stay_when_the_scale_changes(target):
    model = filled_model(HybridIdentityEnv())
    policy, data = model.policy, sample(model)
    critic = model.critic_target if target else model.critic
    policy.in_units_of_critics(th.randn(32, 2))

    def values():
        features = critic.features(data.observations)
        inputs = (features, data.latents, data.parameters)
        outputs, scale = th.cat([*critic.q_values(*inputs), critic.reward_network(*inputs)], dim=1), policy.value_scale.scale
        # What they stand for: two values and a reward
        return policy.value_scale.center[[0, 0, 1]] + scale * outputs, scale.item()

    policy.set_training_mode(False)
    for factor in (100.0, 0.01):
        expected, scale = values()
        for _ in range(20):
            policy.in_units_of_critics(factor * th.randn(32, 2))
        present, new_scale = values()
        assert abs(np.log(new_scale / scale)) > 0.1
        th.testing.assert_close(present, expected, rtol=1e-4, atol=1e-4)


class Units(HybridIdentityEnv):
    """Rewards in other units; episodes go on if they do not end by success."""

    def __init__(self, unit=1.0, offset=0.0, ends=True):
        super().__init__()
        self.unit, self.offset, self.ends = unit, offset, ends

    def step(self, action):
        obs, reward, terminated, *end = super().step(action)
        return obs, self.unit * (reward + self.offset), terminated and (self.ends or reward > 0), *end


def trained(unit, algorithm_class=CHDP, n_updates=30, **kwargs):
    model = filled_model(Units(unit, ends=False), algorithm_class, n_transitions=200, gamma=0.9, **kwargs)
    th.manual_seed(0)
    np.random.seed(0)
    model.train(n_updates, 32)
    model.policy.set_training_mode(False)
    return model


@pytest.mark.parametrize("policy_delay", [1, 2])
@pytest.mark.parametrize("unit", [1e-3, 1e4])
def test_units_of_rewards_do_not_matter(unit, policy_delay):
    """The same networks, the same actions, and values in the units of the rewards."""
    models = [trained(unit, policy_delay=policy_delay) for unit in (1.0, unit)]
    obs = np.stack([Units().reset(seed=i)[0] for i in range(40)])
    outputs, actions, q_means = [], [], []
    for model in models:
        data = sample_of(model)
        features = model.critic.features(data.observations)
        outputs.append(th.cat(model.critic.q_values(features, data.latents, data.parameters), dim=1).detach().numpy())
        actions.append(model.policy.predict_rows(obs, deterministic=True))
        q_means.append(model.logger.name_to_value["train/q_mean"])
    np.testing.assert_allclose(outputs[1], outputs[0], atol=0.02)
    assert q_means[1] / unit == pytest.approx(q_means[0], abs=0.01)
    assert (actions[0][:, 0] == actions[1][:, 0]).mean() > 0.9
    assert np.median(np.abs(actions[0] - actions[1])) < 0.02


class Endless(Units):
    """Episodes end by a time limit alone, beyond which values look."""

    def step(self, action):
        obs, reward, terminated, _, info = super().step(action)
        return obs, reward, False, terminated, info


def test_a_constant_in_all_rewards_does_not_matter():
    """Where episodes do not end on their own: the same networks, and values that differ by the constant's."""
    outputs, centers = [], []
    for offset in (0.0, -50.0):
        model = filled_model(Endless(offset=offset), n_transitions=200, gamma=0.9)
        th.manual_seed(0)
        np.random.seed(0)
        model.train(30, 32)
        data = sample_of(model)
        with th.no_grad():
            features = model.critic.features(data.observations)
            outputs.append(th.cat(model.critic.q_values(features, data.latents, data.parameters), dim=1))
        centers.append(model.policy.value_scale.center[0].item())
    th.testing.assert_close(outputs[1], outputs[0], rtol=0, atol=0.05)
    assert centers[1] - centers[0] == pytest.approx(-50 / (1 - 0.9), abs=0.5)


def sample_of(model):
    np.random.seed(1)
    return sample(model)


@pytest.mark.parametrize("unit", [1e-3, 1e4])
def test_logged_values_are_in_the_units_of_the_rewards(unit):
    model = filled_model(Units(unit, offset=5.0), n_transitions=200)
    model.train(300, 32)
    mean_reward = model.replay_buffer.rewards[:200].mean()
    # Episodes of one step: the reward is the return
    assert model.logger.name_to_value["train/q_mean"] == pytest.approx(mean_reward, rel=0.1)


def test_the_paper_has_the_units_of_the_rewards():
    model = trained(1e3, PaperCHDP)
    outputs = th.randn(5, 1)
    assert th.equal(model.policy.value_scale.values(outputs), outputs)


def test_saved_with_the_model(tmp_path):
    model = trained(1e3)
    model.save(tmp_path / "model")
    loaded = type(model).load(tmp_path / "model").policy.value_scale
    outputs = th.randn(5, 1)
    assert th.equal(loaded.values(outputs), model.policy.value_scale.values(outputs))
