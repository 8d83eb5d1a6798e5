"""What episodes have returned before an action: rows hold it, and the values of next states depend on it."""

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
    """:return: how much more than to finish it is said to be worth, after 600 gradient steps on random actions"""
    env = gym.wrappers.TimeLimit(OnceOnly(), 4)
    model = filled_model(env, algorithm_class, 300, gamma=0.95, tau=0.05, seed=seed)
    model.train(600, 64)
    critic, actor = model.critic_target, model.actor_target
    with th.no_grad():
        features = critic.features(th.ones(2, 1))
        latents = actor.codebook.representative_latents(th.tensor([ADVANCE, FINISH]))
        q1, q2 = critic.q_values(features, latents, th.zeros(2, 1))
    advance, finish = model.policy.value_scale.values((q1 + q2) / 2)[:, 0].tolist()
    return advance - finish


class Unaware(CHDP):
    """CHDP whose targets do not know returns."""

    knows_returns = False


def test_a_bonus_that_is_paid_once_does_not_look_as_if_it_came_again():
    """Two steps later the prize is worth 0.95^2 of it. Critics that do not know returns say far more."""
    assert advantage_of_going_back(CHDP, seed=1) < 5 < 15 < advantage_of_going_back(Unaware, seed=1)


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
    assert "returns" not in model.hybrid_space.columns and model.critic.return_network is None


def test_returns_after_n_steps():
    """Those after the last of them, or where the episode ends."""
    model = filled_model(counting_env(4, 2), n_transitions=80, n_steps=3)
    data = sample(model, 200)
    pairs = set(zip(data.returns[:, 0].tolist(), data.next_returns[:, 0].tolist(), strict=True))
    assert pairs == {(0, 6), (1, 10), (3, 10), (6, 10), (0, 3), (1, 3)}


def test_next_values_know_returns_and_actions_do_not():
    model = filled_model(counting_env(4))
    data = sample(model)
    targets, losses_of = (calls_of(critic.return_network) for critic in (model.critic_target, model.critic))
    losses.target_values(model.policy, data)
    # Of the best action, of the one that was taken and of a random one
    assert len(targets) == 3 and all(th.equal(inputs[3], data.next_returns) for inputs in targets)
    model.train(1, 32)
    assert len(targets) == 6 and len(losses_of) == 1
    model.predict(data.observations.numpy())
    assert len(targets) == 6 and len(losses_of) == 1


def test_what_returns_add():
    """To the value of the next state, the smaller one of both critics."""
    model = filled_model(counting_env(4))
    data, policy = sample(model)._replace(dones=0.0, discounts=1.0), model.policy
    policy.in_units_of_critics(th.randn(32, 2))
    th.manual_seed(0)
    before, _ = losses.target_values(policy, data)
    # Nothing yet
    th.manual_seed(0)
    th.testing.assert_close(before, losses.target_values(policy, data._replace(next_returns=None))[0])
    model.critic_target.return_network.forward = lambda features, latents, parameters, returns: returns
    th.manual_seed(0)
    added = losses.target_values(policy, data)[0][:, 0] - before[:, 0]
    th.testing.assert_close(added, policy.value_scale.scale * data.next_returns[:, 0].double())


def test_return_loss():
    model = filled_model(counting_env(4))
    data, errors = sample(model)._replace(weights=3.0), th.randn(32, 1)
    features = model.critic.features(data.observations).detach()
    with th.no_grad():
        for parameter in model.critic.return_network.parameters():
            parameter.add_(0.1)
    model.policy.set_training_mode(False)
    summands = model.critic.return_network(features, data.latents, data.parameters, data.returns)
    loss = losses.return_loss(model.policy, data, features, errors)
    th.testing.assert_close(loss, 3 * (summands - errors).square().mean())


def test_the_paper_does_not_know_returns():
    model = filled_model(algorithm_class=PaperCHDP)
    assert "returns" not in model.hybrid_space.columns and sample(model).returns is None
    assert model.critic.return_network is None
