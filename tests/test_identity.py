"""Learning tests with budgets that a broken algorithm cannot meet."""

from typing import Any

import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_chdp import CHDP, HPPO, HyARTD3, PaperCHDP
from tests.algorithms import OFF_POLICY_ALGORITHMS
from tests.hybrid_envs import HybridIdentityEnv

# Uniformly random actions succeed in 9 % of the episodes; a policy that gets the action right and always
# chooses 0 for its parameter in 30 %, one that gets the parameter right and guesses the action in 33 %
THRESHOLD = 0.8
BASELINES = [algorithm for algorithm in OFF_POLICY_ALGORITHMS if algorithm is not CHDP]
SETTINGS: dict[type, dict[str, Any]] = {
    **{
        baseline: dict(gradient_steps=8, learning_rate=1e-3, learning_starts=200, policy_kwargs=dict(net_arch=[64, 64]))
        for baseline in OFF_POLICY_ALGORITHMS
    },
    CHDP: dict(gradient_steps=2, learning_starts=200, policy_kwargs=dict(net_arch=[64, 64])),
    PaperCHDP: dict(n_diffusion_steps=5, gradient_steps=2, learning_starts=200, policy_kwargs=dict(net_arch=[64, 64])),
    HyARTD3: dict(
        gradient_steps=8,
        learning_rate=1e-3,
        learning_starts=1000,
        representation_learning_rate=1e-3,
        representation_warmup_steps=1000,
        policy_kwargs=dict(net_arch=[64, 64]),
    ),
    HPPO: dict(n_steps=64, batch_size=64, learning_rate=1e-3),
}
# Environment steps
BUDGETS = {**dict.fromkeys(SETTINGS, 2000), CHDP: 1500, PaperCHDP: 3000, HPPO: 3000}


def success(model):
    env = make_vec_env(HybridIdentityEnv, 8, seed=100)
    return evaluate_policy(model, env, 200, deterministic=True)[0]


def test_hybrid_identity(algorithm):
    env = make_vec_env(HybridIdentityEnv, 8, seed=0)
    model = algorithm("MlpPolicy", env, seed=0, gamma=0.0, **SETTINGS[algorithm])
    model.learn(BUDGETS[algorithm])
    assert success(model) > THRESHOLD


@pytest.mark.parametrize("broken", ["critics ignore the latents", "no policy improvement"])
def test_broken_chdp_fails(broken):
    """The threshold is out of reach without the parts that make the algorithm learn."""
    # Among candidates the critics choose by themselves, whatever the policies learn: the paper's algorithm has none
    algorithm, eta = (PaperCHDP, 0.0) if broken == "no policy improvement" else (CHDP, 10.0)
    settings = dict(SETTINGS[algorithm], eta=eta)
    model = algorithm("MlpPolicy", make_vec_env(HybridIdentityEnv, 8, seed=0), seed=0, gamma=0.0, **settings)
    if broken == "critics ignore the latents":
        for critic in (model.critic, model.critic_target):
            for network in (*critic.q_networks, critic.reward_network):
                network.register_forward_pre_hook(lambda _, args: (args[0], th.zeros_like(args[1]), args[2]))
    model.learn(BUDGETS[algorithm])
    assert success(model) < THRESHOLD - 0.2


@pytest.mark.slow
@pytest.mark.parametrize("baseline", BASELINES, ids=lambda baseline: baseline.__name__)
def test_broken_baselines_fail(baseline):
    """A critic that does not learn leads nowhere."""
    env = make_vec_env(HybridIdentityEnv, 8, seed=0)
    model = baseline("MlpPolicy", env, seed=0, gamma=0.0, **SETTINGS[baseline])
    model.critic.optimizer.step = lambda *args, **kwargs: None
    model.learn(BUDGETS[baseline])
    assert success(model) < THRESHOLD - 0.2
