"""What episodes have returned before an action: rows hold it, and critics that value next states know it."""

from functools import partial

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stable_baselines3.her import HerReplayBuffer

from sb3_chdp import CHDP
from sb3_chdp.chdp import PaperCHDP, losses
from tests.algorithms import calls_of, filled_model, sample
from tests.hybrid_envs import GoalEnv, LayoutEnv, layouts

ADVANCE, FINISH = 0, 1
BONUS, PRIZE = 10.0, 8.0


class OnceOnly(gym.Env):
    """
    Advancing leads to the second place and back. Its bonus is paid once per episode, which nothing shows; to finish in the
    second place earns a prize.
    """

    observation_space = spaces.Box(0.0, 1.0, (1,))
    action_space = spaces.Tuple((spaces.Discrete(2), spaces.Box(-1.0, 1.0, (1,))))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.second, self.paid = False, False
        return np.zeros(1, np.float32), {}

    def step(self, action):
        reward, finished = 0.0, False
        if action[0] == ADVANCE:
            self.second = not self.second
            if self.second and not self.paid:
                reward, self.paid = BONUS, True
        elif self.second:
            reward, finished = PRIZE, True
        return np.full(1, self.second, np.float32), reward, finished, False, {}


def advantage_of_going_back(algorithm_class, seed):
    """:return: how much more than to finish it is said to be worth, after 300 gradient steps on random actions"""
    env = gym.wrappers.TimeLimit(OnceOnly(), 4)
    model = filled_model(env, algorithm_class, 300, gamma=0.95, tau=0.05, seed=seed)
    model.train(300, 64)
    critic, actor = model.critic_target, model.actor_target
    with th.no_grad():
        features = critic.features(th.ones(2, 1))
        latents = actor.codebook.representative_latents(th.tensor([ADVANCE, FINISH]))
        q1, q2 = critic.q_values(features, latents, th.zeros(2, 1))
    advance, finish = model.policy.value_scale.values((q1 + q2) / 2)[:, 0].tolist()
    return advance - finish


class Unaware(CHDP):
    """CHDP whose critics are not told."""

    knows_returns = False


def test_a_bonus_that_is_paid_once_does_not_look_as_if_it_came_again():
    """Two steps later the prize is worth 0.95^2 of it. Critics that are not told say 4 times as much."""
    assert advantage_of_going_back(CHDP, seed=1) < 1 < 15 < advantage_of_going_back(Unaware, seed=1)


class Counting(LayoutEnv):
    """Rewards of 1, 2, 3 and so on."""

    def step(self, action):
        obs, _, terminated, truncated, info = super().step(action)
        return obs, float(self.t), terminated, truncated, info


def counting_env(*lengths):
    return DummyVecEnv([partial(Counting, layouts()["shared"], episode_length=n) for n in lengths])


@pytest.mark.parametrize("wrapper", [lambda env: env, VecNormalize])
def test_rows_hold_returns(wrapper):
    """Those of the episode so far, as the environment gave the rewards."""
    model = filled_model(wrapper(counting_env(4, 3)), n_transitions=20)
    rows, columns = model.replay_buffer.actions[:10], model.hybrid_space.columns
    assert columns.view(rows, "returns")[..., 0].T.tolist() == [[0, 1, 3, 6, 0, 1, 3, 6, 0, 1], [0, 1, 3, 0, 1, 3, 0, 1, 3, 0]]
    then = [[1, 3, 6, 10, 1, 3, 6, 10, 1, 3], [1, 3, 6, 1, 3, 6, 1, 3, 6, 1]]
    assert columns.view(rows, "next_returns")[..., 0].T.tolist() == then


def test_training_that_a_callback_stopped_begins_with_a_new_episode():
    model = filled_model(counting_env(4), n_transitions=1)
    model.learn(100, callback=StopTrainingOnMaxEpisodes(2))
    pos = model.replay_buffer.pos
    model.learn(4, reset_num_timesteps=False)
    returns = model.hybrid_space.columns.view(model.replay_buffer.actions[pos : pos + 4, 0], "returns")
    assert returns[:, 0].tolist() == [0, 1, 3, 6]


def test_hindsight_has_no_returns():
    model = CHDP("MultiInputPolicy", GoalEnv(), replay_buffer_class=HerReplayBuffer, buffer_size=100)
    assert "returns" not in model.hybrid_space.columns and model.critic.return_normalization is None


def test_returns_after_n_steps():
    """Those after the last of them, or where the episode ends."""
    model = filled_model(counting_env(4, 2), n_transitions=80, n_steps=3)
    data = sample(model, 200)
    pairs = set(zip(data.returns[:, 0].tolist(), data.next_returns[:, 0].tolist(), strict=True))
    assert pairs == {(0, 6), (1, 10), (3, 10), (6, 10), (0, 3), (1, 3)}


def test_next_values_know_returns_and_actions_do_not():
    model = filled_model()
    targets, values = (calls_of(critic.q_networks[0]) for critic in (model.critic_target, model.critic))
    data = sample(model)
    losses.target_values(model.policy, data)
    (features, *_), *_ = targets
    assert (features[:, -1] == 1).all() and len(features[:, -2].unique()) > 1
    model.predict(data.observations.numpy())
    # What chooses next actions, and what acts
    assert all((features[:, -2:] == 0).all() for features, *_ in [*values, *targets[1:]])
    losses.critic_loss(model.policy, data, model.critic.features(data.observations), th.zeros(len(data.rewards), 1))
    assert [features[:, -1].mean().item() for features, *_ in values[-2:]] == [0, 1]


def test_half_of_the_critic_loss_is_of_critics_that_know_returns():
    model = filled_model()
    model.policy.set_training_mode(False)
    data, targets = sample(model), th.randn(32, 1)
    features = model.critic.features(data.observations)
    both, q1, _ = losses.critic_loss(model.policy, data, features, targets)
    unaware, q1_unaware, _ = losses.critic_loss(model.policy, data._replace(returns=None), features, targets)
    q_values = th.cat(model.critic.q_values(features, data.latents, data.parameters, data.returns), dim=1)
    th.testing.assert_close(both, (unaware + (q_values - targets).square().sum(dim=1).mean()) / 2)
    th.testing.assert_close(q1, q1_unaware)


def test_the_paper_does_not_know_returns():
    model = filled_model(algorithm_class=PaperCHDP)
    assert "returns" not in model.hybrid_space.columns and sample(model).returns is None
    assert model.critic.return_normalization is None
