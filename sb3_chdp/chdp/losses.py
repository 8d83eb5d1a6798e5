"""The losses of CHDP, one function for each of the paper's equations, and the relabelling of stored latents."""

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_chdp.chdp.critic import HybridCritic
from sb3_chdp.chdp.policies import CHDPPolicy
from sb3_chdp.common.samples import HybridReplaySamples

IMPROVEMENT_QS = ("q1", "min", "mean")
IMPROVEMENT_PARAMETERS = ("stored", "policy")


def relabel_latents(
    policy: CHDPPolicy, replay_data: HybridReplaySamples, replace: bool
) -> tuple[HybridReplaySamples, th.Tensor]:
    """
    Look for latents that the codebook has moved away from.

    :param policy: the networks
    :param replay_data: a batch
    :param replace: whether such latents give way to the present codeword of the stored action
    :return: the batch, and the share of its latents that do not decode to the stored action
    """
    codebook = policy.actor.codebook
    drifted = codebook.quantize(replay_data.latents) != replay_data.discrete_actions
    if replace:
        present = codebook.representative_latents(replay_data.discrete_actions)
        replay_data = replay_data._replace(latents=th.where(drifted[:, None], present, replay_data.latents))
    return replay_data, drifted.float().mean()


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
    Mean squared Bellman errors (eq. CHDP_critic_loss_overview), weighted if the replay is prioritised, with a gradient for
    the codebook, which may be used.

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
    improvement_q: str,
    improvement_parameters: str,
) -> tuple[th.Tensor, th.Tensor]:
    """
    Eq. discrete_policy_loss_chdp_final: Q of latents drawn through the whole chain, with the stored parameters.

    :param policy: the networks
    :param replay_data: a batch
    :param actor_features: (B, features_dim) features of the policies
    :param critic_features: (B, features_dim) features of the critics
    :param improvement_q: one of ``IMPROVEMENT_QS``
    :param improvement_parameters: one of ``IMPROVEMENT_PARAMETERS``; "policy" takes the parameters that the continuous
        policy draws for the drawn latents instead, without gradient
    :return: diffusion loss and policy improvement loss
    """
    discrete_policy = policy.actor.discrete_policy
    diffusion_loss = discrete_policy.diffusion_loss(replay_data.latents, actor_features)
    latents = discrete_policy.sample(actor_features)
    parameters = replay_data.parameters
    if improvement_parameters == "policy":
        with th.no_grad():
            parameters = policy.actor.sample_parameters(actor_features, policy.actor.codebook.quantize(latents))
    q_values = q_to_ascend(policy.critic, critic_features, latents, parameters, improvement_q)
    return diffusion_loss, -q_values.mean()


def continuous_policy_loss(
    policy: CHDPPolicy,
    replay_data: HybridReplaySamples,
    actor_features: th.Tensor,
    critic_features: th.Tensor,
    improvement_q: str,
    sequential_update: bool,
    uniform_fraction: float,
) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    """
    Eq. continuous_policy_loss_chdp_final: Q of parameters drawn through the whole chain, given latents of the updated
    discrete policy; the gradient reaches the codebook through the condition of the chain.

    :param policy: the networks
    :param replay_data: a batch
    :param actor_features: (B, features_dim) features of the policies
    :param critic_features: (B, features_dim) features of the critics
    :param improvement_q: one of ``IMPROVEMENT_QS``
    :param sequential_update: False takes the stored latents and actions instead
    :param uniform_fraction: share of the batch that takes uniformly random actions and their codewords instead
    :return: diffusion loss, policy improvement loss, and the (B,) discrete actions
    """
    actor = policy.actor
    # The features extractor belongs to the discrete policy
    actor_features = actor_features.detach()
    stored_k = replay_data.discrete_actions
    condition = th.cat([actor_features, actor.codebook(stored_k).detach()], dim=1)
    diffusion_loss = actor.continuous_policy.diffusion_loss(replay_data.parameters, condition, actor.mask(stored_k))

    n_uniform = round(uniform_fraction * len(stored_k))
    if sequential_update:
        with th.no_grad():
            latents, k = actor.sample_latents(actor_features[n_uniform:])
    else:
        latents, k = replay_data.latents[n_uniform:], stored_k[n_uniform:]
    if n_uniform > 0:
        uniform_k = th.randint(actor.codebook.n_discrete_actions, (n_uniform,), device=k.device)
        k = th.cat([uniform_k, k])
        latents = th.cat([actor.codebook.representative_latents(uniform_k), latents])
    parameters = actor.sample_parameters(actor_features, k)
    q_values = q_to_ascend(policy.critic, critic_features, latents, parameters, improvement_q)
    return diffusion_loss, -q_values.mean(), k


def q_to_ascend(
    critic: HybridCritic, critic_features: th.Tensor, latents: th.Tensor, parameters: th.Tensor, improvement_q: str
) -> th.Tensor:
    """:return: (B, 1) the Q that the policies ascend; gradient flows to the action only"""
    if improvement_q == "q1":
        return critic.q1_values(critic_features, latents, parameters)
    q1, q2 = critic.q_values(critic_features, latents, parameters)
    return th.min(q1, q2) if improvement_q == "min" else 0.5 * (q1 + q2)
