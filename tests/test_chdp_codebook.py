"""The codebook of CHDP: how it decodes, and where training leads its codewords."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_chdp import CHDP
from sb3_chdp.chdp import PaperCHDP
from sb3_chdp.chdp.codebook import Codebook
from tests.algorithms import fast_model, filled_model
from tests.hybrid_envs import LayoutEnv, box


def many_actions(n_actions, **kwargs):
    return LayoutEnv(spaces.Tuple((spaces.Discrete(n_actions), box(-1, 1, 1))), **kwargs)


class WithoutCritics(CHDP):
    """The codebook learns from the continuous policy alone."""

    critics_train_codebook = False


@settings(max_examples=50, deadline=None)
@given(k=st.integers(1, 40), dim=st.integers(1, 10), seed=st.integers(0, 1000))
def test_nearest_codeword_against_brute_force(k, dim, seed):
    th.manual_seed(seed)
    codebook = Codebook(k, dim)
    latents = th.rand(30, dim) * 2 - 1
    distances = (latents[:, None] - codebook.codewords.detach()).square().sum(dim=2)
    chosen = distances.gather(1, codebook.quantize(latents)[:, None])
    th.testing.assert_close(chosen, distances.min(dim=1, keepdim=True).values, atol=1e-5, rtol=1e-5)


def test_usage():
    codebook = Codebook(8, 2)
    usage, perplexity = codebook.usage(th.tensor([0, 0, 3, 3]))
    assert usage.item() == 0.25 and perplexity.item() == pytest.approx(2)
    assert codebook.usage(th.tensor([5]))[1].item() == pytest.approx(1)


def test_codebook_stays_where_the_latents_are():
    model = filled_model(codebook_lr_factor=500.0)
    with th.no_grad():
        model.actor.codebook.codewords[0] = 0.9999
    before = model.actor.codebook.codewords.detach().clone()
    model.train(4, 32)
    codewords = model.actor.codebook.codewords.detach()
    assert codewords.abs().max() <= 1 and (codewords != before).any()


def distance_of_groups(algorithm_class):
    """
    Of 16 actions the odd ones earn 1, the even ones -1.

    :return: distance of the mean codewords of the two groups after training, relative to the spread within them
    """
    kwargs = dict(gamma=0.0, codebook_lr_factor=10.0, latent_dim=8, replay_buffer_class=ReplayBuffer)
    model = filled_model(many_actions(16), algorithm_class, **kwargs)
    buffer = model.replay_buffer
    buffer.rewards[:] = 2 * (buffer.actions[:, :, 0] % 2) - 1
    model.train(300, 32)
    even, odd = (model.actor.codebook.codewords.detach()[i::2] for i in (0, 1))
    return (odd.mean(dim=0) - even.mean(dim=0)).norm() / (odd.std(dim=0).norm() + even.std(dim=0).norm())


def test_critics_bring_codewords_of_similar_actions_together():
    """From the same codewords, they move the two groups apart more than the continuous policy alone does."""
    assert distance_of_groups(CHDP) > 2 * distance_of_groups(WithoutCritics)


@pytest.mark.slow
@pytest.mark.parametrize("reward", [0.0, 12345.678])
def test_codewords_stay_apart_where_all_actions_are_worth_the_same(reward):
    """Every action can still be chosen, though nothing tells the critics that they differ."""

    class ConstantEnv(LayoutEnv):
        def step(self, action):
            obs, _, *end = super().step(action)
            return obs, reward, *end

    env = ConstantEnv(spaces.Tuple((spaces.Discrete(8), box(-1, 1, 1))))
    model = filled_model(env, n_transitions=300, latent_dim=8)
    before = th.pdist(model.actor.codebook.codewords.detach())
    model.train(700, 32)
    for actor in (model.actor, model.actor_target):
        codewords = actor.codebook.codewords.detach()
        assert (actor.codebook.quantize(codewords) == th.arange(8)).all()
        assert (th.pdist(codewords) / before).min() > 0.3


@pytest.mark.parametrize("n_actions", [2, 1000])
def test_random_rows_decode_to_their_action(n_actions):
    """Of the paper's algorithm, whose rows hold latents."""
    model = fast_model(PaperCHDP, env=many_actions(n_actions))
    rows = model.policy.random_rows(np.random.default_rng(0), 500)
    latents = th.as_tensor(model.hybrid_space.columns.view(rows, "latents"))
    # A few cells are too small for the noise
    assert (model.actor.codebook.quantize(latents).numpy() == rows[:, 0]).mean() > 0.97
    assert np.abs(rows[:, 1:]).max() <= 1
