"""The losses and updates of CHDP: who gets gradient from what, and what the targets are made of."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from torch.nn import functional as F

from sb3_chdp import CHDP
from sb3_chdp.chdp import PaperCHDP, chdp, losses
from sb3_chdp.common.buffers import PrioritizedReplayBuffer
from sb3_chdp.common.utils import gradient_step
from tests.algorithms import FAST_CHDP, PAPER_FAST, filled_model
from tests.hybrid_envs import HybridIdentityEnv, LayoutEnv, box


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
    return model._latents_of_today(model._sample_batch(size))[0]


def actions_of_continuous_loss(model, data):
    return model._actions_to_improve(data, model.policy.actor_features(data.observations).detach())[1]


def all_losses(model):
    data, policy = batch_of(model), model.policy
    features, critic_features = policy.actor_features(data.observations), model.critic.features(data.observations).detach()
    discrete = losses.discrete_policy_loss(policy, data, features, critic_features, model._parameters_of_latents(data))
    features = features.detach()
    latents, k = model._actions_to_improve(data, features)
    continuous = losses.continuous_policy_loss(policy, data, features, critic_features, latents, k)
    return {
        "critic": losses.critic_loss(model.policy, data, model.n_target_candidates)[0],
        "discrete diffusion": discrete[0],
        "discrete improvement": discrete[1],
        "continuous diffusion": continuous[0],
        "continuous improvement": continuous[1],
    }


# Which networks each loss can reach. The critic is reached by the improvement losses as well, but no optimizer that steps on
# them holds its parameters; the codebook's steps on the critics' loss only with critics_train_codebook
# (test_each_step_moves_its_own_networks_only)
GRADIENTS = {
    "critic": {"critic", "codebook"},
    "discrete diffusion": {"discrete"},
    "discrete improvement": {"discrete", "critic"},
    "continuous diffusion": {"continuous"},
    "continuous improvement": {"continuous", "codebook", "critic"},
}


@pytest.mark.parametrize("algorithm_class", [CHDP, PaperCHDP])
@pytest.mark.parametrize("loss", GRADIENTS)
def test_gradient_routing(loss, algorithm_class):
    model = filled_model(algorithm_class=algorithm_class)
    assert networks_with_gradient(model, all_losses(model)[loss]) == GRADIENTS[loss]


@pytest.mark.parametrize("algorithm_class", [CHDP, PaperCHDP])
def test_codebook_gradient_comes_through_the_continuous_chain_only(algorithm_class):
    """With a chain that ignores its condition the codebook gets no gradient, though Q depends on everything."""
    model = filled_model(algorithm_class=algorithm_class)
    with th.no_grad():
        model.actor.continuous_policy.noise_predictor.split_first_layer()[2].zero_()
    assert "codebook" not in networks_with_gradient(model, all_losses(model)["continuous improvement"])


@pytest.mark.parametrize(
    "algorithm_class, kwargs", [(CHDP, {}), (CHDP, dict(critics_train_codebook=True)), (PaperCHDP, {})], ids=str
)
def test_each_step_moves_its_own_networks_only(algorithm_class, kwargs, monkeypatch):
    model = filled_model(algorithm_class=algorithm_class, **kwargs)
    moved = []

    def spy(*args):
        before = {name: [p.detach().clone() for p in params] for name, params in networks(model).items()}
        gradient_step(*args)
        after = networks(model)
        moved.append({name for name in after if any((a != b).any() for a, b in zip(after[name], before[name], strict=True))})

    monkeypatch.setattr(chdp, "gradient_step", spy)
    model.train(1, 32)
    first = {"critic", "codebook"} if kwargs else {"critic"}
    assert moved == [first, {"discrete"}, {"continuous", "codebook"}]


@pytest.mark.parametrize("critics_train_codebook", [False, True])
def test_critics_bring_codewords_of_similar_actions_together(critics_train_codebook):
    """Of 16 actions the odd ones earn 1, the even ones -1: the critics move the two groups of codewords apart."""
    env = LayoutEnv(spaces.Tuple((spaces.Discrete(16), box(-1, 1, 1))))
    model = filled_model(env, gamma=0.0, codebook_lr_factor=10.0, critics_train_codebook=critics_train_codebook)
    buffer = model.replay_buffer
    buffer.rewards[:] = 2 * (buffer.actions[:, :, 0] % 2) - 1
    model.train(300, 32)
    even, odd = (model.actor.codebook.codewords.detach()[i::2] for i in (0, 1))
    distance = (odd.mean(dim=0) - even.mean(dim=0)).norm()
    spread = odd.std(dim=0).norm() + even.std(dim=0).norm()
    assert (distance > spread) == critics_train_codebook


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


def test_uniform_fraction():
    """Part of the batch takes uniformly random actions, the rest those of the discrete policy."""
    model = filled_model(uniform_fraction=0.25)
    force_action(model, 2)
    k = actions_of_continuous_loss(model, batch_of(model, 400))
    assert (k[100:] == 2).all()
    assert th.bincount(k[:100], minlength=3).min() > 15


@pytest.mark.parametrize("algorithm_class", [CHDP, PaperCHDP])
def test_parameters_with_which_latents_are_valued(algorithm_class):
    """The paper takes the stored ones, CHDP those that the continuous policy draws."""
    model = filled_model(algorithm_class=algorithm_class)
    force_action(model, 1)
    # Parameters of 0.5 for action 1, -0.5 for the others
    model.actor.sample_parameters = lambda features, k: (k[:, None] == 1).float() - 0.5
    data = batch_of(model)
    seen = []
    model.critic.q_networks[0].register_forward_pre_hook(lambda module, args: seen.append(args[0]))
    obs = model.policy.actor_features(data.observations)
    losses.discrete_policy_loss(model.policy, data, obs, obs, model._parameters_of_latents(data))
    expected = data.parameters if algorithm_class is PaperCHDP else th.full_like(data.parameters, 0.5)
    assert th.equal(seen[0][:, -1:], expected)


def test_the_paper_improves_what_its_discrete_policy_draws():
    model = filled_model(algorithm_class=PaperCHDP)
    force_action(model, 2)
    assert (actions_of_continuous_loss(model, batch_of(model, 400)) == 2).all()


def test_the_paper_explores_in_the_warm_up_alone():
    """Then a draw of its policies acts, whatever the critics say of it."""
    model = filled_model(algorithm_class=PaperCHDP)
    assert len(np.unique(model.replay_buffer.actions[:60, 0, 0])) == 3
    force_action(model, 2)
    model.learning_starts = 60
    model.gradient_steps = 0
    drawn, sample_parameters = [], model.actor.sample_parameters

    def spy(*args):
        drawn.append(sample_parameters(*args))
        return drawn[-1]

    model.actor.sample_parameters = spy
    model.critic_target.q_values = lambda features, latents, parameters: (th.zeros(len(latents), 1),) * 2
    model.learn(100, reset_num_timesteps=False)
    acted = model.replay_buffer.actions[60:160, 0]
    assert (acted[:, 0] == 2).all()
    assert [parameters.shape for parameters in drawn] == [(1, 1)] * 100, "one draw each"
    np.testing.assert_array_equal(acted[:, 1], [parameters.item() for parameters in drawn])


def force_action(model, k):
    """Make the discrete policy (and its target) draw the codeword of an action."""
    for actor in (model.actor, model.actor_target):
        codewords = actor.codebook.codewords.detach()
        actor.discrete_policy.sample = lambda features, c=codewords, **_: c[k].expand(len(features), -1).clone()


def test_critic_target():
    """y = r + gamma (1 - d) min Q' of the target policies' next action; n-step discounts take the place of gamma."""
    model = filled_model(gamma=0.9)
    data = batch_of(model)
    data = data._replace(dones=(th.arange(32)[:, None] % 2).float())
    force_action(model, 1)
    model.actor_target.continuous_policy.sample = lambda condition, mask=None, noise=None: th.full((len(condition), 1), 0.3)
    latents = model.actor_target.codebook.codewords[1].expand(32, -1)
    with th.no_grad():
        q1, q2 = model.critic_target.q_values(data.next_observations, latents, th.full((32, 1), 0.3))
        y = data.rewards + 0.9 * (1 - data.dones) * th.min(q1, q2)
        ours = model.critic.q_values(data.observations, data.latents, data.parameters)
        expected = sum(F.mse_loss(q, y) for q in ours)
    loss, q_values, _ = losses.critic_loss(model.policy, data, 1)
    th.testing.assert_close(loss.detach(), expected)
    th.testing.assert_close(q_values, ours[0])
    shorter = losses.critic_loss(model.policy, data._replace(discounts=th.full((32, 1), 0.1)), 1)[0]
    assert not th.isclose(shorter, loss)


def test_best_of_several_next_actions_counts():
    model = filled_model(n_target_candidates=4, gamma=0.9)
    data = batch_of(model)
    seen, q_values = [], model.critic_target.q_values
    model.critic_target.q_values = lambda *args: seen.append(q_values(*args)) or seen[-1]
    loss, *_ = losses.critic_loss(model.policy, data, 4)
    next_q = th.min(*seen[0]).view(32, 4).max(dim=1, keepdim=True).values
    y = data.rewards + 0.9 * (1 - data.dones) * next_q
    ours = model.critic.q_values(data.observations, data.latents, data.parameters)
    th.testing.assert_close(loss, sum(F.mse_loss(q, y) for q in ours))


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
    update = model.update_targets
    before = [p.clone() for p in update.target_params]
    model.train(1, 32)
    for old, online, target in zip(before, update.params, update.target_params, strict=True):
        th.testing.assert_close(target, 0.75 * old + 0.25 * online.detach())
    assert len(before) == sum(len(p) for p in networks(model).values())


def test_policy_delay():
    model = filled_model(policy_delay=2)
    targets = model.update_targets.target_params
    before = [p.clone() for p in targets]
    model.train(1, 32)
    assert all((a == b).all() for a, b in zip(before, targets, strict=True))
    model.train(1, 32)
    assert any((a != b).any() for a, b in zip(before, targets, strict=True))


def test_relabelling_of_latents():
    model = filled_model()
    data = model._sample_batch(64)
    assert (model.actor.codebook.quantize(data.latents) == data.discrete_actions).all(), "random actions decode to themselves"
    with th.no_grad():
        model.actor.codebook.codewords.copy_(-model.actor.codebook.codewords)
    relabelled, drift = losses.relabel_latents(model.policy, data)
    assert 0 < drift <= 1
    assert (model.actor.codebook.quantize(relabelled.latents) == data.discrete_actions).all()
    unchanged = model.actor.codebook.quantize(data.latents) == data.discrete_actions
    assert (relabelled.latents[unchanged] == data.latents[unchanged]).all()


def test_the_paper_keeps_stored_latents():
    model = filled_model(algorithm_class=PaperCHDP)
    before = model._sample_batch(64)
    with th.no_grad():
        model.actor.codebook.codewords.copy_(-model.actor.codebook.codewords)
    after, drift = model._latents_of_today(before)
    assert 0 < drift <= 1 and (after.latents == before.latents).all()
    model.learning_rate = 0.0
    model._setup_lr_schedule()
    model.train(1, 32)
    assert 0 < model.logger.name_to_value["train/latent_drift"] <= 1


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
        model = CHDP("MlpPolicy", make_vec_env(HybridIdentityEnv, 2, seed=3), **FAST_CHDP)
        model.learn(120)
        runs.append([p.detach().clone() for p in model.policy.parameters()])
    assert model._n_updates > 0
    assert all((a == b).all() for a, b in zip(*runs, strict=True))
    other = CHDP("MlpPolicy", make_vec_env(HybridIdentityEnv, 2, seed=3), **{**FAST_CHDP, "seed": 1}).learn(120)
    assert any((a != b).any() for a, b in zip(runs[0], other.policy.parameters(), strict=True))


@pytest.mark.parametrize(
    "kwargs", [dict(n_action_candidates=1), dict(uniform_fraction=0), dict(n_target_candidates=4, n_random_candidates=4),
               dict(n_refinement_candidates=4), dict(replay_buffer_class=PrioritizedReplayBuffer),
               dict(max_grad_norm=None), dict(policy_kwargs=dict(whitening=True)),
               dict(policy_kwargs=dict(layer_norm=True, parameter_degree=3, bilinear=True)),
               dict(codebook_lr_factor=1.0, critics_train_codebook=True), dict(n_diffusion_steps=1), dict(uniform_fraction=1)],
    ids=str,
)  # fmt: skip
def test_options_run(kwargs, tmp_path):
    check_that_it_runs(CHDP, {**FAST_CHDP, **kwargs}, tmp_path)


def test_the_paper_runs(tmp_path):
    check_that_it_runs(PaperCHDP, PAPER_FAST, tmp_path)


def check_that_it_runs(algorithm_class, kwargs, tmp_path):
    model = algorithm_class("MlpPolicy", HybridIdentityEnv(), **kwargs).learn(40)
    assert model._n_updates == 20
    model.save(tmp_path / "model")
    loaded = algorithm_class.load(tmp_path / "model", env=HybridIdentityEnv())
    obs = np.random.uniform(-1, 1, (5, 4)).astype(np.float32)
    np.testing.assert_array_equal(
        model.policy.predict_rows(obs, deterministic=True), loaded.policy.predict_rows(obs, deterministic=True)
    )
    loaded.learn(30)


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
