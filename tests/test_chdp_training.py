"""The training of CHDP as a whole: what is updated when, from which batches, and what is logged."""

import itertools
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise

from sb3_chdp import CHDP
from sb3_chdp.chdp import PaperCHDP
from sb3_chdp.common.buffers import PrioritizedReplayBuffer
from tests.algorithms import calls_of, fast_model, filled_model, has_learnt, sample, snapshot
from tests.hybrid_envs import HybridIdentityEnv, LayoutEnv, box, make_layout_env


def online_and_target(model):
    """:return: pairs of parameters"""
    networks = (model.actor, model.actor_target), (model.critic, model.critic_target)
    return [pair for online, target in networks for pair in zip(online.parameters(), target.parameters(), strict=True)]


def test_critics_see_codewords_alone():
    """Whatever latent was drawn, all actions are valued at the present codewords, of which the policies know nothing yet."""
    model = filled_model(policy_delay=1, learning_rate=0.0)
    with th.no_grad():
        for actor in (model.actor, model.actor_target):
            actor.codebook.codewords.neg_()
    codewords = model.actor.codebook.codewords.detach().clone()
    calls = calls_of(model.critic.q_networks[0])
    model.train(1, 64)
    assert len(calls) >= 3
    for _, latents, _ in calls:
        assert (latents[:, None] == codewords).all(dim=2).any(dim=1).all()


def test_a_share_of_uniformly_random_actions_is_improved():
    """In step 2 uniformly random actions stand beside those of the discrete policy, here the first one always."""
    model = filled_model(policy_delay=1, learning_rate=0.0)
    model.actor.codebook.quantize = lambda latents, masks=None: th.zeros(len(latents), dtype=th.long)
    calls = calls_of(model.critic.q_networks[0])
    model.train(1, 400)
    codewords = model.actor.codebook.codewords.detach()
    counts = (calls[-1][1][:, None] == codewords).all(dim=2).float().mean(dim=0)
    share = model.uniform_fraction / 3
    assert counts.numpy() == pytest.approx(np.array([1 - 2 * share, share, share]), abs=0.05)


def test_targets_move_by_tau():
    model = filled_model(tau=0.25, policy_delay=1)
    before = [target.clone() for _, target in online_and_target(model)]
    model.train(1, 32)
    for old, (online, target) in zip(before, online_and_target(model), strict=True):
        th.testing.assert_close(target, 0.75 * old + 0.25 * online.detach())


def test_policy_delay():
    model = filled_model(policy_delay=2)
    before = snapshot(model)
    model.train(1, 32)
    moved = {name.split(".")[0] for name, p in model.policy.named_parameters() if (p != before[name]).any()}
    # The codebook, which critics train, is part of the actor
    assert moved == {"critic", "actor"}
    assert "train/continuous_loss" not in model.logger.name_to_value
    predictor = "actor.discrete_policy.noise_predictor.of_x.weight"
    assert th.equal(dict(model.policy.named_parameters())[predictor], before[predictor])
    model.train(1, 32)
    assert not th.equal(dict(model.policy.named_parameters())[predictor], before[predictor])
    assert any((p != before[name]).any() for name, p in model.policy.named_parameters() if "target" in name)


@pytest.mark.parametrize("episode_end, bootstraps", [("truncated", True), ("terminated", False)])
def test_time_limits_bootstrap_and_terminations_do_not(episode_end, bootstraps):
    class OneStepEnv(LayoutEnv):
        def step(self, action):
            obs, reward, *_ = super().step(action)
            return obs, reward, episode_end == "terminated", episode_end == "truncated", {}

    model = filled_model(OneStepEnv(spaces.Tuple((spaces.Discrete(2), box(-1, 1, 1)))))
    assert (sample(model).dones == (0 if bootstraps else 1)).all()


def test_the_learning_rate_falls_to_zero_by_default():
    model = CHDP("MlpPolicy", HybridIdentityEnv(), learning_starts=0, codebook_lr_factor=0.5, seed=0, n_diffusion_steps=1)
    policy = model.policy
    of_networks = (policy.critic.optimizer, policy.reward_optimizer, policy.discrete_optimizer, policy.continuous_optimizer)
    optimizers = (*of_networks, policy.codebook_optimizer)
    noted: list[list[float]] = []

    def note(*_):
        noted.append([o.param_groups[0]["lr"] for o in optimizers])
        return True

    # The callback comes before the training of its step
    model.learn(21, callback=note)
    rates = np.array(noted)[1:]
    np.testing.assert_allclose(rates / rates[:, :1], [[1, 1, 1, 1, 0.5]] * len(rates))
    np.testing.assert_allclose(np.diff(rates[:, 0]), -rates[0, 0] / len(rates), rtol=1e-6)


def test_two_seeded_runs_are_identical():
    def parameters(**kwargs):
        model = fast_model(env=make_vec_env(HybridIdentityEnv, 2, seed=3), **kwargs)
        before = snapshot(model)
        model.learn(120)
        assert has_learnt(model, before)
        return snapshot(model)

    first, second, other = parameters(), parameters(), parameters(seed=1)
    assert all(th.equal(first[name], second[name]) for name in first)
    assert any((first[name] != other[name]).any() for name in first)


OPTIONS = [
    {},
    dict(n_action_candidates=1),
    dict(n_diffusion_steps=1),
    dict(policy_delay=2),
    dict(replay_buffer_class=PrioritizedReplayBuffer),
    dict(n_steps=3),
    dict(latent_dim=1),
    dict(policy_kwargs=dict(net_arch=dict(pi=[16], qf=[16]), activation_fn=th.nn.ReLU, optimizer_class=th.optim.AdamW)),
]


@pytest.mark.parametrize("algorithm_class, kwargs", [*((CHDP, kwargs) for kwargs in OPTIONS), (PaperCHDP, {})], ids=str)
def test_options_run(algorithm_class, kwargs, tmp_path):
    model = fast_model(algorithm_class, **kwargs)
    before = snapshot(model)
    model.learn(40)
    assert has_learnt(model, before)
    model.save(tmp_path / "model")
    loaded = algorithm_class.load(tmp_path / "model", env=HybridIdentityEnv())
    obs = np.random.uniform(-1, 1, (5, 4)).astype(np.float32)
    np.testing.assert_array_equal(
        model.policy.predict_rows(obs, deterministic=True), loaded.policy.predict_rows(obs, deterministic=True)
    )
    before = snapshot(loaded)
    loaded.learn(30)
    assert has_learnt(loaded, before)


def test_logged_values():
    model = filled_model()
    model.train(2, 32)
    logged = model.logger.name_to_value
    names = {name.removeprefix("train/") for name in logged if name.startswith("train/")}
    assert names >= {
        "critic_loss", "reward_loss", "return_loss", "discrete_loss", "continuous_loss", "diffusion_loss_discrete",
        "diffusion_loss_continuous", "q_mean", "codebook_usage", "codebook_perplexity", "learning_rate",
        "codebook_learning_rate", "n_updates",
    }  # fmt: skip
    assert 1 <= logged["train/codebook_perplexity"] <= 3
    assert 0 < logged["train/codebook_usage"] <= 1
    assert logged["train/n_updates"] == 2


def test_usage_is_of_what_the_discrete_policy_draws():
    model = filled_model(LayoutEnv(spaces.Tuple((spaces.Discrete(4), box(-1, 1, 1)))))
    codewords, actor = model.actor.codebook.codewords, model.actor
    actor.sample_latents = lambda features, *_, **__: (
        codewords[:1].detach().expand(len(features), -1), th.zeros(len(features), dtype=th.long)
    )  # fmt: skip
    model.train(1, 32)
    logged = model.logger.name_to_value
    assert logged["train/codebook_usage"] == 0.25 and logged["train/codebook_perplexity"] == pytest.approx(1)


def test_leaves_of_long_names_do_not_stop_what_is_printed(capsys):
    """SB3 refuses to print keys that are the same where it cuts them."""
    leaves: dict[str, Any] = {f"valve_position_{side}": spaces.MultiBinary(6) for side in ("left", "right")}
    model = filled_model(LayoutEnv(spaces.Dict({**leaves, "flow": box(-1, 1, 1)})), verbose=1)
    model.train(1, 32)
    model.logger.dump()
    assert "codebook_perplexity" in capsys.readouterr().out


def test_usage_of_every_leaf_is_logged():
    env = LayoutEnv(spaces.Dict(units=spaces.MultiBinary(6), mode=spaces.Discrete(32), set=box(-1, 1, 1)))
    model = filled_model(env)
    model.train(1, 32)
    logged = model.logger.name_to_value
    by_leaf = [logged[f"train/codebook_usage/{leaf}"] for leaf in ("mode", "units")]
    assert logged["train/codebook_usage"] == pytest.approx((by_leaf[0] + 6 * by_leaf[1]) / 7)
    assert "train/codebook_perplexity/units" in logged


def test_padding_reaches_nothing():
    """Rows, replay buffer and critic see 0 for parameters that the action does not have."""
    model = filled_model(make_layout_env("nested"), policy_delay=1, learning_rate=0.0)
    mask, columns = model.hybrid_space.spec.parameter_mask.astype(bool), model.hybrid_space.columns
    model.policy.set_foresight(0.5)
    critics = (model.critic, model.critic_target)
    calls = [calls_of(network) for critic in critics for network in (*critic.q_networks, critic.reward_network)]
    model.train(2, 32)
    rows = model.policy.predict_rows(np.random.uniform(-1, 1, (200, 2)).astype(np.float32))
    assert all(calls)
    for _, latents, parameters in itertools.chain(*calls):
        k = model.actor.codebook.quantize(latents)
        assert not parameters[~mask[k]].any() and parameters.abs().max() <= 1 and latents.abs().max() <= 1
    k = columns.discrete_actions(rows)
    assert not columns.view(rows, "parameters")[~mask[k]].any()
    data = sample(model, 64)
    assert not data.parameters[~mask[data.discrete_actions]].any()


def test_action_noise_spares_padding_and_is_clipped():
    noise = NormalActionNoise(np.zeros(2), 10 * np.ones(2))
    model = fast_model(env=make_layout_env("nested"), action_noise=noise, learning_starts=0)
    model._exploration_rate = lambda: 0.0  # exploratory actions have no noise
    model.learn(60)
    data = sample(model, 64)
    mask = model.hybrid_space.spec.parameter_mask[data.discrete_actions].astype(bool)
    assert not data.parameters[~mask].any() and data.parameters.abs().max() <= 1
    assert (data.parameters[mask].abs() == 1).float().mean() > 0.8
