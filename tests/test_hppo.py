"""What is particular to HPPO: two ratios, masked densities, action masks."""

from concurrent.futures import ThreadPoolExecutor

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnvWrapper
from torch.distributions import Categorical, Normal

from sb3_chdp import HPPO
from sb3_chdp.common.hybrid_box import ConcatenatedBox
from sb3_chdp.hppo.distributions import HybridDistribution
from tests.algorithms import LAYOUTS, make_model
from tests.hybrid_envs import LayoutEnv, MaskedEnv, layouts, make_layout_env


def distribution_of(layout, batch_size=6):
    space = ConcatenatedBox(layouts()[layout])
    distribution = HybridDistribution(space)
    size = space.spec.n_discrete_actions + space.spec.n_parameters
    outputs = th.randn(batch_size, size, requires_grad=True)
    log_std = th.full((space.spec.n_parameters,), -0.5, requires_grad=True)
    return space, distribution.proba_distribution(outputs, log_std), outputs, log_std


@pytest.mark.parametrize("layout", LAYOUTS)
def test_log_prob_against_a_slow_loop(layout):
    space, distribution, outputs, log_std = distribution_of(layout)
    spec = space.spec
    rows = distribution.sample()
    logits, means = outputs[:, : spec.n_discrete_actions], outputs[:, spec.n_discrete_actions :]
    log_prob = distribution.log_prob(rows)
    for i, row in enumerate(rows):
        k = int(row[0])
        density = 0.0
        for j in spec.parameter_index[k][spec.parameter_mask[k]]:
            density += Normal(means[i, j], log_std[j].exp()).log_prob(row[1 + j])
        assert log_prob[i, 0].item() == pytest.approx(Categorical(logits=logits[i]).log_prob(row[0]).item(), abs=1e-5)
        assert log_prob[i, 1].item() == pytest.approx(th.as_tensor(density).item(), abs=1e-5)
    np.testing.assert_allclose(distribution.entropy().detach(), Categorical(logits=logits).entropy().detach(), atol=1e-6)
    assert (distribution.mode()[:, 0] == logits.argmax(dim=1)).all()


def test_parameters_of_other_actions_get_no_gradient():
    _, distribution, outputs, _ = distribution_of("nested")
    rows = distribution.sample().detach()
    distribution.log_prob(rows)[:, 1].sum().backward()
    owners = np.array([0, 0, 1])  # the third action has no parameters
    for i, k in enumerate(rows[:, 0].long()):
        gradients = outputs.grad[i, 3:]
        assert ((gradients != 0).numpy() == (owners == int(k))).all()
        assert (outputs.grad[i, :3] == 0).all()


def test_ratios_are_one_at_first():
    model = make_model(HPPO, make_vec_env(make_layout_env, 3))
    model.learn(30)
    # A new rollout, not yet learnt from
    model.collect_rollouts(model.env, QuietCallback(model), model.rollout_buffer, model.n_steps)
    for rollout_data in model.rollout_buffer.get(7):
        _, log_prob, _ = model.policy.evaluate_actions(rollout_data.observations, rollout_data.actions)
        assert log_prob.shape == rollout_data.old_log_prob.shape
        assert rollout_data.advantages.shape == (len(log_prob), 1)
        np.testing.assert_allclose(th.exp(log_prob - rollout_data.old_log_prob).detach(), 1.0, atol=1e-4)


class QuietCallback(BaseCallback):
    def __init__(self, model):
        super().__init__()
        self.init_callback(model)

    def _on_step(self):
        return True


class NoReward(LayoutEnv):
    def step(self, action):
        obs, _, *rest = super().step(action)
        return (obs, 0, *rest)


@pytest.mark.parametrize("vec_env_cls", [DummyVecEnv, SubprocVecEnv])
def test_time_limits_bootstrap(vec_env_cls):
    """Episodes end by truncation only: with reward 0, a whole number, all returns come from the value function."""
    env = make_vec_env(lambda: NoReward(layouts()["nested"]), vec_env_cls=vec_env_cls)
    # At this rate the value function stays what it is
    model = make_model(HPPO, env, gae_lambda=1.0, gamma=1.0, learning_rate=0.0)
    with th.no_grad():
        for parameter in model.policy.value_net.parameters():
            parameter.fill_(0.0)
        model.policy.value_net.bias.fill_(5.5)
    model.learn(10)
    env.close()
    np.testing.assert_allclose(model.rollout_buffer.returns, 5.5, atol=1e-5)


def test_without_the_last_observation_of_an_episode():
    """As in SB3's PPO nothing bootstraps then."""

    class Forgetful(VecEnvWrapper):
        def reset(self):
            return self.venv.reset()

        def step_wait(self):
            obs, rewards, dones, infos = self.venv.step_wait()
            return obs, rewards, dones, [{k: v for k, v in info.items() if k != "terminal_observation"} for info in infos]

    env = make_vec_env(lambda: gym.wrappers.TimeLimit(make_layout_env(), 3), 2)
    make_model(HPPO, Forgetful(env)).learn(40)


def test_batch_size_of_one():
    with pytest.raises(ValueError, match="batch_size"):
        make_model(HPPO, make_layout_env(), batch_size=1)


def test_a_schedule_at_the_end():
    """The last rollout goes beyond the end of the training."""
    model = make_model(HPPO, make_layout_env(), n_steps=10, batch_size=5, learning_rate=lambda left: 1e-3 * left)
    model.learn(15)
    assert model.num_timesteps == 20 and model.policy.optimizer.param_groups[0]["lr"] == 0.0


def test_a_buffer_that_is_not_hybrid():
    with pytest.raises(ValueError, match="rollout_buffer_class must be a HybridRolloutBuffer, got"):
        make_model(HPPO, make_layout_env(), rollout_buffer_class=RolloutBuffer)


def test_a_truncated_minibatch():
    with pytest.warns(UserWarning, match="has only 2 transitions: n_steps \\* n_envs = 10 is no multiple of batch_size=4"):
        make_model(HPPO, make_layout_env(), n_steps=10, batch_size=4)


def test_parameters_of_a_distribution():
    """SB3's two methods that take the parameters and keep them."""
    policy = make_model(HPPO, make_layout_env()).policy
    outputs = policy.action_net(th.rand(5, 8))
    rows = policy.action_dist.actions_from_params(outputs, policy.log_std, deterministic=True)
    th.testing.assert_close(rows, policy.action_dist.proba_distribution(outputs, policy.log_std).mode())
    rows, log_prob = policy.action_dist.log_prob_from_params(outputs, policy.log_std)
    th.testing.assert_close(log_prob, policy.action_dist.proba_distribution(outputs, policy.log_std).log_prob(rows))


def test_masks_are_an_argument_and_no_state():
    """Threads that share a model, each with its own mask, never get an action that theirs forbids."""
    model = make_model(HPPO, MaskedEnv())
    obs, masks = np.zeros((4, 3), dtype=np.float32), np.eye(3, dtype=bool)

    def forbidden(i):
        k = i % 3
        actions = model.predict(obs, action_masks=np.tile(masks[k], (4, 1)))[0]
        return sum(int(action[0]) != k for action in actions)

    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(forbidden, range(2400))) == 0
    # And the next one is free again
    assert {int(action[0]) for action in model.predict(np.zeros((100, 3), dtype=np.float32))[0]} == {0, 1, 2}


def test_forward_takes_masks():
    model = make_model(HPPO, MaskedEnv())
    rows, values, log_probs = model.policy(th.zeros(3, 3), action_masks=np.eye(3, dtype=bool))
    assert rows[:, 0].tolist() == [0, 1, 2] and values.shape == (3, 1)
    # Each had no choice
    np.testing.assert_allclose(log_probs[:, 0].detach(), 0, atol=1e-6)
    # The rows remember the masks
    _, again, entropy = model.policy.evaluate_actions(th.zeros(3, 3), rows)
    th.testing.assert_close(again, log_probs)
    np.testing.assert_allclose(entropy.detach(), 0, atol=1e-6)
