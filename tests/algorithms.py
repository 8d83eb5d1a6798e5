"""The algorithms that the shared tests run on, with small settings."""

from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_chdp import ALGORITHMS as REGISTRY
from sb3_chdp import CHDP
from sb3_chdp.chdp import PaperCHDP
from tests.hybrid_envs import HybridIdentityEnv, layouts

OFF_POLICY = dict(batch_size=8, learning_starts=12, buffer_size=500)
ON_POLICY = dict(n_steps=10, batch_size=5, n_epochs=2)
# What an algorithm has beside these
OWN = {
    "chdp": dict(n_diffusion_steps=2, n_action_candidates=2, latent_dim=3),
    "hyar_td3": dict(embedding_dim=3, parameter_latent_dim=2, representation_warmup_steps=3, representation_freq=8),
}
SMALL = {}
for name, line in REGISTRY.items():
    algorithm = line.load_class()
    SMALL[algorithm] = {**(OFF_POLICY if issubclass(algorithm, OffPolicyAlgorithm) else ON_POLICY), **OWN.get(name, {})}
ALGORITHMS = list(SMALL)
# PaperCHDP has no arguments of exploration; what it does instead is in test_paper_chdp.py
OFF_POLICY_ALGORITHMS = [
    algorithm for algorithm in ALGORITHMS if issubclass(algorithm, OffPolicyAlgorithm) and algorithm is not PaperCHDP
]
LAYOUTS = list(layouts())


def make_model(algorithm, env, policy="MlpPolicy", **kwargs):
    return algorithm(policy, env, **{"policy_kwargs": dict(net_arch=[8, 8]), "seed": 0, **SMALL[algorithm], **kwargs})


def snapshot(model):
    """:return: a copy of all parameters of the policy, by name"""
    return {name: p.detach().clone() for name, p in model.policy.named_parameters()}


def has_learnt(model, before):
    """:return: whether any parameter has moved since the snapshot"""
    return any((p != before[name]).any() for name, p in model.policy.named_parameters())


# A constant learning rate: the default falls to 0 in the training that fills the buffer
FAST_CHDP = dict(
    n_diffusion_steps=3, latent_dim=4, batch_size=16, learning_starts=20, learning_rate=1e-3, n_action_candidates=2,
    buffer_size=1000, policy_kwargs=dict(net_arch=[16, 16]), seed=0,
)  # fmt: skip
# PaperCHDP has no candidates
PAPER_FAST = {key: value for key, value in FAST_CHDP.items() if key != "n_action_candidates"}


def fast_model(algorithm_class=CHDP, env=None, policy="MlpPolicy", **kwargs):
    """A small model of CHDP, or of a class derived from it."""
    settings = PAPER_FAST if issubclass(algorithm_class, PaperCHDP) else FAST_CHDP
    return algorithm_class(policy, env or HybridIdentityEnv(), **{**settings, **kwargs})


def filled_model(env=None, algorithm_class=CHDP, n_transitions=60, **kwargs):
    """The same with random transitions in its buffer, not trained."""
    model = fast_model(algorithm_class, env, **kwargs)
    model.learning_starts = 10**9
    model.learn(n_transitions)
    return model


def sample(model, batch_size=32):
    """:return: a batch of the model's replay buffer"""
    return model._sample_batch(batch_size)


def calls_of(module):
    """:return: a list that takes up the arguments of every further call of a network"""
    calls = []
    module.register_forward_pre_hook(lambda _, args: calls.append([arg.detach().clone() for arg in args]))
    return calls
