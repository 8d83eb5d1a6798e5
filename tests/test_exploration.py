"""When CHDP explores, and what its exploratory actions are."""

import inspect
from functools import partial

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_chdp import CHDP
from sb3_chdp.chdp import exploration
from sb3_chdp.chdp.exploration import (
    ReturnSums,
    exploration_rate,
    informative_steps,
    random_parameters,
    reflect,
    vary_parts,
)
from tests.algorithms import fast_model, filled_model, has_learnt, snapshot
from tests.hybrid_envs import LayoutEnv, box, layouts, make_layout_env


def test_the_rate_falls():
    rates = [exploration_rate(n, n, n // 1000, 4) for n in (0, 10, 100, 1000, 10_000, 100_000)]
    assert rates[0] == 1 and np.all(np.diff(rates) < 0) and rates[-1] < 0.1


@pytest.mark.parametrize("n_actions", [2, 1000])
def test_half_of_it_is_left_when_the_half_life_is_over(n_actions):
    half_life = exploration.HALF_LIFE + n_actions * exploration.HALF_LIFE_PER_ACTION
    assert exploration_rate(half_life, half_life, 0, n_actions) == pytest.approx(0.5)


def test_more_discrete_actions_take_longer():
    rates = [exploration_rate(5000, 5000, 0, n_actions) for n_actions in (1000, 10, 2)]
    assert rates[0] > rates[1] > rates[2]


def test_some_actions_of_an_episode_keep_exploring():
    """The same number whether episodes are of 20 or 200 steps, but a share at most if they are short."""
    n = 10**7
    per_episode = [length * exploration_rate(n, n, n // length, 4) for length in (20, 50, 200)]
    np.testing.assert_allclose(per_episode, exploration.ACTIONS_PER_EPISODE, rtol=1e-3)
    assert exploration_rate(n, n, n, 4) == exploration_rate(n, n, n // 2, 4) == exploration.MAX_FINAL_RATE < 1
    # Endless episodes end it
    assert exploration_rate(n, n, 0, 4) < 0.01


def test_it_follows_from_the_steps_whatever_the_length_of_the_training():
    rates = []
    for total in (60, 600):
        model = fast_model(env=make_layout_env(), gradient_steps=0)
        seen: list = []

        def note(local_values, _, model=model, seen=seen):
            seen.append(model.logger.name_to_value.get("rollout/exploration_rate"))
            return len(seen) < 60

        model.learn(total, callback=note, log_interval=10**6)
        rates.append(seen[1:])
    assert rates[0] == rates[1] and None not in rates[0]
    assert rates[0][-1] < rates[0][0] <= 1


def share_of(returns):
    sums = ReturnSums()
    for value in returns:
        sums = sums.add(value)
    return sums.informative_share()


def test_share_of_informative_returns():
    rng = np.random.default_rng(0)
    assert share_of(rng.normal(1e4, 5.0, 1000)) > 0.5 and share_of(rng.uniform(-1e-3, 1e-3, 1000)) > 0.5
    for rate in (0.01, 0.05):
        rare = rng.random(5000) < rate
        assert rate < share_of(100.0 * rare - 7.0) < 5 * rate
        assert share_of(-100.0 * rare) == 1.0
    assert share_of(np.ones(1000)) == 0.0
    # Too few to tell
    assert share_of(np.ones(5)) == share_of([]) == 1.0


def test_rounding_is_no_difference():
    returns = ReturnSums()
    for i in range(100):
        returns = returns.add(-1e3 * (1 + 1e-9 * (i % 3)))
    assert returns.informative_share() == 0.0


@pytest.mark.slow
def test_many_environments_explore_until_something_is_learnt():
    """Their steps are many before the first gradient steps."""
    rates = {}
    for n_envs in (1, 32):
        model = fast_model(env=DummyVecEnv([make_layout_env] * n_envs)).learn(600, log_interval=10**6)
        rates[n_envs] = model._exploration_rate()
    assert rates[32] > 0.7 > 0.5 > rates[1]


def test_steps_that_told_nothing_do_not_count():
    rare = ReturnSums(n=1000, mean=0.02, absolute=40.0, square=20.0, cube=20.0)
    assert informative_steps(8, ReturnSums()) == 8 and 0 < informative_steps(8, rare) < 0.5
    assert exploration_rate(10_000, 200.0, 0, 4) > 0.5 > 0.1 > exploration_rate(10_000, 10_000.0, 0, 4)
    # A training that begins anew explores anew
    assert exploration_rate(0, 10_000.0, 0, 4) == 1


class Rewarded(LayoutEnv):
    """An episode of 5 steps, all of them with the same reward, but in one of ``every`` episodes."""

    def __init__(self, every):
        super().__init__(layouts()["shared"], episode_length=5)
        self.every, self.n = every, 0

    def reset(self, **kwargs):
        self.n += 1
        return super().reset(**kwargs)

    def step(self, action):
        obs, _, *end = super().step(action)
        return obs, -1.0 + 10.0 * (self.n % self.every == 0), *end


@pytest.mark.parametrize("wrap", [lambda env: env, VecNormalize])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_it_explores_on_while_success_is_rare(n_envs, wrap):
    """Returns are those of the environment, normalised or not."""
    rates = {}
    for every in (2, 50):
        env = wrap(DummyVecEnv([partial(Rewarded, every)] * n_envs))
        model = fast_model(env=env, learning_starts=10**9)
        model.learn(3000, log_interval=10**6)
        rates[every] = model.logger.name_to_value["rollout/exploration_rate"]
        assert 0 < model.n_informative_steps <= 3000
        assert model.return_sums.mean == pytest.approx(-5.0 + 50.0 / every, abs=1.5)
    assert rates[50] > 2 * rates[2]


def test_a_loaded_model_goes_on(tmp_path):
    model = fast_model(env=Rewarded(3), learning_starts=10**9).learn(203)
    model.save(tmp_path / "model")
    loaded = CHDP.load(tmp_path / "model", env=Rewarded(3))
    assert loaded._exploration_rate() == model._exploration_rate()
    loaded.learn(100, reset_num_timesteps=False)
    assert loaded.return_sums.n > model.return_sums.n and loaded.n_informative_steps > model.n_informative_steps


def test_half_an_episode_has_no_return(tmp_path):
    """Here all returns are equal; one of an episode and a half would be rarely bad, as if all of them told something."""
    model = fast_model(env=Rewarded(10**6), learning_starts=10**9).learn(203).learn(204)
    model.save(tmp_path / "model")
    loaded = CHDP.load(tmp_path / "model", env=Rewarded(10**6)).learn(203, reset_num_timesteps=False)
    assert loaded.return_sums.n > model.return_sums.n > 10 and loaded.return_sums.square == 0


def test_nobody_needs_to_set_it():
    assert not [name for name in inspect.signature(CHDP).parameters if "explor" in name]


def test_exploratory_actions_take_the_place_of_the_policy():
    """Parts of them lie on the bounds often, which neither uniformly random actions nor the policies do."""
    env = LayoutEnv(layouts()["shared"], episode_length=200)
    model = filled_model(env, n_transitions=200, gradient_steps=0)
    model.learning_starts = 0
    # Critics that prefer what is far from the bounds
    model.critic_target.q_values = lambda features, latents, parameters: (-parameters.abs().sum(dim=1, keepdim=True),) * 2
    model.learn(200, reset_num_timesteps=False)
    columns = model.hybrid_space.columns
    on_bounds = np.abs(columns.view(model.replay_buffer.actions[:400, 0], "parameters")) == 1
    assert not on_bounds[:200].any()
    predicted = columns.view(model.policy.predict_rows(model.replay_buffer.observations[:400, 0]), "parameters")
    assert on_bounds[200:].mean() > 0.05 + (np.abs(predicted) == 1).mean()


def test_reflect():
    x = np.array([-5.0, -1.25, -1.0, 0.5, 1.5, 4.0])
    np.testing.assert_allclose(reflect(x), [1.0, -0.75, -1.0, 0.5, 0.5, -1.0])


def test_random_parameters_are_uniform_or_bounds():
    mask = np.ones((20_000, 2))
    mask[:, 1] = 0
    first, padding = random_parameters(np.random.default_rng(0), mask).T
    assert not padding.any()
    lower, upper = (first == -1).mean(), (first == 1).mean()
    assert lower == pytest.approx(upper, abs=0.02) and 0.05 < lower < 0.3
    inside = first[np.abs(first) < 1]
    histogram = np.histogram(inside, bins=8, range=(-1, 1))[0] / len(inside)
    np.testing.assert_allclose(histogram, 1 / 8, atol=0.015)


def test_each_part_is_varied():
    """Of four kinds of exploratory actions, two keep the discrete action, and one of these stays near its parameters."""
    model = filled_model(make_layout_env("nested"))
    spec = model.hybrid_space.spec
    n, columns = 4000, model.hybrid_space.columns
    obs = np.random.default_rng(0).uniform(-1, 1, (n, 2)).astype(np.float32)
    rows = model.policy.predict_rows(obs)
    with th.no_grad():
        features = model.critic_target.features(th.as_tensor(obs))
    varied = vary_parts(model.policy, features, rows, np.random.default_rng(0))

    assert set(varied[:, 0]) == {0, 1, 2}
    assert np.abs(varied[:, 1:]).max() <= 1
    assert not columns.view(varied, "parameters")[~spec.parameter_mask[varied[:, 0].astype(int)].astype(bool)].any()

    # One of three uniformly random discrete actions is the same by chance
    kept = varied[:, 0] == rows[:, 0]
    assert kept.mean() == pytest.approx(0.5 + 0.5 / 3, abs=0.05)
    two_parameters = kept & (rows[:, 0] == 0)
    near = np.abs(columns.view(varied - rows, "parameters"))[two_parameters].max(axis=1) < 0.1
    assert 0.1 < near.mean() < 0.4


@pytest.mark.parametrize("policy", ["MlpPolicy", "MultiInputPolicy"])
def test_several_environments_explore(policy):
    observation_space = spaces.Dict({"vector": box(-1, 1, 2)}) if policy == "MultiInputPolicy" else None
    env = DummyVecEnv([lambda: make_layout_env(observation_space=observation_space)] * 3)
    model = CHDP(policy, env, n_diffusion_steps=2, learning_starts=10, seed=0)
    before, choose, explored = snapshot(model), model._exploratory_rows, np.zeros(3, dtype=int)

    def counted(rows, envs, *args):
        chosen = choose(rows, envs, *args)
        assert len(chosen) == len(envs)
        explored[envs] += 1
        return chosen

    model._exploratory_rows = counted
    model.learn(60)
    assert has_learnt(model, before) and explored.min() > 5
