"""The losses of CHDP, most of them an equation of the paper."""

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_chdp.chdp.policies import CHDPPolicy
from sb3_chdp.common.samples import HybridReplaySamples

# A worse discrete action counts as worse by no more than this, in the critics' units
LARGEST_DEFICIT = 0.3
# Discrete actions beside the drawn and the stored one by whose values the discrete policy is improved
N_COMPARED = 2


@th.no_grad()
def next_values(
    policy: CHDPPolicy,
    observations: PyTorchObs,
    masks: th.Tensor | None = None,
    returns: th.Tensor | None = None,
    stored: th.Tensor | None = None,
) -> tuple[th.Tensor, th.Tensor | None]:
    """
    min_j Q'_j(s', e', a') of the best action (e', a') among a few of the target policies, and with the weight
    ``policy.random_share`` of a uniformly random action.

    The online critics choose and the targets value, so that an error has to be in both to raise the value (double Q-learning,
    van Hasselt et al., 2016); where features are learnt, the targets choose too.

    :param policy: the networks
    :param observations: (B, ...) next observations
    :param masks: (B, K) False for discrete actions that may not be taken, None if all may
    :param returns: (B, 1) what episodes have returned, which the policies do not know; None: not known at all
    :param stored: (B, columns) rows of other actions
    :return: (B, 1) values in the units of the rewards, with all that follows, and in those of the critics (B, 2) by how much
        stored and random actions are worth less than the best ones, None without stored ones
    """
    critic, actor = policy.critic_target, policy.actor_target
    features = critic.features(observations)

    def values_of(latents: th.Tensor, parameters: th.Tensor) -> th.Tensor:
        values = th.min(*critic.q_values(features, latents, parameters))
        if returns is None or critic.return_network is None:
            return values
        return values + critic.return_network(features, latents, parameters, returns)

    latents, _, parameters = policy.select_target(actor, policy.choosing_critic, features, masks=masks)
    values, costs = values_of(latents, parameters), None
    if policy.random_share > 0 or stored is not None:
        latents, _, parameters = actor.random_actions(len(features), masks=masks)
        of_random = values_of(latents, parameters)
        if stored is not None:
            columns = policy.action_space.columns
            latents = actor.codebook.representative_latents(columns.discrete_actions(stored))
            of_stored = values_of(latents, columns.view(stored, "parameters"))
            costs = th.cat([values - of_stored, values - of_random], dim=1)
        values = values.lerp(of_random, policy.random_share)
    return policy.value_scale.values(values), costs


@th.no_grad()
def target_values(policy: CHDPPolicy, replay_data: HybridReplaySamples) -> tuple[th.Tensor, th.Tensor | None]:
    """
    Eq. 11, y = r + gamma min_j Q'_j(s', e', a'), see :func:`next_values`, and r alone. With n-step returns r is n rewards, if
    not told which the first is.

    :param policy: the networks
    :param replay_data: a batch
    :return: (B, 2) values and rewards, in the units of the rewards, and (B, 2) what the actions cost that were taken in the
        next states, and random ones, None if not known
    """
    values, costs = next_values(
        policy, replay_data.next_observations, replay_data.next_masks, replay_data.next_returns, replay_data.next_actions
    )
    follows = (1 - replay_data.dones) * replay_data.discounts * values
    rewards = replay_data.rewards if replay_data.first_rewards is None else replay_data.first_rewards
    return th.cat([replay_data.rewards + follows, rewards], dim=1), costs


def critic_loss(
    policy: CHDPPolicy, replay_data: HybridReplaySamples, features: th.Tensor, targets: th.Tensor
) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    """
    Eq. 10, (Q_j(s, e, a) - y)^2, weighted if the replay is prioritised.

    It has a gradient for the codebook, which may be used.

    :param policy: the networks
    :param replay_data: a batch
    :param features: (B, features_dim) features of the observations
    :param targets: (B, 1) targets y in the units of the critics
    :return: sum over both critics, the detached (B, 1) values of the first, and the larger (B,) absolute error of both
    """
    # The gradient with respect to a latent is also that of the codeword
    codewords = policy.actor.codebook(replay_data.discrete_actions)
    latents = replay_data.latents + (codewords - codewords.detach())
    q_values = th.cat(policy.critic.q_values(features, latents, replay_data.parameters), dim=1)
    errors = q_values - targets
    loss = (replay_data.weights * errors.square()).sum(dim=1).mean()
    return loss, q_values[:, :1].detach(), errors.detach().abs().amax(dim=1)


def reward_loss(policy: CHDPPolicy, replay_data: HybridReplaySamples, features: th.Tensor, targets: th.Tensor) -> th.Tensor:
    """
    Squared error of the reward network, weighted if the replay is prioritised.

    :param policy: the networks
    :param replay_data: a batch
    :param features: (B, features_dim) features of the observations, without gradient
    :param targets: (B, 1) rewards in the units of the critics
    """
    assert policy.critic.reward_network is not None, "PaperCHDP has none"
    rewards = policy.critic.reward_network(features, replay_data.latents, replay_data.parameters)
    return (replay_data.weights * (rewards - targets).square()).mean()


def return_loss(policy: CHDPPolicy, replay_data: HybridReplaySamples, features: th.Tensor, errors: th.Tensor) -> th.Tensor:
    """
    Squared error of what returns add to the values, weighted if the replay is prioritised.

    :param policy: the networks
    :param replay_data: a batch with returns
    :param features: (B, features_dim) features of the observations, without gradient
    :param errors: (B, 1) by how much the targets of the critics exceed their values
    """
    network, returns = policy.critic.return_network, replay_data.returns
    assert network is not None and returns is not None, "rows hold no returns"
    summands = network(features, replay_data.latents, replay_data.parameters, returns)
    return (replay_data.weights * (summands - errors).square()).mean()


def losses_beside_critics(
    policy: CHDPPolicy, replay_data: HybridReplaySamples, features: th.Tensor, targets: th.Tensor, q1: th.Tensor
) -> dict[str, th.Tensor]:
    """
    Losses of the rewards alone, for foresight, and of what returns add to values, for targets.

    :param policy: the networks
    :param replay_data: a batch
    :param features: (B, features_dim) features of the observations, without gradient
    :param targets: (B, 2) values and rewards in the units of the critics
    :param q1: (B, 1) values of the first critic, without gradient
    :return: losses by name
    """
    losses = {"reward_loss": reward_loss(policy, replay_data, features, targets[:, 1:])}
    if replay_data.returns is not None:
        losses["return_loss"] = return_loss(policy, replay_data, features, targets[:, :1] - q1)
    return losses


def first_occurrences(k: th.Tensor) -> th.Tensor:
    """
    :param k: (B, n) discrete actions, (B, n, L) of a factored space
    :return: (B, n) False for those that stand further left already
    """
    k = k.flatten(1).unflatten(1, (k.shape[1], -1))
    same = (k[:, :, None] == k[:, None]).all(dim=3)
    return ~same.tril(-1).any(dim=2)


def soft_quantization(latents: th.Tensor, codewords: th.Tensor, competes: th.Tensor) -> th.Tensor:
    """
    Weights softmax(-||e - e_j||^2 / tau) of codewords, tau the mean of these distances (as in Agustsson et al., 2017).

    :param latents: (B, latent_dim) latents e, to which the weights have a gradient
    :param codewords: (B, n, latent_dim) codewords e_j
    :param competes: (B, n) False for codewords of weight 0
    :return: (B, n) weights, their sum is 1
    """
    distances = (latents[:, None] - codewords).square().sum(dim=2)
    tau = distances.detach().mean(dim=1, keepdim=True).clamp(min=1e-6)
    return (-distances / tau).masked_fill(~competes, -th.inf).softmax(dim=1)


def discrete_policy_loss(
    policy: CHDPPolicy, replay_data: HybridReplaySamples, features: th.Tensor
) -> tuple[th.Tensor, th.Tensor]:
    """
    Eq. 7, L_d - alpha Q1(s, e, a), with Q1 of a soft quantisation of the latents e drawn through the whole chain.

    How Q1 changes around one codeword does not tell where a better one is. So the nearest codeword competes with that of the
    stored action and ``N_COMPARED`` others, each valued with parameters that the continuous policy draws for it, and Q1 is
    their mean with the weights of :func:`soft_quantization`: latents move towards what is worth more.

    Bad codewords would drive latents away from good ones near them. So a codeword counts as worse than the nearest by at most
    ``LARGEST_DEFICIT``, and if one is better than the nearest, the best alone competes with it.

    :param policy: the networks
    :param replay_data: a batch
    :param features: (B, features_dim) features of the observations, without gradient
    :return: diffusion loss L_d and policy improvement loss, minus what Q1 exceeds that of the nearest codeword
    """
    actor, codebook = policy.actor, policy.actor.codebook
    latents, nearest = actor.draw_latents(features, masks=replay_data.masks)
    with th.no_grad():
        others = codebook.alternatives(nearest, N_COMPARED, repeatable=False)
        k = th.cat([nearest[:, None], replay_data.discrete_actions[:, None], others], dim=1)
        n = k.shape[1]
        codewords = codebook.representative_latents(k)
        parameters = actor.sample_parameters(features.repeat_interleave(n, dim=0), k.flatten(0, 1))
        values = policy.critic.score1(features, codewords.flatten(0, 1), parameters).view(-1, n)
        gains = (values - values[:, :1]).clamp(min=-LARGEST_DEFICIT)
        # An action that is there twice competes once
        competes = first_occurrences(k)
        if replay_data.masks is not None:
            competes &= codebook.allowed(k, replay_data.masks)
        # All if the nearest is the best, else the nearest and the best alone
        most = gains.masked_fill(~competes, -th.inf).amax(dim=1, keepdim=True)
        competes &= (most == 0) | (gains == most) | (gains == 0)
    weights = soft_quantization(latents, codewords, competes)
    diffusion_loss = actor.latent_loss(replay_data.latents, features)
    return diffusion_loss, -(weights * gains).sum(dim=1).mean()


def continuous_policy_loss(
    policy: CHDPPolicy, replay_data: HybridReplaySamples, features: th.Tensor, latents: th.Tensor, k: th.Tensor
) -> tuple[th.Tensor, th.Tensor]:
    """
    Eq. 8, L_d - alpha Q1(s, e, a): Q of parameters a drawn through the whole chain; the gradient reaches the codebook through
    the condition of the chain.

    :param policy: the networks
    :param replay_data: a batch
    :param features: (B, features_dim) features of the observations, without gradient
    :param latents: (B, latent_dim) latents e, without gradient
    :param k: (B,) discrete actions that they decode to
    :return: diffusion loss L_d and policy improvement loss -Q1
    """
    actor, stored_k = policy.actor, replay_data.discrete_actions
    condition = actor.condition(features, actor.codebook(stored_k).detach())
    diffusion_loss = actor.continuous_policy.diffusion_loss(replay_data.parameters, condition, actor.padding_mask(stored_k))
    parameters = actor.sample_parameters(features, k)
    return diffusion_loss, -policy.critic.score1(features, latents, parameters).mean()
