"""The losses and updates of CHDP: who gets gradient from what, and what the targets are made of."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env
from torch.nn import functional as F

from sb3_chdp import CHDP
from sb3_chdp.chdp import losses
from sb3_chdp.chdp.codebook import Codebook
from sb3_chdp.common.utils import hash_observations
from tests.hybrid_envs import HybridIdentityEnv, LayoutEnv, box, make_layout_env

FAST = dict(
    n_diffusion_steps=3, latent_dim=4, batch_size=16, learning_starts=20, n_action_candidates=2, buffer_size=1000,
    policy_kwargs=dict(net_arch=[16, 16]), seed=0,
)  # fmt: skip


def filled_model(env=None, **kwargs):
    """A model with 60 random transitions that has not been trained."""
    model = CHDP("MlpPolicy", env or HybridIdentityEnv(), **{**FAST, **kwargs})
    model.learning_starts = 10**9
    model.learn(60)
    return model


def networks(model):
    actor = model.actor
    return {
        "discrete": list(actor.discrete_policy.parameters()),
        "continuous": list(actor.continuous_policy.parameters()),
        "codebook": list(actor.codebook.parameters()),
        "critic": list(model.critic.parameters()),
    }


def networks_with_gradient(model, loss):
    result = set()
    for name, params in networks(model).items():
        gradients = th.autograd.grad(loss, params, retain_graph=True, allow_unused=True)
        if any(g is not None and g.abs().max() > 0 for g in gradients):
            result.add(name)
    return result


def batch_of(model, size=32):
    return losses.relabel_latents(model.policy, model._sample_batch(size), model.relabel_latents)[0]


def actions_of_continuous_loss(model, data):
    features = model.policy.actor_features(data.observations)
    options = model.improvement_q, model.sequential_update, model.uniform_fraction
    return losses.continuous_policy_loss(model.policy, data, features, features, *options)[2]


def all_losses(model):
    data, policy, q = batch_of(model), model.policy, model.improvement_q
    features = (policy.actor_features(data.observations), model.critic.features(data.observations).detach())
    discrete = losses.discrete_policy_loss(policy, data, *features, q, model.improvement_parameters)
    continuous = losses.continuous_policy_loss(policy, data, *features, q, model.sequential_update, model.uniform_fraction)
    return {
        "critic": losses.critic_loss(policy, data)[0],
        "discrete diffusion": discrete[0],
        "discrete improvement": discrete[1],
        "continuous diffusion": continuous[0],
        "continuous improvement": continuous[1],
    }


# Which networks each loss can reach. The critic is reached by the improvement losses as well, but no optimizer that
# steps on them holds its parameters (test_each_step_moves_its_own_networks_only)
GRADIENTS = {
    "critic": {"critic"},
    "discrete diffusion": {"discrete"},
    "discrete improvement": {"discrete", "critic"},
    "continuous diffusion": {"continuous"},
    "continuous improvement": {"continuous", "codebook", "critic"},
}


@pytest.mark.parametrize("improvement_parameters", losses.IMPROVEMENT_PARAMETERS)
@pytest.mark.parametrize("loss", GRADIENTS)
def test_gradient_routing(loss, improvement_parameters):
    model = filled_model(improvement_parameters=improvement_parameters)
    assert networks_with_gradient(model, all_losses(model)[loss]) == GRADIENTS[loss]


def test_codebook_gradient_comes_through_the_continuous_chain_only():
    """With a chain that ignores its condition the codebook gets no gradient, though Q depends on everything."""
    model = filled_model()
    with th.no_grad():
        model.actor.continuous_policy.noise_predictor.condition_weight.zero_()
    assert "codebook" not in networks_with_gradient(model, all_losses(model)["continuous improvement"])


def test_each_step_moves_its_own_networks_only():
    model = filled_model()
    policy, moved = model.policy, []
    original = model._optimize

    def spy(loss, *optimizers):
        before = {name: [p.detach().clone() for p in params] for name, params in networks(model).items()}
        original(loss, *optimizers)
        after = networks(model)
        moved.append({name for name in after if any((a != b).any() for a, b in zip(after[name], before[name], strict=True))})

    model._optimize = spy
    model.train(1, 32)
    assert moved == [{"critic"}, {"discrete"}, {"continuous", "codebook"}]
    assert policy.codebook_optimizer is not None


def test_continuous_step_sees_the_updated_discrete_policy(monkeypatch):
    """The latents of step 2 are those that the discrete policy draws after its own step."""
    model = filled_model(uniform_fraction=0)
    seen = []
    original = losses.continuous_policy_loss

    def spy(*args):
        seen.append([p.detach().clone() for p in model.actor.discrete_policy.parameters()])
        return original(*args)

    monkeypatch.setattr("sb3_chdp.chdp.chdp.continuous_policy_loss", spy)
    before = [p.detach().clone() for p in model.actor.discrete_policy.parameters()]
    model.train(1, 32)
    assert any((a != b).any() for a, b in zip(seen[0], before, strict=True))
    # And it does draw from it: a policy that is forced to action 2 leaves nothing else
    force_action(model, 2)
    data = batch_of(model)
    assert (actions_of_continuous_loss(model, data) == 2).all()
    assert (data.discrete_actions != 2).any()


def test_without_sequential_update_the_stored_actions_are_used():
    model = filled_model(sequential_update=False, uniform_fraction=0)
    data = batch_of(model)
    assert (actions_of_continuous_loss(model, data) == data.discrete_actions).all()


def test_uniform_fraction():
    """Part of the batch takes uniformly random actions, the rest those of the discrete policy."""
    model = filled_model(uniform_fraction=0.25)
    force_action(model, 2)
    k = actions_of_continuous_loss(model, batch_of(model, 400))
    assert (k[100:] == 2).all()
    assert th.bincount(k[:100], minlength=3).min() > 15


@pytest.mark.parametrize("improvement_parameters", losses.IMPROVEMENT_PARAMETERS)
def test_parameters_with_which_latents_are_valued(improvement_parameters):
    model = filled_model(improvement_parameters=improvement_parameters)
    force_action(model, 1)
    # Parameters of 0.5 for action 1, -0.5 for the others
    model.actor.sample_parameters = lambda features, k: (k[:, None] == 1).float() - 0.5
    data, features = batch_of(model), model.policy.actor_features
    seen = []
    model.critic.q_networks[0].register_forward_pre_hook(lambda module, args: seen.append(args[0]))
    obs = features(data.observations)
    losses.discrete_policy_loss(model.policy, data, obs, obs, "q1", improvement_parameters)
    expected = data.parameters if improvement_parameters == "stored" else th.full_like(data.parameters, 0.5)
    assert th.equal(seen[0][:, -1:], expected)


def force_action(model, k):
    """Make the discrete policy (and its target) draw the codeword of an action."""
    for actor in (model.actor, model.actor_target):
        codewords = actor.codebook.codewords.detach()
        actor.discrete_policy.sample = lambda features, noise=None, c=codewords: c[k].expand(len(features), -1).clone()


def test_critic_target():
    """y = r + gamma (1 - d) min Q' of the target policies' next action; n-step discounts take the place of gamma."""
    model = filled_model(gamma=0.9)
    data = batch_of(model)
    data = data._replace(dones=(th.arange(32)[:, None] % 2).float())
    force_action(model, 1)
    model.actor_target.continuous_policy.sample = lambda condition, noise=None, mask=None: th.full((len(condition), 1), 0.3)
    latents = model.actor_target.codebook.codewords[1].expand(32, -1)
    with th.no_grad():
        q1, q2 = model.critic_target.q_values(data.next_observations, latents, th.full((32, 1), 0.3))
        y = data.rewards + 0.9 * (1 - data.dones) * th.min(q1, q2)
        ours = model.critic.q_values(data.observations, data.latents, data.parameters)
        expected = sum(F.mse_loss(q, y) for q in ours)
    loss, q_values = losses.critic_loss(model.policy, data)
    th.testing.assert_close(loss.detach(), expected)
    th.testing.assert_close(q_values, ours[0])
    shorter = losses.critic_loss(model.policy, data._replace(discounts=th.full((32, 1), 0.1)))[0]
    assert not th.isclose(shorter, loss)


def test_alpha_normalises_by_q():
    """The discrete loss is L_d - eta / mean|Q| * mean Q: scaling the critic leaves it unchanged."""
    model = filled_model()
    for net in (model.critic, model.critic_target):
        for q_network in net.q_networks:
            with th.no_grad():
                q_network[-1].weight.mul_(1000)
                q_network[-1].bias.mul_(1000).add_(5000)
    model.max_grad_norm = None
    model.learning_rate = 0.0
    model._setup_lr_schedule()
    model.train(1, 64)
    logged = model.logger.name_to_value
    improvement = logged["train/discrete_loss"] - logged["train/diffusion_loss_discrete"]
    assert abs(improvement) < 2 * model.eta


def test_targets_move_by_tau():
    model = filled_model(tau=0.25)
    before = [p.clone() for p in model._target_params]
    model.train(1, 32)
    for old, online, target in zip(before, model._online_params, model._target_params, strict=True):
        th.testing.assert_close(target, 0.75 * old + 0.25 * online.detach())
    assert len(model._online_params) == len(model._target_params) == sum(len(p) for p in networks(model).values())


def test_policy_delay():
    model = filled_model(policy_delay=2)
    before = [p.clone() for p in model._target_params]
    model.train(1, 32)
    assert all((a == b).all() for a, b in zip(before, model._target_params, strict=True))
    model.train(1, 32)
    assert any((a != b).any() for a, b in zip(before, model._target_params, strict=True))


@settings(max_examples=50, deadline=None)
@given(k=st.integers(1, 40), dim=st.integers(1, 10), seed=st.integers(0, 1000))
def test_nearest_codeword_against_brute_force(k, dim, seed):
    th.manual_seed(seed)
    codebook = Codebook(k, dim)
    latents = th.rand(30, dim) * 2 - 1
    distances = (latents[:, None] - codebook.codewords.detach()).square().sum(dim=2)
    chosen = distances.gather(1, codebook.quantize(latents)[:, None])
    th.testing.assert_close(chosen, distances.min(dim=1, keepdim=True).values, atol=1e-5, rtol=1e-5)


def test_codebook_stays_where_the_latents_are():
    model = filled_model()
    with th.no_grad():
        model.actor.codebook.codewords[0] = 0.9999
    model.codebook_learning_rate = 0.5
    model._setup_model()
    model.replay_buffer = filled_model().replay_buffer
    model.train(3, 32)
    assert model.actor.codebook.codewords.abs().max() <= 1


def test_relabelling_of_latents():
    model = filled_model()
    data = model._sample_batch(64)
    assert (model.actor.codebook.quantize(data.latents) == data.discrete_actions).all(), "random actions decode to themselves"
    with th.no_grad():
        model.actor.codebook.codewords.copy_(-model.actor.codebook.codewords)
    relabelled, drift = losses.relabel_latents(model.policy, data, True)
    assert 0 < drift <= 1
    assert (model.actor.codebook.quantize(relabelled.latents) == data.discrete_actions).all()
    unchanged = model.actor.codebook.quantize(data.latents) == data.discrete_actions
    assert (relabelled.latents[unchanged] == data.latents[unchanged]).all()
    assert (losses.relabel_latents(model.policy, data, False)[0].latents == data.latents).all()


def test_padding_reaches_nothing():
    """Rows, replay buffer and critic see 0 for parameters that the action does not have."""
    model = filled_model(make_layout_env("nested"))
    mask = model.hybrid_space.spec.mask
    data = model._sample_batch(64)
    assert not data.parameters[~th.as_tensor(mask[data.discrete_actions])].any()
    rows = model.policy.predict_rows(np.random.uniform(-1, 1, (200, 2)).astype(np.float32))
    k = rows[:, 0].astype(int)
    assert not rows[:, 1:3][~mask[k]].any() and np.abs(rows[:, 1:]).max() <= 1
    features = model.policy.actor_features(data.observations)
    for action in range(3):
        actions = th.full((64,), action)
        parameters = model.actor.sample_parameters(features, actions)
        assert not parameters[:, mask[action].sum() :].any()


def test_action_noise_spares_padding_and_is_clipped():
    from stable_baselines3.common.noise import NormalActionNoise

    noise = NormalActionNoise(np.zeros(2), 10 * np.ones(2))
    model = CHDP("MlpPolicy", make_layout_env("nested"), **{**FAST, "exploration_initial_eps": 0, "exploration_final_eps": 0},
                 action_noise=noise)  # fmt: skip
    model.learn(60)
    data = model._sample_batch(64)
    mask = th.as_tensor(model.hybrid_space.spec.mask[data.discrete_actions])
    assert not data.parameters[~mask].any() and data.parameters.abs().max() <= 1


@pytest.mark.parametrize("episode_end, bootstraps", [("truncated", True), ("terminated", False)])
def test_time_limits_bootstrap_and_terminations_do_not(episode_end, bootstraps):
    class OneStepEnv(LayoutEnv):
        def step(self, action):
            obs, reward, *_ = super().step(action)
            return obs, reward, episode_end == "terminated", episode_end == "truncated", {}

    model = filled_model(OneStepEnv(spaces.Tuple((spaces.Discrete(2), box(-1, 1, 1)))))
    dones = model._sample_batch(32).dones
    assert (dones == (0 if bootstraps else 1)).all()


def test_two_seeded_runs_are_identical():
    runs = []
    for _ in range(2):
        model = CHDP("MlpPolicy", make_vec_env(HybridIdentityEnv, 2, seed=3), **FAST)
        model.learn(120)
        runs.append([p.detach().clone() for p in model.policy.parameters()])
    assert model._n_updates > 0
    assert all((a == b).all() for a, b in zip(*runs, strict=True))
    other = CHDP("MlpPolicy", make_vec_env(HybridIdentityEnv, 2, seed=3), **{**FAST, "seed": 1}).learn(120)
    assert any((a != b).any() for a, b in zip(runs[0], other.policy.parameters(), strict=True))


@pytest.mark.parametrize("diffusion", [True, False])
def test_deterministic_predictions_repeat(diffusion):
    model = filled_model(diffusion=diffusion)
    obs = np.random.uniform(-1, 1, (5, 4)).astype(np.float32)
    first = model.policy.predict_rows(obs, deterministic=True)
    np.testing.assert_array_equal(model.policy.predict_rows(obs, deterministic=True), first)
    # The same for an observation on its own as among others
    for one, row in zip(obs, first, strict=True):
        np.testing.assert_allclose(model.policy.predict_rows(one, deterministic=True), row, atol=1e-5)
    assert (model.policy.predict_rows(obs) != first).any()


def test_noise_of_deterministic_predictions_depends_on_the_observation():
    vectors, images = th.rand(1000, 4), th.randint(256, (1000, 1, 6, 6), dtype=th.uint8)
    for observations in (vectors, images, {"v": vectors, "i": images}):
        hashes = hash_observations(observations)
        assert hashes.shape == (1000,) and len((hashes % 1024).unique()) > 550  # 637 of 1024 expected
        if isinstance(observations, th.Tensor):
            assert (hash_observations(observations[5:7]) == hashes[5:7]).all()
    # A small change is enough
    assert (hash_observations(vectors + 1e-6) != hash_observations(vectors)).float().mean() > 0.99


@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("uniform_fraction", [0.0, 0.5])
def test_the_best_candidate_acts(uniform_fraction, deterministic):
    model = filled_model(n_action_candidates=8, uniform_fraction=uniform_fraction)
    obs = np.random.uniform(-1, 1, (6, 4)).astype(np.float32)
    candidates = {}
    actor = model.actor_target if deterministic else model.actor
    original = actor.sample_parameters

    def spy(features, k, noise):
        candidates["k"], candidates["parameters"] = k, original(features, k, noise)
        return candidates["parameters"]

    actor.sample_parameters = spy
    q_values, q_networks = [], model.critic_target.q_values
    model.critic_target.q_values = lambda *args: q_values.append(q_networks(*args)) or q_values[-1]
    rows = model.policy.predict_rows(obs, deterministic)
    best = th.min(*q_values[0]).view(6, 8).argmax(dim=1)
    for column, name in ((0, "k"), (1, "parameters")):
        np.testing.assert_allclose(rows[:, column], candidates[name].view(6, 8)[th.arange(6), best])
    assert (model.actor.codebook.quantize(th.as_tensor(rows[:, 2:])).numpy() == rows[:, 0]).all()
    # Four uniform candidates cover three actions
    covered = candidates["k"].view(6, 8)[:, :4].sort(dim=1).values.diff(dim=1).count_nonzero(dim=1)
    assert uniform_fraction == 0 or (covered == 2).all()


@pytest.mark.parametrize("k_total", [2, 1000])
def test_random_rows_decode_to_their_action(k_total):
    env = LayoutEnv(spaces.Tuple((spaces.Discrete(k_total), box(-1, 1, 1))))
    model = CHDP("MlpPolicy", env, **FAST)
    rows = model.policy.random_rows(np.random.default_rng(0), 500)
    decoded = model.actor.codebook.quantize(th.as_tensor(rows[:, 2:]))
    assert (decoded.numpy() == rows[:, 0]).mean() > 0.97  # a few cells are too small for the noise
    assert np.abs(rows[:, 1:]).max() <= 1


@pytest.mark.parametrize(
    "kwargs", [dict(diffusion=False), dict(codebook=False), dict(sequential_update=False),
               dict(codebook=False, sequential_update=False), dict(improvement_q="min"), dict(improvement_q="mean"),
               dict(variance_type="fixed_small", beta_schedule="cosine"), dict(n_action_candidates=1),
               dict(improvement_parameters="policy", uniform_fraction=0.5), dict(max_grad_norm=None),
               dict(codebook_learning_rate=1e-4), dict(n_diffusion_steps=1)],
    ids=str,
)  # fmt: skip
def test_ablations_and_options_run(kwargs, tmp_path):
    model = CHDP("MlpPolicy", HybridIdentityEnv(), **{**FAST, **kwargs}).learn(40)
    assert model._n_updates == 20
    model.save(tmp_path / "model")
    loaded = CHDP.load(tmp_path / "model", env=HybridIdentityEnv())
    obs = np.random.uniform(-1, 1, (5, 4)).astype(np.float32)
    np.testing.assert_array_equal(
        model.policy.predict_rows(obs, deterministic=True), loaded.policy.predict_rows(obs, deterministic=True)
    )
    loaded.learn(30)


def test_codebook_learning_rate_schedule():
    model = filled_model(codebook_learning_rate=lambda progress: 0.5 * progress)
    model._current_progress_remaining = 0.1
    model.train(1, 32)
    assert model.policy.codebook_optimizer.param_groups[0]["lr"] == pytest.approx(0.05)
    assert model.policy.continuous_optimizer.param_groups[0]["lr"] == pytest.approx(1e-3)


def test_logged_values():
    model = filled_model()
    model.train(2, 32)
    names = {name.removeprefix("train/") for name in model.logger.name_to_value if name.startswith("train/")}
    assert names >= {
        "critic_loss", "discrete_loss", "continuous_loss", "diffusion_loss_discrete", "diffusion_loss_continuous",
        "q_mean", "codebook_usage", "codebook_perplexity", "latent_drift", "learning_rate", "n_updates",
    }  # fmt: skip
    assert 1 <= model.logger.name_to_value["train/codebook_perplexity"] <= 3
    assert 0 < model.logger.name_to_value["train/codebook_usage"] <= 1
