"""The losses of CHDP: who gets gradient from what, and what the targets are made of."""

import itertools

import pytest
import torch as th
from torch.nn import functional as F

from sb3_chdp import CHDP
from sb3_chdp.chdp import PaperCHDP, losses
from sb3_chdp.chdp.paper import PaperPolicy
from sb3_chdp.common.utils import gradient_step
from tests.algorithms import calls_of, filled_model, sample
from tests.hybrid_envs import make_layout_env

BOTH = pytest.mark.parametrize("algorithm_class", [CHDP, PaperCHDP])


def networks(model):
    actor = model.actor
    reads = [] if actor.reads is None else list(actor.reads.parameters())
    rewards = {} if model.critic.reward_network is None else {"rewards": list(model.critic.reward_network.parameters())}
    return {
        "discrete": list(actor.discrete_policy.parameters()),
        "continuous": [*actor.continuous_policy.parameters(), *reads],
        "codebook": list(actor.codebook.parameters()),
        "critic": list(model.critic.q_networks.parameters()),
        **rewards,
    }


def networks_with_gradient(model, loss):
    result = set()
    for name, params in networks(model).items():
        gradients = th.autograd.grad(loss, params, retain_graph=True, allow_unused=True)
        if any(g is not None and g.abs().max() > 0 for g in gradients):
            result.add(name)
    return result


def all_losses(model):
    data, policy = sample(model), model.policy
    features = policy.critic.features(data.observations)
    targets = policy.in_units_of_critics(losses.target_values(policy, data)[0])
    critic, *_ = losses.critic_loss(policy, data, features, targets[:, :1])
    features = features.detach()
    discrete = model._discrete_policy_loss(data, features)
    with th.no_grad():
        latents, k = policy.actor.sample_latents(features)
    continuous = losses.continuous_policy_loss(policy, data, features, latents, k)
    return {
        "critic": critic,
        "discrete diffusion": discrete[0],
        "discrete improvement": discrete[1],
        "continuous diffusion": continuous[0],
        "continuous improvement": continuous[1],
    }


# Which networks each loss can reach. The critic is reached by the improvement losses as well, but no optimizer that steps on
# them holds its parameters
GRADIENTS = {
    "critic": {"critic", "codebook"},
    "discrete diffusion": {"discrete"},
    "discrete improvement": {"discrete"},
    "continuous diffusion": {"continuous"},
    "continuous improvement": {"continuous", "codebook", "critic"},
}


@BOTH
@pytest.mark.parametrize("loss", GRADIENTS)
def test_gradient_routing(loss, algorithm_class):
    model = filled_model(algorithm_class=algorithm_class)
    # The paper's latents are improved by the critics' gradient
    extra = {"critic"} if algorithm_class is PaperCHDP and loss == "discrete improvement" else set()
    assert networks_with_gradient(model, all_losses(model)[loss]) == GRADIENTS[loss] | extra


@BOTH
def test_codebook_gradient_comes_through_the_continuous_chain_only(algorithm_class):
    """With a chain that ignores its condition the codebook gets no gradient, though Q depends on everything."""
    model = filled_model(algorithm_class=algorithm_class)
    with th.no_grad():
        model.actor.continuous_policy.noise_predictor.of_condition.weight.zero_()
    assert "codebook" not in networks_with_gradient(model, all_losses(model)["continuous improvement"])


@BOTH
def test_each_step_moves_its_own_networks_only(algorithm_class):
    """The last calls of Q1 are for the losses of critics, discrete and continuous policy: steps lie in between."""
    delay = {} if algorithm_class is PaperCHDP else dict(policy_delay=1)
    model = filled_model(algorithm_class=algorithm_class, **delay)
    states = []

    def snapshot(*_):
        states.append({name: [p.detach().clone() for p in params] for name, params in networks(model).items()})

    model.critic.q_networks[0].register_forward_pre_hook(snapshot)
    model.train(1, 32)
    snapshot()
    moved = [
        {name for name in after if any((p != q).any() for p, q in zip(after[name], before[name], strict=True))}
        for before, after in itertools.pairwise(states[-4:])
    ]
    critics_train = {"critic", "codebook", "rewards"} if algorithm_class is CHDP else {"critic"}
    assert moved == [critics_train, {"discrete"}, {"continuous", "codebook"}]


@BOTH
def test_continuous_step_sees_the_updated_discrete_policy(algorithm_class):
    """The latents of step 2 are those that the discrete policy draws after its own step."""
    delay = {} if algorithm_class is PaperCHDP else dict(policy_delay=1)
    model = filled_model(algorithm_class=algorithm_class, **delay)
    predictor = model.actor.discrete_policy.noise_predictor
    weights = []
    predictor.register_forward_pre_hook(lambda *_: weights.append(predictor.of_x.weight.detach().clone()))
    model.train(1, 32)
    n = model.n_diffusion_steps
    # Its diffusion loss and a chain in step 1, a chain in step 2
    assert len(weights) == 1 + 2 * n
    assert all(th.equal(w, weights[0]) for w in weights[: 1 + n])
    assert not th.equal(weights[1 + n], weights[0])


def test_discrete_actions_are_compared_with_parameters_of_their_own():
    """The nearest, the stored and two other discrete actions, each with parameters that the continuous policy draws for it."""
    model = filled_model(make_layout_env("nested"))
    data, actor = sample(model), model.actor
    features = model.critic.features(data.observations)
    valued, conditions = calls_of(model.critic.q_networks[0]), calls_of(actor.continuous_policy.noise_predictor.of_condition)
    losses.discrete_policy_loss(model.policy, data, features)
    ((_, latents, parameters),) = valued
    k = actor.codebook.quantize(latents)
    assert th.equal(latents, actor.codebook.representative_latents(k))
    assert th.equal(k.view(-1, 2 + losses.N_COMPARED)[:, 1], data.discrete_actions)
    # Drawn given these codewords, and as many as the action has
    ((condition,),) = conditions
    assert th.equal(condition[:, actor.features_dim :][:, : latents.shape[1]], latents)
    assert th.equal(parameters != 0, actor.padding_mask(k).bool())


def test_stored_parameters_value_the_latents_of_the_paper():
    model = filled_model(algorithm_class=PaperCHDP)
    data = sample(model)
    features = model.critic.features(data.observations)
    calls = calls_of(model.critic.q_networks[0])
    th.manual_seed(0)
    model._discrete_policy_loss(data, features)
    th.manual_seed(0)
    latents, _ = model.actor.sample_latents(features)
    ((_, seen_latents, seen_parameters),) = calls
    th.testing.assert_close(seen_latents, latents.detach())
    th.testing.assert_close(seen_parameters, data.parameters)


def test_soft_quantization():
    """Near codewords weigh more, those that do not compete nothing, and none is too far to be seen from another one."""
    codewords = th.tensor([[[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [1.0, 1.0]]])
    latents = th.tensor([[0.9, 1.0]], requires_grad=True)
    competes = losses.first_occurrences(th.tensor([[2, 1, 0, 2]]))
    assert competes.tolist() == [[True, True, True, False]]
    weights = losses.soft_quantization(latents, codewords, competes)
    assert weights[0, 0] > weights[0, 1] > weights[0, 2] > 0.05 and weights[0, 3] == 0
    assert weights.sum().item() == pytest.approx(1)
    # What is worth more draws the latent towards it
    values = th.tensor([[0.0, 0.0, 1.0, 0.0]])
    (gradient,) = th.autograd.grad((weights * values).sum(), latents)
    assert (gradient < 0).all()


def test_forbidden_actions_do_not_compete():
    """However much a forbidden one is worth, stored or not."""
    model = filled_model()
    data = sample(model)
    features = model.critic.features(data.observations)
    masks = th.tensor([True, True, False]).expand(len(features), -1)

    def q_losses():
        for of_masks in (masks, None):
            th.manual_seed(0)
            yield losses.discrete_policy_loss(model.policy, data._replace(masks=of_masks), features)[1].item()

    masked, free = q_losses()
    codeword = model.actor.codebook.codewords[2]
    model.critic.q_networks[0].register_forward_hook(
        lambda _, args, values: values + 100 * (args[1] == codeword).all(dim=1, keepdim=True)
    )
    masked_then, free_then = q_losses()
    assert masked_then == masked and free_then < free - 1


def test_equal_actions_of_a_factored_space_compete_once():
    k = th.tensor([[[0, 1], [1, 1], [0, 1]]])
    assert losses.first_occurrences(k).tolist() == [[True, True, False]]


def test_the_discrete_policy_learns_which_action_is_best():
    """From the first of three actions to the second, which is worth a little more, though one like it is by far the worst."""
    model = filled_model()
    policy, actor = model.policy, model.actor
    data = sample(model)
    features = policy.critic.features(data.observations).detach()
    codewords = actor.codebook.codewords.data
    codewords[2] = 0.7 * codewords[1] + 0.3 * codewords[2]

    def share_of_best(values):
        def score(_, latents, *__):
            return (latents[:, None] == codewords).all(dim=2).float() @ th.tensor(values)[:, None]

        policy.critic.score1 = score
        for _ in range(300):
            diffusion_loss, q_loss = losses.discrete_policy_loss(policy, data, features)
            gradient_step(diffusion_loss + 10 * q_loss, [policy.discrete_optimizer], 1.0)
        with th.no_grad():
            _, k = actor.sample_latents(features)
        return (k == values.index(max(values))).float().mean()

    assert share_of_best([1.0, 0.0, 0.0]) > 0.9
    assert share_of_best([0.9, 1.2, -1.5]) > 0.9


def test_how_bad_worse_actions_are_does_not_count(monkeypatch):
    """Beyond a bound."""
    model = filled_model()
    data, actor = sample(model), model.actor
    features = model.critic.features(data.observations).detach()
    codewords = actor.codebook.codewords.detach()
    nearest = th.zeros(len(features), dtype=th.long)
    monkeypatch.setattr(actor, "draw_latents", lambda *_, **__: (codewords[nearest], nearest))

    def q_loss(*values):
        of_latents = th.tensor(values)[:, None]
        monkeypatch.setattr(
            model.critic, "score1", lambda _, latents, *__: (latents[:, None] == codewords).all(dim=2).float() @ of_latents
        )
        th.manual_seed(0)
        return losses.discrete_policy_loss(model.policy, data, features)[1].item()

    bad = q_loss(0.0, -1.0, -2.0)
    assert bad == pytest.approx(q_loss(0.0, -10.0, -20.0))
    assert bad != pytest.approx(q_loss(0.0, -0.1, -0.2))


def next_q_values(policy, features):
    """min Q' of the next action that the online critics select, of CHDP beside a share of that of a random one."""
    actor, critic = policy.actor_target, policy.critic_target
    latents, _, parameters = policy.select_target(actor, policy.critic, features)
    values = th.min(*critic.q_values(features, latents, parameters))
    if isinstance(policy, PaperPolicy):
        return values
    latents, _, parameters = actor.random_actions(len(features))
    return 0.9 * values + 0.1 * th.min(*critic.q_values(features, latents, parameters))


@BOTH
def test_target_values(algorithm_class):
    """r + gamma (1 - d) times the value of what follows, and r; n-step discounts replace gamma."""
    model = filled_model(algorithm_class=algorithm_class, gamma=0.9)
    policy, critic = model.policy, model.critic_target
    data = sample(model)._replace(dones=(th.arange(32)[:, None] % 2).float())
    policy.in_units_of_critics(th.randn(32, 2))  # until then all values are the same
    features = critic.features(data.next_observations)

    def expected(discounts):
        th.manual_seed(0)
        with th.no_grad():
            next_values = policy.value_scale.values(next_q_values(policy, features))
        return th.cat([data.rewards + discounts * (1 - data.dones) * next_values, data.rewards], dim=1)

    for discounts in (0.9, th.full((32, 1), 0.1)):
        th.manual_seed(0)
        targets, _ = losses.target_values(policy, data._replace(discounts=discounts))
        th.testing.assert_close(targets, expected(discounts))
        assert targets.shape == (32, 2) and not targets.requires_grad
        assert ((targets[:, 0] == targets[:, 1]) == (data.dones[:, 0] == 1)).all()


def test_next_values_are_whole_without_foresight():
    """Foresight matters for the choice of the next action, not for what it is worth."""
    model = filled_model()
    data, policy = sample(model), model.policy
    policy.in_units_of_critics(th.randn(32, 2))
    policy.set_foresight(0.0)
    features = model.critic_target.features(data.next_observations)
    th.manual_seed(0)
    targets, _ = losses.target_values(policy, data._replace(discounts=0.9, dones=0.0))
    th.manual_seed(0)
    q_values = next_q_values(policy, features)
    policy.set_foresight(1.0)
    th.manual_seed(0)
    assert not th.equal(next_q_values(policy, features), q_values)
    th.testing.assert_close(targets[:, :1], data.rewards + 0.9 * policy.value_scale.values(q_values))


def test_costs_of_stored_and_of_random_actions():
    """By how much the critics value them less than the best action."""
    model = filled_model()
    data, policy = sample(model), model.policy
    critic, codebook = policy.critic_target, policy.actor_target.codebook
    features = critic.features(data.next_observations)
    calls = calls_of(critic.q_networks[0])
    _, costs = losses.next_values(policy, data.next_observations, stored=data.actions)
    best, of_random, of_stored = [args[1:] for args in calls]
    assert th.equal(of_stored[0], codebook.representative_latents(data.discrete_actions))
    assert th.equal(of_stored[1], data.parameters)
    with th.no_grad():
        q, q_random, q_stored = (th.min(*critic.q_values(features, *action)) for action in (best, of_random, of_stored))
    th.testing.assert_close(costs, th.cat([q - q_stored, q - q_random], dim=1))


def test_next_actions_obey_masks():
    """The random ones as well as the best."""
    model = filled_model()
    data, policy = sample(model), model.policy
    calls = calls_of(policy.critic_target.q_networks[0])
    masks = th.zeros(32, policy.actor.codebook.n_discrete_actions, dtype=th.bool)
    masks[:, 1] = True
    losses.next_values(policy, data.next_observations, masks)
    allowed = policy.actor_target.codebook.representative_latents(th.tensor([1]))
    assert len(calls) == 2 and all((latents == allowed).all() for _, latents, _ in calls)


@BOTH
def test_critic_loss(algorithm_class):
    """The sum of both squared errors, weighted; priorities follow the larger error of both critics."""
    model = filled_model(algorithm_class=algorithm_class)
    data, targets = sample(model), th.randn(32, 1)
    features = model.critic.features(data.observations)
    q1, q2 = model.critic.q_values(features, data.latents, data.parameters)
    loss, values, errors = losses.critic_loss(model.policy, data._replace(weights=1.0), features, targets)
    th.testing.assert_close(loss, F.mse_loss(q1, targets) + F.mse_loss(q2, targets))
    th.testing.assert_close(values, q1.detach())
    th.testing.assert_close(errors, th.cat([(q - targets).abs() for q in (q1, q2)], dim=1).amax(dim=1).detach())
    one = th.zeros(32, 1)
    one[3] = 1.0
    weighted, *_ = losses.critic_loss(model.policy, data._replace(weights=one), features, targets)
    th.testing.assert_close(weighted, ((q1[3] - targets[3]) ** 2 + (q2[3] - targets[3]) ** 2).squeeze() / 32)


@pytest.mark.parametrize("weight", [1.0, 3.0])
def test_reward_loss(weight):
    model = filled_model()
    data, targets, critic = sample(model)._replace(weights=th.full((32, 1), weight)), th.randn(32, 1), model.critic
    features = critic.features(data.observations).detach()
    loss = losses.reward_loss(model.policy, data, features, targets)
    rewards = critic.reward_network(features, data.latents, data.parameters)
    th.testing.assert_close(loss, weight * F.mse_loss(rewards, targets))
    assert networks_with_gradient(model, loss) == {"rewards"}
