"""The losses of CHDP, one function for each of the paper's equations, and the relabelling of stored latents."""

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_chdp.chdp.policies import CHDPPolicy
from sb3_chdp.common.samples import HybridReplaySamples


def relabel_latents(policy: CHDPPolicy, replay_data: HybridReplaySamples) -> tuple[HybridReplaySamples, th.Tensor]:
    """
    Give latents that the codebook has moved away from the present codeword of the stored action.

    :param policy: the networks
    :param replay_data: a batch
    :return: the batch, and the share of its latents that did not decode to the stored action
    """
    codebook = policy.actor.codebook
    drifted = codebook.quantize(replay_data.latents) != replay_data.discrete_actions
    present = codebook.representative_latents(replay_data.discrete_actions)
    latents = th.where(drifted[:, None], present, replay_data.latents)
    return replay_data._replace(latents=latents), drifted.float().mean()


@th.no_grad()
def next_state_values(policy: CHDPPolicy, next_obs: PyTorchObs, n_candidates: int) -> th.Tensor:
    """
    :param policy: the networks
    :param next_obs: B next observations
    :param n_candidates: number of next actions that the target policies draw per observation, of which the best counts
    :return: (B, 1) min(Q1, Q2) of the target critics
    """
    actor, critic = policy.actor_target, policy.critic_target
    *_, q_values = policy.best_candidate(actor, actor.features(next_obs), critic.features(next_obs), n_candidates)
    return q_values


def critic_loss(
    policy: CHDPPolicy, replay_data: HybridReplaySamples, n_target_candidates: int
) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    """
    Eq. 10, (Q_j(s, e, a) - y)^2, with the target of eq. 11, y = r + gamma min_j Q'_j(s', e', a'); weighted if the replay is
    prioritised. It has a gradient for the codebook, which may be used.

    :param policy: the networks
    :param replay_data: a batch
    :param n_target_candidates: number of next actions drawn per transition, see :func:`next_state_values`
    :return: their sum over both critics, the detached (B, 1) values of the first, and the larger (B,) absolute error of both
    """
    next_q_values = next_state_values(policy, replay_data.next_observations, n_target_candidates)
    target_q_values = replay_data.rewards + (1 - replay_data.dones) * replay_data.discounts * next_q_values
    features = policy.critic.features(replay_data.observations)
    # The gradient with respect to a latent is also that of its codeword, as if the one moved with the other
    codewords = policy.actor.codebook(replay_data.discrete_actions)
    latents = replay_data.latents + (codewords - codewords.detach())
    q1, q2 = policy.critic.q_values(features, latents, replay_data.parameters)
    errors = th.cat([q1, q2], dim=1) - target_q_values
    loss = (replay_data.weights * errors.square()).sum(dim=1).mean()
    return loss, q1.detach(), errors.detach().abs().amax(dim=1)


def discrete_policy_loss(
    policy: CHDPPolicy,
    replay_data: HybridReplaySamples,
    actor_features: th.Tensor,
    critic_features: th.Tensor,
    parameters: th.Tensor | None = None,
) -> tuple[th.Tensor, th.Tensor]:
    """
    Eq. 7, L_d - alpha Q1(s, e, a): Q of latents e drawn through the whole chain.

    :param policy: the networks
    :param replay_data: a batch
    :param actor_features: (B, features_dim) features of the policies
    :param critic_features: (B, features_dim) features of the critics
    :param parameters: (B, Pmax) parameters a of the drawn latents; None: those that the continuous policy draws for them
    :return: diffusion loss L_d and policy improvement loss -Q1
    """
    discrete_policy = policy.actor.discrete_policy
    diffusion_loss = discrete_policy.diffusion_loss(replay_data.latents, actor_features)
    latents = discrete_policy.sample(actor_features)
    if parameters is None:
        with th.no_grad():
            parameters = policy.actor.sample_parameters(actor_features, policy.actor.codebook.quantize(latents))
    return diffusion_loss, -policy.critic.q1_values(critic_features, latents, parameters).mean()


def continuous_policy_loss(
    policy: CHDPPolicy,
    replay_data: HybridReplaySamples,
    actor_features: th.Tensor,
    critic_features: th.Tensor,
    latents: th.Tensor,
    k: th.Tensor,
) -> tuple[th.Tensor, th.Tensor]:
    """
    Eq. 8, L_d - alpha Q1(s, e, a): Q of parameters a drawn through the whole chain; the gradient reaches the codebook through
    the condition of the chain.

    :param policy: the networks
    :param replay_data: a batch
    :param actor_features: (B, features_dim) features of the policies
    :param critic_features: (B, features_dim) features of the critics
    :param latents: (B, latent_dim) latents e, without gradient
    :param k: (B,) discrete actions that they decode to
    :return: diffusion loss L_d and policy improvement loss -Q1
    """
    actor, stored_k = policy.actor, replay_data.discrete_actions
    condition = th.cat([actor_features, actor.codebook(stored_k).detach()], dim=1)
    diffusion_loss = actor.continuous_policy.diffusion_loss(replay_data.parameters, condition, actor.mask(stored_k))
    parameters = actor.sample_parameters(actor_features, k)
    return diffusion_loss, -policy.critic.q1_values(critic_features, latents, parameters).mean()
