"""The algorithms that the shared tests run on, with small settings."""

from sb3_chdp import CHDP, HHQNTD3, PATD3, PDQNTD3
from tests.hybrid_envs import layouts

ALGORITHMS = [CHDP, PATD3, HHQNTD3, PDQNTD3]
SMALL = {CHDP: dict(n_diffusion_steps=2, n_action_candidates=2, latent_dim=3), PATD3: {}, HHQNTD3: {}, PDQNTD3: {}}
LAYOUTS = list(layouts())


def make_model(algorithm, env, policy="MlpPolicy", **kwargs):
    settings = dict(batch_size=8, learning_starts=12, buffer_size=500, policy_kwargs=dict(net_arch=[8, 8]), seed=0)
    return algorithm(policy, env, **{**settings, **SMALL[algorithm], **kwargs})
