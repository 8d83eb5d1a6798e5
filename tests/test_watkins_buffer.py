"""n-step returns that end before costly actions: how long they are, what they hold, and what costs are."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_chdp import CHDP
from sb3_chdp.chdp import PaperCHDP
from sb3_chdp.chdp.chdp import LARGEST_COST
from sb3_chdp.common import watkins_buffer
from sb3_chdp.common.watkins_buffer import WatkinsDictReplayBuffer, WatkinsReplayBuffer, change_rate
from tests.algorithms import fast_model, filled_model, sample
from tests.hybrid_envs import GoalEnv, HybridIdentityEnv, layouts
from tests.test_returns import counting_env

GAMMA = 0.9
PRIZE = 10.0


class Late(gym.Env):
    """Twenty steps, whatever is done, and a prize in the end."""

    observation_space = spaces.Box(0.0, 1.0, (1,))
    action_space = layouts()["shared"]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        done = self.t == 20
        return np.full(1, self.t / 20, np.float32), PRIZE * done, done, False, {}


@pytest.fixture
def endless(monkeypatch):
    """Returns do not end at random."""
    monkeypatch.setattr(watkins_buffer, "DECAY", 1.0)


def batch_of(model, costs, tolerance=0.0, n=400, random_cost=0.0, change_rate=0.0):
    """:return: a batch if all stored actions have the given costs, random ones on average, and observations change so fast"""
    model.replay_buffer.change_rate, model.replay_buffer.n_seen = change_rate, np.inf
    model.replay_buffer.costs[:] = costs
    model.replay_buffer.random_cost = random_cost
    model.replay_buffer.tolerance = tolerance
    return sample(model, n)


def counting_model(*lengths, n_transitions=80, **kwargs):
    """Rewards are 1, 2, 3 and so on, and so are the last returns of the rows."""
    return filled_model(counting_env(*lengths), n_transitions=n_transitions, gamma=GAMMA, **kwargs)


def test_costless_actions_are_passed_until_the_episode_ends(endless):
    data = batch_of(counting_model(4, 2), 0.0)
    lengths = [round(n) for n in (data.discounts[:, 0].log() / np.log(GAMMA)).tolist()]
    first = data.first_rewards[:, 0].tolist()
    values = [sum(GAMMA**i * (reward + i) for i in range(n)) for reward, n in zip(first, lengths, strict=True)]
    np.testing.assert_allclose(data.rewards[:, 0], values, rtol=1e-5)
    # Of an episode of 4 steps and of one of 2; the newest transitions are the end of what is known
    assert {(1, 4), (2, 3), (3, 2), (4, 1), (1, 2), (2, 1)} <= set(zip(first, lengths, strict=True))
    # What rows say about the next state is that of the last step
    assert {10, 3} <= set(data.next_returns[:, 0].tolist()) <= {10, 3, 6, 1}


def test_at_most_so_many_steps(endless):
    model = counting_model(50, replay_buffer_class=WatkinsReplayBuffer, replay_buffer_kwargs=dict(n_steps=3))
    assert batch_of(model, 0.0).discounts.min() == pytest.approx(GAMMA**3)


@pytest.mark.parametrize("cost, n", [(np.inf, 1), (0.6, 2), (0.4, 3), (0.3, 4)])
def test_returns_end_before_what_costs_too_much(endless, cost, n):
    """The action that is valued itself may cost what it likes."""
    data = batch_of(counting_model(50), cost, tolerance=1.0)
    assert data.discounts.min() == pytest.approx(GAMMA**n)
    assert (data.discounts == data.discounts.min()).float().mean() > 0.8


@pytest.mark.parametrize("random_cost, n", [(0.9, 1), (0.8, 2), (0.6, 3), (0.5, 4)])
def test_returns_are_short_where_each_action_matters(endless, random_cost, n):
    """What a random action costs counts in advance."""
    data = batch_of(counting_model(50), 0.15, tolerance=1.0, random_cost=random_cost)
    assert data.discounts.min() == pytest.approx(GAMMA**n)


@pytest.mark.parametrize("change_rate, is_long", [(0.049, True), (0.051, False), (np.inf, False)])
def test_returns_have_one_step_where_observations_change_fast(change_rate, is_long):
    """Within the 20 steps that a return has at most."""
    data = batch_of(counting_model(50), 0.0, change_rate=change_rate)
    assert (data.discounts < 0.99 * GAMMA).any() == is_long


def random_walk(rng, n, kept):
    """:return: (n, 1) steps of an autocorrelation"""
    walk = [rng.normal()]
    for noise in rng.normal(size=n - 1):
        walk.append(kept * walk[-1] + np.sqrt(1 - kept**2) * noise)
    return np.array(walk)[:, None]


@pytest.mark.parametrize("kept", [0.0, 0.5, 0.95])
def test_change_rate(kept):
    """It does not depend on units, and leaves out what does not change."""
    walk = random_walk(np.random.default_rng(0), 20_000, kept)
    before, after = walk[:-1], walk[1:]
    assert change_rate(before, after) == pytest.approx(1 - kept, rel=0.1)
    per_episode, constant = np.repeat([[1.0], [2.0]], len(before) // 2 + 1, axis=0)[: len(before)], np.ones((len(before), 1))
    more = np.hstack([1e4 + 1e3 * before, per_episode, constant]), np.hstack([1e4 + 1e3 * after, per_episode, constant])
    assert change_rate(*more) == pytest.approx(change_rate(before, after))
    assert change_rate(constant, constant) == np.inf


@pytest.mark.parametrize("env_id", ["Pendulum-v1", "Platform-v0", "Goal-v0", "HardGoal-v0", "CatchPoint-v0", "HardMove4-v0"])
def test_observations_of_the_benchmarks_change_fast(env_id):
    """Those of a pendulum do not."""
    env = gym.make(env_id)
    env.action_space.seed(0)
    obs, _ = env.reset(seed=0)
    steps = []
    for _ in range(300):
        new_obs, _, terminated, truncated, _ = env.step(env.action_space.sample())
        steps.append((obs, new_obs))
        obs = env.reset()[0] if terminated or truncated else new_obs
    assert (change_rate(*np.array(steps).swapaxes(0, 1)) * watkins_buffer.MAX_STEPS < 1) == (env_id == "Pendulum-v1")


@pytest.mark.parametrize("max_entries, stride", [(512, 1), (1, 3)])
def test_the_first_transitions_tell_how_fast_observations_change(monkeypatch, max_entries, stride):
    """As many as there are and count, in parts if observations are dicts, of long ones some entries."""
    monkeypatch.setattr(watkins_buffer, "N_FIRST", 60)
    monkeypatch.setattr(watkins_buffer, "MAX_ENTRIES", max_entries)
    model = filled_model(GoalEnv(), policy="MultiInputPolicy", n_transitions=20)
    buffer = model.replay_buffer

    def expected(n):
        stored = buffer.observations, buffer.next_observations
        return change_rate(*(np.hstack([part[:n, 0, ::stride] for part in parts.values()]) for parts in stored))

    sample(model, 10)
    assert buffer.change_rate == pytest.approx(expected(20))
    model.learn(100, reset_num_timesteps=False)
    sample(model, 10)
    assert buffer.change_rate == pytest.approx(expected(60))
    assert len({expected(20), expected(60), expected(120)}) == 3


def test_returns_end_at_random():
    """After each step, so that costs are asked for again."""
    data = batch_of(counting_model(80), 0.0, n=20_000)
    assert (data.discounts == GAMMA).float().mean() == pytest.approx(1 - watkins_buffer.DECAY, abs=0.03)


def test_new_transitions_have_unknown_costs():
    model = counting_model(4)
    model.replay_buffer.costs[:] = 0
    before = model.replay_buffer.pos
    model.learn(3, reset_num_timesteps=False)
    costs = model.replay_buffer.costs[before : model.replay_buffer.pos, 0]
    assert costs.tolist() == [np.inf] * 3


@pytest.mark.parametrize("n_envs", [1, 3])
def test_costs_are_those_of_the_actions_that_followed(n_envs):
    """By how much the critics value them less than what the target policies would do."""
    model = filled_model(counting_env(*[50] * n_envs), n_transitions=90)
    buffer = model.replay_buffer
    data = sample(model, 60)
    times, envs = data.next_indices
    np.testing.assert_array_equal(data.next_actions, buffer.actions[times, envs])
    goes_on = th.zeros(60, 1)
    buffer.update_costs(data.next_indices, th.stack([th.arange(60.0) - 1, th.full((60,), 2.0)], dim=1), goes_on)
    assert buffer.costs[times[-1], envs[-1]] == 58 and buffer.costs.min() >= 0
    assert np.isinf(buffer.costs).any()
    # A running mean
    assert buffer.random_cost == 2
    buffer.update_costs(data.next_indices, th.full((60, 2), 4.0), goes_on)
    assert buffer.random_cost == pytest.approx(2 + 2 * watkins_buffer.COST_RATE)
    # Nothing follows the end of an episode
    before = buffer.random_cost
    buffer.update_costs(data.next_indices, th.full((60, 2), 9.0), 1 - goes_on)
    assert buffer.random_cost == before

    model.train(30, 64)
    assert np.isfinite(buffer.costs[1 : buffer.pos]).mean() > 0.9
    assert buffer.tolerance == LARGEST_COST


def test_without_foresight_returns_have_one_step(monkeypatch):
    model = filled_model()
    monkeypatch.setattr(type(model.foresight_sums), "weight", lambda self: 0.0)
    model.train(1, 16)
    assert model.replay_buffer.tolerance == 0


def test_rewards_are_normalised():
    model = filled_model(VecNormalize(counting_env(50)), n_transitions=40)
    model._vec_normalize_env.ret_rms.var = np.array(4.0)
    data = batch_of(model, np.inf)
    assert set(data.rewards[:, 0].tolist()) == set(data.first_rewards[:, 0].tolist())
    assert data.rewards.max() == pytest.approx(min(40 / 2, 10), rel=1e-3)


def test_dict_observations_need_another_class():
    with pytest.raises(ValueError, match="replay_buffer_class must be WatkinsDictReplayBuffer for dict observations"):
        fast_model(env=GoalEnv(), policy="MultiInputPolicy", replay_buffer_class=WatkinsReplayBuffer)


def test_it_is_the_default():
    assert isinstance(fast_model().replay_buffer, WatkinsReplayBuffer)
    assert type(fast_model(n_steps=3).replay_buffer) is not WatkinsReplayBuffer
    assert isinstance(fast_model(n_steps=3).replay_buffer, NStepReplayBuffer)
    assert type(fast_model(replay_buffer_class=ReplayBuffer).replay_buffer) is ReplayBuffer
    assert type(fast_model(algorithm_class=PaperCHDP).replay_buffer) is ReplayBuffer
    frugal = dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False))
    assert type(fast_model(**frugal).replay_buffer) is ReplayBuffer


def gain_of_time(seed):
    """:return: by how much a late state is worth more than an early one after 150 updates, in prizes. Truth: 0.97 - 0.56"""
    model = filled_model(Late(), n_transitions=300, gamma=0.97, seed=seed)
    model.train(150, 64)
    with th.no_grad():
        features = model.critic.features(th.tensor([[0.0], [0.9]]))
        latents, _, parameters = model.actor.random_actions(2)
        values, _ = model.critic.q_values(features, latents, parameters)
    early, late = model.policy.value_scale.values(values)[:, 0].tolist()
    return (late - early) / PRIZE


def test_what_comes_late_is_learnt_early():
    """Returns of one step are at 0.15."""
    assert np.mean([gain_of_time(seed) for seed in range(3)]) > 0.28


def test_dict_observations():
    """The same batches, in parts."""
    model = filled_model(GoalEnv(), policy="MultiInputPolicy", n_transitions=200)
    buffer = model.replay_buffer
    assert type(buffer) is WatkinsDictReplayBuffer
    data = batch_of(model, 0.0, n=50)
    assert (data.discounts < model.gamma).any()
    times, envs = data.next_indices
    for key, part in data.next_observations.items():
        np.testing.assert_array_equal(part, buffer.next_observations[key][times - 1, envs])
        stored = buffer.observations[key][: buffer.pos, 0]
        assert all((stored == obs.numpy()).all(axis=1).any() for obs in data.observations[key])
    buffer.costs[:] = buffer.random_cost = np.inf
    model.train(5, 16)
    assert np.isfinite(buffer.costs).any() and np.isfinite(buffer.random_cost)


def test_saved_costs(tmp_path):
    model = CHDP("MlpPolicy", HybridIdentityEnv(), learning_starts=20, n_diffusion_steps=2, batch_size=8).learn(60)
    model.save_replay_buffer(tmp_path / "buffer")
    other = CHDP("MlpPolicy", HybridIdentityEnv())
    other.load_replay_buffer(tmp_path / "buffer")
    np.testing.assert_array_equal(other.replay_buffer.costs, model.replay_buffer.costs)
    assert other.replay_buffer.random_cost == model.replay_buffer.random_cost > 0
