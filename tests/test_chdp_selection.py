"""Which of several actions CHDP takes."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_chdp.chdp.candidates import FixedDraws, SelectedActions, Selection, refined
from sb3_chdp.chdp.critic import HybridCritic
from sb3_chdp.chdp.policies import N_NEXT_ACTIONS
from tests.algorithms import calls_of, filled_model
from tests.hybrid_envs import HybridIdentityEnv, LayoutEnv, box, make_layout_env

N_ACTIONS = 3
KINDS = {
    "drawn": Selection(n_drawn=4),
    "uniform": Selection(n_drawn=2, n_alternatives=N_ACTIONS),
    "random": Selection(n_drawn=1, n_random=8),
    "all": Selection(n_drawn=2, n_alternatives=2, n_random=5),
}
SELECTIONS = pytest.mark.parametrize("select", KINDS.values(), ids=KINDS)


class Critic(HybridCritic):
    """Two value functions of the actions, which notes the candidates that it is asked about."""

    def __init__(self, q1, q2=None):
        th.nn.Module.__init__(self)
        self.q1, self.q2, self.asked = q1, q2 or q1, []

    def scores(self, features, latents, parameters):
        features = features.repeat_interleave(len(latents) // len(features), dim=0)
        assert len(features) == len(latents) == len(parameters)
        q1, q2 = self.q1(features, latents, parameters), self.q2(features, latents, parameters)
        self.asked.append((features, latents, parameters, th.min(q1, q2)))
        return q1, q2


def near(value):
    """Worth more the nearer the first parameter is."""
    return lambda features, latents, parameters: -(parameters[:, :1] - value).abs()


def fixed_draws(actor, batch_size, select):
    """All that is random in a selection."""
    n_latents, n_parameters = batch_size * select.n_drawn, batch_size * (select.n_drawn + select.n_alternatives)
    latents, parameters = actor.discrete_policy, actor.continuous_policy
    return FixedDraws(
        th.randn(latents.n_steps, n_latents, latents.dim),
        th.randn(parameters.n_steps, n_parameters, parameters.dim),
        *actor.random_actions(select.n_random)[1:],
    )


@pytest.fixture(scope="module")
def actor():
    return filled_model().actor.requires_grad_(False)


def random_features(actor, n):
    # Both policies see them, the continuous one more besides
    return th.randn(n, actor.discrete_policy.noise_predictor.of_condition.in_features)


@SELECTIONS
def test_the_best_of_all_candidates_is_taken(actor, select):
    """The best by the smaller of both values, for each observation among its own candidates."""
    features = random_features(actor, 5)
    critic = Critic(
        lambda features, latents, parameters: features[:, :1] * parameters + latents[:, :1],
        lambda features, latents, parameters: features[:, 1:2] * parameters.square() - latents[:, 1:2],
    )
    latents, k, parameters = select(actor, critic, features)
    assert latents.shape == (5, 4) and k.shape == (5,) and parameters.shape == (5, 1)
    assert (actor.codebook.quantize(latents) == k).all()
    (asked,) = critic.asked
    n = select.n_drawn + select.n_alternatives + select.n_random
    assert len(asked[0]) == 5 * n and (asked[0].view(5, n, -1) == features[:, None]).all()
    best = asked[3].view(5, n).argmax(dim=1)
    for chosen, of_all in ((latents, asked[1]), (parameters, asked[2])):
        assert th.equal(chosen, of_all.view(5, n, -1)[th.arange(5), best])


@SELECTIONS
def test_with_fixed_draws_the_choice_repeats(actor, select):
    features, critic = random_features(actor, 5), Critic(near(0.3))
    fixed = fixed_draws(actor, 5, select)
    first, second, other = (select(actor, critic, features, n) for n in (fixed, fixed, fixed_draws(actor, 5, select)))
    assert all(th.equal(a, b) for a, b in zip(first, second, strict=True))
    assert (first.parameters != other.parameters).any()
    free = [select(actor, critic, features).parameters for _ in range(2)]
    assert (free[0] != free[1]).any()


def test_every_discrete_action_competes_where_there_are_few(actor):
    """With what the continuous policy draws for it, so that one that the critics prefer gets tried."""
    codewords = actor.codebook.codewords
    for wanted in range(N_ACTIONS):
        critic = Critic(lambda _, latents, parameters, c=codewords[wanted]: -(latents - c).norm(dim=1, keepdim=True))
        assert (Selection(1, N_ACTIONS)(actor, critic, random_features(actor, 50)).discrete_actions == wanted).all()


def test_three_discrete_actions_all_compete_in_targets():
    """An action that is missing among the next ones makes states worth too little in which it is the best."""
    assert filled_model().policy.select_target.n_alternatives == N_ACTIONS == 3
    many = LayoutEnv(spaces.Tuple((spaces.Discrete(N_NEXT_ACTIONS), box(-1, 1, 1))))
    assert filled_model(many).policy.select_target.n_alternatives < N_NEXT_ACTIONS


def test_sampled_values_try_what_the_critics_disagree_about(actor):
    """Of three actions one is worth 0, one 1 or -1, the critics do not know, and one -2."""
    of_actions = th.tensor([[0.0, 0.0], [1.0, -1.0], [-2.0, -2.0]])
    q1, q2 = (lambda _, latents, parameters, i=i: of_actions[actor.codebook.quantize(latents), i, None] for i in range(2))
    for sampled in (False, True):
        select, features = Selection(1, N_ACTIONS, sampled=sampled), random_features(actor, 200)
        k = select(actor, Critic(q1, q2), features).discrete_actions
        share = (k == 1).float().mean()
        assert (k <= 1).all() and (0.3 < share < 0.8 if sampled else share == 0)


def test_fewer_uniform_actions_than_there_are(actor):
    """Each observation gets some at random, all of them equally often."""
    critic = Critic(near(0.0))
    Selection(1, 2)(actor, critic, random_features(actor, 600))
    k = actor.codebook.quantize(critic.asked[0][1]).view(600, 3)[:, :2]
    assert (k[:, 0] != k[:, 1]).all()
    assert (th.bincount(k.flatten(), minlength=N_ACTIONS) / 1200).numpy() == pytest.approx(1 / N_ACTIONS, abs=0.05)


def test_random_candidates_find_what_the_policies_miss():
    """With policies that never draw what the critics value."""
    model = filled_model()
    with th.no_grad():
        for parameter in model.actor.continuous_policy.parameters():
            parameter.zero_()
    features = random_features(model.actor, 50)
    errors = [
        (select(model.actor, Critic(near(0.7)), features).parameters - 0.7).abs().mean()
        for select in (Selection(1), Selection(1, n_random=64))
    ]
    assert errors[1] < 0.1 < errors[0]


def refine(actor, critic, start, n=32, spread=0.1):
    """:return: what refined actions have for parameters, all of action 1"""
    k = th.ones(len(start), dtype=th.long)
    actions = SelectedActions(actor.codebook.representative_latents(k), k, start)
    latents, same_k, parameters = refined(actor, critic, random_features(actor, len(start)), actions, n, spread)
    assert th.equal(latents, actions.latents) and th.equal(same_k, k)
    return parameters


def test_refinement():
    """Parameters come nearer to what is worth more; the discrete action and padding stay."""
    parameters = spaces.Tuple((box(-1, 1, 1), box(-1, 1, 2)))
    model = filled_model(LayoutEnv(spaces.Tuple((spaces.Discrete(2), parameters))))
    actor, mask = model.actor, th.as_tensor(np.array(model.hybrid_space.spec.parameter_mask)).bool()
    assert not mask.all()
    features = random_features(actor, 50)
    noise, critic = fixed_draws(actor, 50, Selection(1)), Critic(near(0.7))
    plain = Selection(1)(actor, critic, features, noise)
    moved = Selection(1, n_refined=32)(actor, critic, features, noise)
    assert th.equal(plain.discrete_actions, moved.discrete_actions) and th.equal(plain.latents, moved.latents)
    assert not moved.parameters[~mask[moved.discrete_actions]].any() and moved.parameters.abs().max() <= 1
    before, after = ((chosen.parameters[:, 0] - 0.7).abs() for chosen in (plain, moved))
    far = before > 0.2
    assert far.any() and (after < before - 0.05)[far].all() and (after < 0.2)[~far].all()


@pytest.mark.parametrize("factor", [1e-3, 1.0, 1e3])
def test_refinement_is_continuous_in_the_values(actor, factor):
    """What rounding does to the values hardly moves the parameters, be the values flat or steep."""
    start = th.linspace(-1, 1, 200)[:, None]

    def value(rounding):
        return lambda _, __, parameters: factor * (3 * parameters).sin() * (1 + rounding * (1e5 * parameters).sin())

    exact, rounded = (refine(actor, Critic(value(rounding)), start) for rounding in (0.0, 1e-6))
    assert (exact - rounded).abs().max() < 1e-5
    assert (exact - start).abs().max() > 0.01 * min(factor, 1)


def test_refinement_leaves_what_is_best(actor):
    """At a peak, where nothing is worth more or less, and at the bounds, outside which there is nothing."""

    def flat(_, __, parameters):
        return 0 * parameters[:, :1]

    for value, best in ((near(0.3), 0.3), (flat, 0.6), (near(2.0), 1.0), (near(-2.0), -1.0)):
        start = th.full((1, 1), best)
        assert refine(actor, Critic(value), start).item() == pytest.approx(best, abs=1e-5)


def test_changes_of_single_choices():
    """Of a factored action every bit turns to what is better on its own; bits that may not change stay."""
    model = filled_model(LayoutEnv(spaces.Tuple((spaces.MultiBinary(12), box(-1, 1, 1)))))
    actor, features = model.actor, random_features(model.actor, 50)
    ones = actor.codebook.representative_latents(th.ones(1, 12, dtype=th.long))
    critic = Critic(lambda _, latents, parameters: -(latents - ones).abs().gt(1e-6).sum(dim=1, keepdim=True).float())
    masks = th.ones(50, 24, dtype=th.bool)
    masks[:, 1] = False  # the first bit is off
    fixed = fixed_draws(actor, 50, Selection(2))
    plain, changed = (select(actor, critic, features, fixed, masks) for select in (Selection(2), Selection(2, n_changed=24)))
    distances = (changed.discrete_actions != plain.discrete_actions).sum(dim=1)
    assert (distances == 1).any() and distances.max() == 1 and not changed.discrete_actions[:, 0].any()
    assert (changed.discrete_actions[:, 1:].sum(dim=1) >= plain.discrete_actions[:, 1:].sum(dim=1)).all()
    assert th.equal(changed.parameters, plain.parameters)


@pytest.mark.parametrize("deterministic", [False, True])
def test_predictions_are_the_best_candidates(deterministic):
    """The rows that predict returns are those among all that it asks the target critics about which have the highest Q."""
    model = filled_model(n_action_candidates=8)
    obs = np.random.uniform(-1, 1, (6, 4)).astype(np.float32)
    columns, q_networks = model.hybrid_space.columns, model.critic_target.q_networks
    calls = calls_of(q_networks[0])
    outputs: tuple[list, list] = ([], [])
    for network, values in zip(q_networks, outputs, strict=True):
        network.register_forward_hook(lambda module, args, q, values=values: values.append(q.detach()))
    rows = model.policy.predict_rows(obs, deterministic)
    q1, q2 = (values[0].view(6, -1) for values in outputs)
    latents, parameters = (asked.view(6, -1, asked.shape[1]) for asked in calls[0][1:])
    k = model.actor.codebook.quantize(latents.flatten(0, 1)).view(6, -1).numpy()
    acted, acted_k = columns.view(rows, "parameters"), columns.discrete_actions(rows)
    if deterministic:
        best = th.min(q1, q2).argmax(dim=1)
        # They are refined: what the parameters are near to
        np.testing.assert_allclose(acted, parameters[th.arange(6), best], atol=0.5)
        assert (k[np.arange(6), best] == acted_k).all()
    else:
        # Which is best depends on draws between both critics
        may_be_best = th.max(q1, q2) >= th.min(q1, q2).amax(dim=1, keepdim=True)
        is_acted = (parameters.numpy() == acted[:, None]).all(axis=2) & (k == acted_k[:, None])
        assert (is_acted & may_be_best.numpy()).any(axis=1).all()
    assert len(calls[0][1]) >= 6 * (model.n_action_candidates + N_ACTIONS)


def test_more_candidates_for_deterministic_predictions_are_drawn_by_the_target_policies():
    """They do not waver as the policies do; rollouts follow these."""
    model = filled_model()
    obs = np.random.uniform(-1, 1, (6, 4)).astype(np.float32)
    for deterministic in (False, True):
        counts = [calls_of(actor.discrete_policy.noise_predictor) for actor in (model.actor, model.actor_target)]
        model.policy.predict_rows(obs, deterministic)
        assert [len(calls) > 0 for calls in counts] == [not deterministic, deterministic]


def test_deterministic_predictions_repeat():
    model = filled_model()
    obs = np.random.uniform(-1, 1, (5, 4)).astype(np.float32)
    first = model.policy.predict_rows(obs, deterministic=True)
    np.testing.assert_array_equal(model.policy.predict_rows(obs, deterministic=True), first)
    # The same for an observation on its own as among others
    for one, row in zip(obs, first, strict=True):
        np.testing.assert_allclose(model.policy.predict_rows(one, deterministic=True), row, atol=1e-5)
    assert (model.policy.predict_rows(obs) != first).any()


@pytest.mark.parametrize("env", [HybridIdentityEnv(), make_layout_env("nested")], ids=["equal", "padding"])
def test_predictions_are_valid(env):
    model = filled_model(env)
    obs = np.stack([env.observation_space.sample() for _ in range(50)])
    for deterministic in (False, True):
        assert all(env.action_space.contains(action) for action in model.predict(obs, deterministic=deterministic)[0])
