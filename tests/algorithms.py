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
# PaperCHDP has no arguments of exploration; what it does instead is in test_chdp.py
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


FAST_CHDP = dict(
    n_diffusion_steps=3, latent_dim=4, batch_size=16, learning_starts=20, n_action_candidates=2, buffer_size=1000,
    policy_kwargs=dict(net_arch=[16, 16]), seed=0,
)  # fmt: skip


# PaperCHDP has no candidates
PAPER_FAST = {key: value for key, value in FAST_CHDP.items() if key != "n_action_candidates"}


def filled_model(env=None, algorithm_class=CHDP, **kwargs):
    """A model of CHDP, or of a class derived from it, with 60 random transitions that has not been trained."""
    settings = PAPER_FAST if issubclass(algorithm_class, PaperCHDP) else FAST_CHDP
    model = algorithm_class("MlpPolicy", env or HybridIdentityEnv(), **{**settings, **kwargs})
    model.learning_starts = 10**9
    model.learn(60)
    return model
