"""What the critics of CHDP see, and what they can fit for it."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_chdp import CHDP
from sb3_chdp.chdp.codebook import Codebook
from sb3_chdp.chdp.critic import AttentionReads, QNetwork
from sb3_chdp.chdp.product_codebook import ProductCodebook
from tests.algorithms import make_model
from tests.fitting import unexplained
from tests.hybrid_envs import box, make_layout_env

N_FEATURES, LATENT_DIM = 6, 32


def make_q_network(n_reads=4, n_features=N_FEATURES, latent_dim=LATENT_DIM, n_parameters=1, n_positions=0):
    th.manual_seed(0)
    widths = th.full((latent_dim,), latent_dim)
    return QNetwork(n_features, n_positions, widths, n_parameters, [64, 64], th.nn.SiLU, n_reads)


def test_values_are_bounded():
    """However far from all data: the last hidden layers are normalised."""
    q_network = make_q_network()
    features, latents, parameters = th.randn(50, N_FEATURES), th.rand(50, LATENT_DIM), th.rand(50, 1)
    near, far = (q_network(scale * features, latents, scale * parameters) for scale in (1, 1e6))
    assert far.abs().max() < 10 * near.abs().max()


def test_reads_are_means_of_features():
    """Which features they are of depends on the latent alone."""
    reads, x, e = AttentionReads(5, 3, 4), th.randn(7, 5), th.randn(7, 3)
    assert reads(x, e).shape == (7, 4)
    th.testing.assert_close(reads(2 * x + 1, e), 2 * reads(x, e) + 1)
    weights = th.stack([reads(th.eye(5)[i : i + 1].expand(7, 5), e) for i in range(5)], dim=2)
    assert (weights > 0).all()
    th.testing.assert_close(weights.sum(dim=2), th.ones(7, 4))
    th.testing.assert_close(reads(x, e), (weights * x[:, None]).sum(dim=2))


def test_reads_find_what_an_action_is_about():
    """Each of 32 actions is worth the difference of two features of its own: reads fit it in 400 steps, an MLP does not."""
    left = []
    for reads in (False, True):
        q_network = make_q_network(n_reads=8, n_features=24)
        if not reads:
            th.nn.init.zeros_(q_network.reads.logits.weight).requires_grad_(False)
        codewords, (gains, losses) = 2 * th.rand(32, LATENT_DIM) - 1, th.rand(32, 24).argsort(dim=1)[:, :2].T

        def batch(q_network=q_network, codewords=codewords, gains=gains, losses=losses):
            k, features = th.randint(32, (256,)), th.randn(256, 24)
            values = features.gather(1, gains[k, None]) - features.gather(1, losses[k, None])
            return q_network(features, codewords[k], th.zeros(256, 1)), values

        left.append(unexplained(q_network, batch, 400))
    assert left[1] < 0.2 * left[0]


@pytest.mark.parametrize(
    "policy, space, reads",
    [("MlpPolicy", box(-1, 1, 3), True), ("CnnPolicy", spaces.Box(0, 255, (36, 36, 1), np.uint8), False)],
)
def test_only_entries_of_observations_are_read(policy, space, reads):
    """What a convolutional network puts out is learnt, and there is much of it."""
    model = make_model(CHDP, make_layout_env(observation_space=space), policy)
    for network in (model.actor, *model.critic.q_networks, model.critic.reward_network):
        assert any(isinstance(module, AttentionReads) for module in network.modules()) == reads


def test_values_drop_where_an_entry_passes_a_threshold():
    """One of four entries above 0.95: critics that see positions fit the drop in 300 steps, others do not."""
    left = []
    for n_positions in (0, 4):
        q_network = make_q_network(n_features=4, n_positions=n_positions)

        def batch(q_network=q_network, n_positions=n_positions):
            x = th.rand(128, 4)
            beyond = x.max(dim=1, keepdim=True)[0] > 0.95
            features = th.cat([x, x[:, :n_positions]], dim=1)
            return q_network(features, th.zeros(128, LATENT_DIM), th.zeros(128, 1)), -beyond.float()

        left.append(unexplained(q_network, batch, 300))
    assert left[1] < 0.3 < left[0]


def test_several_actions_of_a_state():
    """As if its features stood there for each of them."""
    q_network, features = make_q_network(n_positions=2), th.rand(5, N_FEATURES + 2)
    latents, parameters = th.rand(15, LATENT_DIM), th.rand(15, 1)
    values = q_network(features, latents, parameters)
    th.testing.assert_close(values, q_network(features.repeat_interleave(3, dim=0), latents, parameters))


def test_value_of_the_state_and_advantages_add_up():
    """What does not depend on the action may come from a network that does not see it."""
    q_network, features = make_q_network(), th.randn(5, N_FEATURES)
    latents, parameters = th.rand(2, 5, LATENT_DIM), th.rand(2, 5, 1)
    before = [q_network(features, latents[i], parameters[i]) for i in range(2)]
    with th.no_grad():
        q_network.value[-1].bias += 3.0
    after = [q_network(features, latents[i], parameters[i]) for i in range(2)]
    for old, new in zip(before, after, strict=True):
        th.testing.assert_close(new, old + 3)
    assert (before[0] != before[1]).all()


def test_rescaled_values():
    q_network, inputs = make_q_network(), (th.randn(9, N_FEATURES), th.rand(9, LATENT_DIM), th.rand(9, 1))
    before = q_network(*inputs)
    q_network.rescale(th.tensor(0.01), th.tensor(5.0))
    th.testing.assert_close(q_network(*inputs), 0.01 * before + 5)


@pytest.mark.parametrize(
    "codebook, widths, norms",
    [
        (Codebook(3, LATENT_DIM), [LATENT_DIM], [2.0]),
        (ProductCodebook((2, 3, 40), LATENT_DIM), [1, 2, LATENT_DIM], [1.0, 2**0.5, 2.0]),
    ],
)
def test_wide_codewords_do_not_outweigh_features(codebook, widths, norms):
    """What A sees of a choice's codeword, alone and times a parameter, is no longer than 2; narrow ones stay as they are."""
    network, seen = QNetwork(1, 0, codebook.latent_widths(), 1, [8], th.nn.SiLU, 0), []
    network.advantage.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0][0]))
    network(th.zeros(1, 1), th.ones(1, sum(widths)), th.ones(1, 1))
    latents, products = seen[0][2:].chunk(2)
    for inputs in (latents, products):
        assert [part.norm().item() for part in inputs.split(widths)] == pytest.approx(norms)
