"""Selection: several actions per observation, of which the critics choose one."""

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
import torch as th

from sb3_chdp.chdp.actor import CooperativeActor
from sb3_chdp.chdp.critic import HybridCritic

# Standard deviations of the changes of the parameters in successive refinements
REFINEMENT_SPREADS = (0.1, 0.03)
# Spread of the values, in the critics' units, below which parameters hardly move: rounding must not
FLAT_VALUES = 0.01


class SelectedActions(NamedTuple):
    """
    A hybrid action for each of B observations.

    :ivar latents: (B, latent_dim)
    :ivar discrete_actions: (B,), (B, L) of a factored space
    :ivar parameters: (B, Pmax), padding 0
    """

    latents: th.Tensor
    discrete_actions: th.Tensor
    parameters: th.Tensor


class FixedDraws(NamedTuple):
    """
    What takes the place of everything random, so that a prediction can be repeated.

    :ivar latent_noise: (N, B * n_drawn, latent_dim) noise of the discrete policy's chains
    :ivar parameter_noise: (N, B * (n_drawn + n_alternatives), Pmax) noise of the continuous policy's chains
    :ivar discrete_actions: (n_random, ...) those of the random actions, which are the same for all observations
    :ivar parameters: (n_random, Pmax) their parameters, padding 0
    """

    latent_noise: th.Tensor
    parameter_noise: th.Tensor
    discrete_actions: th.Tensor
    parameters: th.Tensor


class Candidates(NamedTuple):
    """
    n hybrid actions for each of B observations.

    :ivar latents: (B, n, latent_dim)
    :ivar discrete_actions: (B, n), (B, n, L) of a factored space
    :ivar parameters: (B, n, Pmax), padding 0
    """

    latents: th.Tensor
    discrete_actions: th.Tensor
    parameters: th.Tensor

    def join(self, others: "Candidates") -> "Candidates":
        """:return: these and the others, which may be the same for all observations (B = 1)"""
        batch_size = self.latents.shape[0]
        return Candidates(*(th.cat([a, b.expand(batch_size, *b.shape[1:])], dim=1) for a, b in zip(self, others, strict=True)))

    def values(self, critic: HybridCritic, features: th.Tensor, sampled: bool = False) -> th.Tensor:
        """
        :param critic: twin critic
        :param features: (B, features_dim) features of the observations
        :param sampled: whether to draw values
        :return: (B, n) the smaller of both :meth:`HybridCritic.scores`, or a uniform draw between the two
        """
        q1, q2 = critic.scores(features, self.latents.flatten(0, 1), self.parameters.flatten(0, 1))
        return (th.lerp(q1, q2, th.rand_like(q1)) if sampled else th.min(q1, q2)).view(-1, self.latents.shape[1])

    def best(
        self, critic: HybridCritic, features: th.Tensor, allowed: th.Tensor | None = None, sampled: bool = False
    ) -> SelectedActions:
        """
        :param critic: twin critic
        :param features: (B, features_dim) features of the observations
        :param allowed: (B, n) which candidates may be taken, None: all
        :param sampled: whether to draw values
        :return: the candidates of highest :meth:`values` among those that may be taken
        """
        batch_size, n = self.latents.shape[:2]
        latents, k, parameters = (part.flatten(0, 1) for part in self)
        if n == 1:  # nothing to choose
            return SelectedActions(latents, k, parameters)
        values = self.values(critic, features, sampled)
        if allowed is not None:
            values = values.masked_fill(~allowed, -th.inf)
        best = values.argmax(dim=1) + th.arange(batch_size, device=features.device) * n
        return SelectedActions(latents[best], k[best], parameters[best])


def drawn_candidates(
    actor: CooperativeActor,
    features: th.Tensor,
    n: int,
    n_alternatives: int,
    fixed: FixedDraws | None = None,
    masks: th.Tensor | None = None,
) -> Candidates:
    """
    Actions that the policies draw, and others of which the continuous policy draws the parameters alone.

    :param actor: the policies
    :param features: (B, features_dim) features of the observations
    :param n: number of actions per observation that both policies draw
    :param n_alternatives: number of further discrete actions, see :meth:`Codebook.alternatives`
    :param fixed: what to take for all that is random; None: draw
    :param masks: (B, K) False for discrete actions that the discrete policy may not draw, None if it may draw all
    """
    # Not len(), at which torch.export would take the size of its example for the only one
    batch_size, codebook = features.shape[0], actor.codebook
    latent_noise, parameter_noise = (None, None) if fixed is None else fixed[:2]
    masks = None if masks is None else masks.repeat_interleave(n, dim=0)
    latents, k = actor.sample_latents(features.repeat_interleave(n, dim=0), latent_noise, masks)
    latents, k = latents.unflatten(0, (batch_size, n)), k.unflatten(0, (batch_size, n))
    if n_alternatives > 0:
        uniform_k = codebook.alternatives(k[:, 0], n_alternatives, fixed is not None)
        latents, k = th.cat([codebook.representative_latents(uniform_k), latents], dim=1), th.cat([uniform_k, k], dim=1)
    parameters = actor.sample_parameters(
        features.repeat_interleave(n + n_alternatives, dim=0), k.flatten(0, 1), parameter_noise
    )
    return Candidates(latents, k, parameters.view(batch_size, n + n_alternatives, -1))


def random_candidates(actor: CooperativeActor, batch_size: int, n: int, fixed: FixedDraws | None) -> Candidates:
    """
    Uniformly random actions.

    :param actor: the policies, whose codewords are the latents
    :param batch_size: number B of observations
    :param n: number of actions per observation
    :param fixed: what to take instead, for all observations (B = 1)
    """
    if fixed is None:
        return Candidates(*actor.random_actions(batch_size, n))
    k, parameters = fixed.discrete_actions[None], fixed.parameters[None]
    return Candidates(actor.codebook.representative_latents(k), k, parameters)


def changed_candidates(actor: CooperativeActor, actions: SelectedActions, n: int, repeatable: bool) -> Candidates:
    """
    Actions, and n others of each with the same parameters and another discrete action.

    :param actor: the policies, whose codewords are the latents
    :param actions: actions of B observations
    :param n: number of other discrete actions, see :meth:`ProductCodebook.alternatives`
    :param repeatable: whether to return the same changes always
    :return: candidates of B observations, the given action first, n + 1 in all
    """
    k = actor.codebook.alternatives(actions.discrete_actions, n, repeatable)
    given = Candidates(*(part[:, None] for part in actions))
    return given.join(Candidates(actor.codebook.representative_latents(k), k, given.parameters.expand(-1, n, -1)))


@cache
def _variations(n: int, n_parameters: int) -> np.ndarray:
    """:return: (n, Pmax) float32, standard normal and their negatives, constants for those who export a policy"""
    half = np.random.RandomState(0).standard_normal((n // 2, n_parameters)).astype(np.float32)
    return np.concatenate([half, -half])


def refined(
    actor: CooperativeActor, critic: HybridCritic, features: th.Tensor, actions: SelectedActions, n: int, spread: float
) -> SelectedActions:
    """
    Move the parameters towards Gaussian variations that are worth more, always the same ones.

    The move is their mean with softmax weights, in units of the values' spread (as in Williams et al., 2017): continuous in
    the values, unlike the best variation, which rounding would choose where values are close.

    :param actor: the policies
    :param critic: twin critic
    :param features: (B, features_dim) features of the observations
    :param actions: actions of B observations
    :param n: even number of variations per action
    :param spread: their standard deviation
    :return: the actions with other parameters
    """
    latents, k, parameters = actions
    moves = spread * th.as_tensor(_variations(n, parameters.shape[1]), device=parameters.device)[None]
    mask = actor.padding_mask(k)
    moves = moves.expand(parameters.shape[0], -1, -1) if mask is None else moves * mask[:, None]
    varied = (parameters[:, None] + moves).clamp(-1, 1)
    values = Candidates(latents[:, None].expand(-1, n, -1), k[:, None], varied).values(critic, features)
    scores = (values - values.mean(dim=1, keepdim=True)) / (values.std(dim=1, keepdim=True) + FLAT_VALUES)
    # Moves as they were before they were clamped: parameters at a bound stay there if what lies inside is worth less
    moved = parameters + (scores.softmax(dim=1)[:, :, None] * moves).sum(dim=1)
    return SelectedActions(latents, k, moved.clamp(-1, 1))


@dataclass(frozen=True)
class Selection:
    """
    A rule which actions compete. The one of highest :meth:`Candidates.values` is taken, and refined if ``n_refined`` is not 0.

    With sampled values an action that is rarely taken, which the critics disagree about, now and then looks the best and is
    tried, as in Thompson sampling.

    :param n_drawn: number of actions per observation that both policies draw
    :param n_alternatives: number of further discrete actions with parameters of the continuous policy: successive ones from a
        random one on, or evenly spread ones
    :param n_random: number of uniformly random actions
    :param n_changed: number of discrete actions that take the place of that of the best of all these, for spaces in which all
        share their parameters
    :param n_refined: number of variations towards which the parameters of the best of all these move, in each of two rounds
        with standard deviations of ``REFINEMENT_SPREADS`` of the scaled parameters; see :func:`refined`
    :param sampled: whether values are draws between those of both critics, instead of the smaller one
    """

    n_drawn: int
    n_alternatives: int = 0
    n_random: int = 0
    n_changed: int = 0
    n_refined: int = 0
    sampled: bool = False

    def __call__(
        self,
        actor: CooperativeActor,
        critic: HybridCritic,
        features: th.Tensor,
        fixed: FixedDraws | None = None,
        masks: th.Tensor | None = None,
    ) -> SelectedActions:
        """
        :param actor: the policies
        :param critic: the critics that choose
        :param features: (B, features_dim) features of the observations
        :param fixed: what to take for all that is random; None: draw
        :param masks: (B, K) False for discrete actions that may not be taken, None if all may
        """

        def allowed(candidates: Candidates) -> th.Tensor | None:
            return None if masks is None else actor.codebook.allowed(candidates.discrete_actions, masks)

        candidates = drawn_candidates(actor, features, self.n_drawn, self.n_alternatives, fixed, masks)
        if self.n_random > 0:
            candidates = candidates.join(random_candidates(actor, features.shape[0], self.n_random, fixed))
        best = candidates.best(critic, features, allowed(candidates), self.sampled)
        if self.n_changed > 0:
            candidates = changed_candidates(actor, best, self.n_changed, fixed is not None)
            best = candidates.best(critic, features, allowed(candidates), self.sampled)
        for spread in REFINEMENT_SPREADS if self.n_refined > 0 else ():
            best = refined(actor, critic, features, best, self.n_refined, spread)
        return best
