"""Prioritised replay: what is drawn, how often, and what becomes of the priorities."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_chdp import CHDP
from sb3_chdp.common.buffers import PRIORITY_EPSILON, PrioritizedDictReplayBuffer, PrioritizedReplayBuffer
from tests.algorithms import FAST_CHDP, filled_model
from tests.hybrid_envs import HybridIdentityEnv, make_layout_env

BOX = spaces.Box(-np.inf, np.inf, (2,))


def filled_buffer(n_times=10, size=10, n_envs=4, **kwargs):
    """Time step t of environment e holds 100 t + e."""
    buffer = PrioritizedReplayBuffer(size * n_envs, BOX, spaces.Box(-1, 1, (1,)), "cpu", n_envs=n_envs, **kwargs)
    for t in range(n_times):
        number = 100.0 * t + np.arange(n_envs)
        obs = np.stack([number, -number], axis=1)
        infos = [{"TimeLimit.truncated": t % 3 == 0 and e == 1} for e in range(n_envs)]
        buffer.add(obs, obs + 0.5, number[:, None], number, np.arange(n_envs) == 1, infos)
    return buffer


def set_errors(buffer, errors):
    """Every transition has the given error, as if all had been in a batch."""
    buffer.update_priorities(tuple(np.indices(errors.shape).reshape(2, -1)), th.as_tensor(errors.reshape(-1)))


def numbers(batch):
    return batch.rewards.squeeze(1).numpy().astype(int)


@pytest.mark.parametrize("alpha, beta", [(0.6, 0.4), (1.0, 1.0), (0.0, 0.5)])
@pytest.mark.parametrize("n_times", [10, 700], ids="{} time steps".format)
def test_frequencies_and_weights(alpha, beta, n_times):
    """Priorities are summed up in blocks: of a small buffer all at once, of a larger one in parts."""
    buffer = filled_buffer(n_times, n_times, alpha=alpha, beta=beta)
    errors = np.random.default_rng(0).normal(size=(n_times, 4)) ** 3
    set_errors(buffer, errors)
    expected = (np.abs(errors) + PRIORITY_EPSILON) ** alpha
    expected /= expected.sum()
    batch = buffer.sample(40_000)
    drawn = numbers(batch)
    counts = np.zeros_like(expected)
    np.add.at(counts, (drawn // 100, drawn % 100), 1)
    # Stratified: a transition is drawn as often as it should be, give or take the two strata that it shares
    assert np.abs(counts - 40_000 * expected).max() <= 3
    weights = (expected.size * expected[drawn // 100, drawn % 100]) ** -beta
    np.testing.assert_allclose(batch.weights.squeeze(1), weights / weights.max(), rtol=1e-4)


def test_a_batch_holds_what_was_stored():
    batch = filled_buffer().sample(200)
    number = numbers(batch).astype(np.float32)
    np.testing.assert_array_equal(batch.observations, np.stack([number, -number], axis=1))
    np.testing.assert_array_equal(batch.next_observations, np.stack([number + 0.5, -number + 0.5], axis=1))
    np.testing.assert_array_equal(batch.actions[:, 0], number)
    # Where they are stored
    np.testing.assert_array_equal(batch.indices[0] * 100 + batch.indices[1], number)
    # Environment 1 is always done, in every third step for lack of time
    np.testing.assert_array_equal(batch.dones[:, 0], (number % 100 == 1) & (number // 100 % 3 != 0))
    assert batch.dones.any()


def test_new_transitions_have_the_highest_priority():
    buffer = filled_buffer(n_times=6)
    set_errors(buffer, np.full((6, 4), 5.0))
    buffer.update_priorities(buffer.sample(1).indices, th.tensor([-0.1]))
    assert buffer.priorities[:6].min() < 1 and buffer.priorities[6:].max() == 0, "nothing is there yet"
    buffer.add(np.zeros((4, 2)), np.zeros((4, 2)), np.zeros((4, 1)), np.zeros(4), np.zeros(4), [{}] * 4)
    np.testing.assert_allclose(buffer.priorities[6], (5 + PRIORITY_EPSILON) ** 0.6, rtol=1e-6)


def test_a_full_buffer_forgets_the_oldest():
    buffer = filled_buffer(n_times=13)
    drawn = np.concatenate([numbers(buffer.sample(4)) for _ in range(100)])
    assert set(drawn // 100) == set(range(3, 13))


@pytest.mark.parametrize(
    "kwargs, name",
    [(dict(alpha=-0.1), "alpha"), (dict(beta=1.1), "beta"),
     (dict(optimize_memory_usage=True, handle_timeout_termination=False), "memory")],
)  # fmt: skip
def test_bad_arguments(kwargs, name):
    with pytest.raises(ValueError, match=name):
        filled_buffer(**kwargs)


def test_dict_observations_need_the_buffer_for_dicts():
    with pytest.raises(ValueError, match="replay_buffer_class must be PrioritizedDictReplayBuffer for dict observations"):
        PrioritizedReplayBuffer(20, spaces.Dict(a=BOX), spaces.Box(-1, 1, (1,)), "cpu")


def test_observations_in_a_dict_are_normalised():
    env: Any = VecNormalize(make_vec_env(lambda: HybridIdentityEnv(), 2), norm_reward=False)
    env.obs_rms.mean, env.obs_rms.var = np.full(4, 2.0), np.full(4, 4.0)
    plain = PrioritizedReplayBuffer(20, env.observation_space, spaces.Box(-1, 1, (1,)), "cpu", n_envs=2)
    plain.add(np.full((2, 4), 6.0), np.zeros((2, 4)), np.zeros((2, 1)), np.zeros(2), np.zeros(2), [{}] * 2)
    batch: Any = plain.sample(3, env)
    np.testing.assert_allclose(batch.observations, 2.0, rtol=1e-6)

    space = spaces.Dict(a=BOX, b=spaces.Box(0, 1, (3,)))
    buffer = PrioritizedDictReplayBuffer(20, space, spaces.Box(-1, 1, (1,)), "cpu", n_envs=2)
    obs = dict(a=np.ones((2, 2)), b=np.full((2, 3), 0.5))
    buffer.add(obs, obs, np.zeros((2, 1)), np.zeros(2), np.zeros(2), [{}] * 2)
    batch = buffer.sample(5)
    assert batch.observations["a"].shape == (5, 2) and (batch.next_observations["b"] == 0.5).all()


def test_chdp_sets_priorities_to_the_errors_of_its_critics(tmp_path):
    """The larger error of both critics, before their step, in their own units."""
    env = make_vec_env(HybridIdentityEnv, 2, seed=0)
    model = filled_model(
        env,
        n_transitions=100,
        learning_rate=0.0,
        replay_buffer_class=PrioritizedReplayBuffer,
        replay_buffer_kwargs=dict(alpha=1.0),
    )
    buffer, columns = model.replay_buffer, model.hybrid_space.columns
    assert isinstance(buffer, PrioritizedReplayBuffer) and buffer.alpha == 1
    buffer.priorities[:50] = 7.0
    model.train(1, 16)
    changed = buffer.priorities[:50] != 7
    assert 0 < changed.sum() <= 16
    rows = th.as_tensor(buffer.actions[:50][changed])
    latents, parameters = model.actor.codebook(columns.discrete_actions(rows)), columns.view(rows, "parameters")
    model.policy.set_training_mode(False)
    with th.no_grad():
        features = model.critic.features(th.as_tensor(buffer.observations[:50][changed]))
        q_values = th.cat(model.critic.q_values(features, latents, parameters), dim=1)
    # Episodes of one step: the reward is the target
    rewards = th.as_tensor(buffer.rewards[:50][changed])[:, None]
    targets = model.policy.value_scale.outputs(th.cat([rewards, rewards], dim=1))[:, :1]
    expected = (q_values - targets).abs().max(dim=1).values
    np.testing.assert_allclose(buffer.priorities[:50][changed], expected + PRIORITY_EPSILON, rtol=1e-4)

    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = CHDP.load(tmp_path / "model", env=env)
    loaded.load_replay_buffer(tmp_path / "buffer")
    np.testing.assert_array_equal(loaded.replay_buffer.priorities, buffer.priorities)
    loaded.learn(20, reset_num_timesteps=False)


def test_chdp_prioritises_transitions_with_dict_observations():
    env = make_layout_env(observation_space=spaces.Dict(vector=spaces.Box(-1, 1, (2,))))
    model = CHDP("MultiInputPolicy", env, replay_buffer_class=PrioritizedDictReplayBuffer, **FAST_CHDP).learn(60)
    assert isinstance(model.replay_buffer, PrioritizedDictReplayBuffer)
    assert len(np.unique(model.replay_buffer.priorities[:60])) > 10, "they are updated"


def test_prioritised_replay_is_of_single_steps():
    with pytest.warns(UserWarning, match="n_steps=3.* is ignored"):
        CHDP("MlpPolicy", HybridIdentityEnv(), n_steps=3, replay_buffer_class=PrioritizedReplayBuffer)
