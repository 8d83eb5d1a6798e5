"""Whether what follows a reward counts in the choice of actions."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import CheckpointCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_chdp import CHDP
from sb3_chdp.chdp import PaperCHDP
from sb3_chdp.chdp.foresight import MIN_CLAIMS, Claims, ForesightSums, expected_outcomes, explore
from tests.algorithms import fast_model, filled_model, sample
from tests.hybrid_envs import MaskedEnv, box, make_layout_env


def weight(slope, noise, n=2000, of_rewards=1.0):
    """What is claimed of rewards comes true, or a share of it, of what follows a share."""
    rng, sums = np.random.default_rng(0), ForesightSums()
    for reward, follows in rng.normal(size=(n, 2)):
        sums = sums.add(reward, follows, of_rewards * reward + slope * follows + noise * rng.normal())
    return sums.weight()


def test_the_weight_is_what_comes_true_of_claims():
    assert weight(slope=1.0, noise=0.5) == weight(slope=0.6, noise=0.5) == 1
    assert weight(slope=0.25, noise=0.01) == pytest.approx(0.5, abs=0.01)
    assert weight(slope=0.0, noise=1.0) < 0.3
    assert weight(slope=-0.5, noise=1.0) == 0


def test_critics_that_are_wrong_about_rewards_are_no_evidence():
    assert weight(slope=0.0, noise=0.01, of_rewards=0.25) == pytest.approx(0.5, abs=0.01)
    assert weight(slope=-1.0, noise=1.0, of_rewards=-1.0) == 1


def test_errors_that_make_up_for_each_other_are_none():
    """Whether the reward is had at once, or follows, is often the last thing that critics learn."""
    rng, sums = np.random.default_rng(0), ForesightSums()
    for reward, follows, error in rng.normal(size=(2000, 3)) * [1, 1, 10]:
        sums = sums.add(reward + error, follows - error, reward + follows + 0.1 * rng.normal())
    assert sums.fy / sums.ff < 0.1 and sums.weight() == 1


def test_the_benefit_of_the_doubt():
    assert weight(slope=-1.0, noise=0.1, n=MIN_CLAIMS - 1) == 1
    assert weight(slope=0.0, noise=100.0) == 1
    assert ForesightSums(n=100.0, yy=1.0).weight() == 1, "nothing was claimed"
    assert ForesightSums(n=100.0, rr=1.0, rf=1.0, ff=1.0, yy=1.0).weight() == 1, "the same was claimed of both"


def test_old_claims_fade():
    sums = ForesightSums()
    for slope in (0.0, 1.0):
        for reward, follows in np.random.default_rng(0).normal(size=(3000, 2)):
            sums = sums.add(reward, follows, reward + slope * follows)
    assert sums.weight() == 1 and sums.n < 501


def test_claims_are_what_the_critics_say():
    """Of the rows that are taken, compared with others of the same observation; their mean is 0."""
    model = filled_model(make_layout_env("nested"))
    obs = th.rand(300, 2) * 2 - 1
    envs = np.arange(0, 300, 2)
    rows = model.policy.predict_rows(obs.numpy())[envs]
    claims = explore(model.policy, obs, rows, envs, np.random.default_rng(0))
    assert claims.rows.shape == rows.shape and (claims.envs == envs).all()
    with th.no_grad():
        values = expected_outcomes(model.policy, model.critic_target.features(obs)[envs], claims.rows)[:, 0].numpy()
    assert abs(claims.rewards.mean()) < 3 * claims.rewards.std() / np.sqrt(150)
    advantages = claims.rewards + claims.follows
    means = values - advantages
    # Two estimates of the same means
    assert np.corrcoef(means, claims.expected)[0, 1] > 0.5 and np.abs(means - claims.expected).max() > 1e-6
    assert abs(advantages.mean()) < 3 * advantages.std() / np.sqrt(150)


@pytest.mark.parametrize("foresight", [0.0, 0.5, 1.0])
def test_what_decides_between_actions(foresight):
    model = filled_model()
    data, policy = sample(model), model.policy
    policy.set_foresight(foresight)
    for critic in (model.critic, model.critic_target):
        features = critic.features(data.observations)
        inputs = (features, data.latents, data.parameters)
        rewards = critic.reward_network(*inputs)
        expected = [foresight * q + (1 - foresight) * rewards for q in critic.q_values(*inputs)]
        th.testing.assert_close(list(critic.scores(*inputs)), expected)
        th.testing.assert_close(critic.score1(*inputs), expected[0])


class Pairs(gym.Env):
    """
    Each of 20 steps is worth how near the parameter is to the first entry of the observation, and has a bonus, which is the
    second one: ``random`` and the same for all actions, or the discrete action of the step before.
    """

    def __init__(self, random):
        self.random = random
        self.observation_space, self.action_space = box(-1, 1, 2), spaces.Tuple((spaces.Discrete(2), box(-1, 1, 1)))

    def _observe(self, k):
        bonus = self.np_random.integers(2) if self.random else k
        self.obs = np.array([self.np_random.uniform(-1, 1), bonus], dtype=np.float32)
        return self.obs

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n_steps = 0
        return self._observe(0), {}

    def step(self, action):
        self.n_steps += 1
        reward = float(3 * self.obs[1] - abs(action[1][0] - self.obs[0]))
        return self._observe(int(action[0])), reward, False, self.n_steps == 20, {}


@pytest.mark.slow
def test_claims_come_true_where_actions_have_influence():
    sums = []
    for random in (True, False):
        model = fast_model(env=Pairs(random), learning_starts=100, gamma=0.9, train_freq=2, batch_size=64).learn(800)
        sums.append(model.foresight_sums)
        for critic in (model.critic, model.critic_target):
            assert critic.foresight == model.foresight_sums.weight()
    assert sums[1].fy / sums[1].ff > 0.5 and sums[1].weight() == 1
    assert abs(sums[0].fy) < 0.2 * sums[1].fy


def test_it_is_saved(tmp_path):
    model = fast_model(env=Pairs(False))
    model.policy.set_foresight(0.3)
    model.foresight_sums = ForesightSums(50.0, 1.0, 0.0, 1.0, 1.0, 0.1, 2.0)
    # Saves between an exploratory action and what follows it
    model.learn(30, CheckpointCallback(10, str(tmp_path)))
    model.save(tmp_path / "model")
    loaded = CHDP.load(tmp_path / "model", env=Pairs(False))
    assert ForesightSums(*loaded.foresight_sums) == model.foresight_sums
    for critic in (loaded.critic, loaded.critic_target):
        assert critic.foresight == 0.3
    loaded.learn(30, reset_num_timesteps=False)


def test_ends_of_episodes():
    """Nothing follows a terminal state; what follows a time limit is not known, as the next episode has begun."""
    model = filled_model(DummyVecEnv([lambda: make_layout_env("nested")] * 3))
    # All next states are worth the center, 2
    for network in model.critic_target.q_networks:
        for layer in (network.value[-1], network.advantage[-1]):
            for parameter in layer.parameters():
                parameter.zero_()
    for variance in (model.policy.value_scale.variance, model.policy.value_scale.upper_variance):
        variance.fill_(4.0)
    model.policy.value_scale.center[0] = 2.0
    claims = Claims(np.empty((3, 0)), np.arange(3), np.zeros(3), np.array([1.0, 10.0, 100.0]), np.array([0.5, 0.5, 0.5]))
    infos = [{}, {}, {"TimeLimit.truncated": True}]
    rewards = np.array([3.0, 4.0, 5.0], dtype=np.float32)
    model._check_claims(claims, claims.rows, model._last_obs, rewards, np.array([False, True, True]), infos)
    goes_on, ends = (3 + 2 * model.gamma - 2) / 2 - 0.5, (4 - 2) / 2 - 0.5
    assert model.foresight_sums.fy == pytest.approx(goes_on + 10 * ends, rel=0.01)


def test_claims_of_a_step_that_was_never_stored_are_forgotten():
    model = fast_model(learning_starts=10, learning_rate=0.0)
    model._exploration_rate = lambda: 1.0
    model.learn(40, StopTrainingOnMaxEpisodes(20))
    assert model._claims is not None
    model._setup_learn(10, reset_num_timesteps=False)
    assert model._claims is None


def test_masks_and_several_environments():
    model = fast_model(env=DummyVecEnv([MaskedEnv] * 3), learning_starts=10, gradient_steps=4)
    model.learn(300)
    assert ForesightSums(*model.foresight_sums).n > MIN_CLAIMS


def test_the_paper_looks_ahead():
    few = dict(learning_starts=10, gradient_steps=8)
    paper, model = (fast_model(algorithm, **few).learn(60) for algorithm in (PaperCHDP, CHDP))
    assert paper.critic.foresight == 1 and paper.foresight_sums == ForesightSums() != model.foresight_sums
