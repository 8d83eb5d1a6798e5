"""Hierarchical hybrid Q-network with TD3."""

from typing import ClassVar

from stable_baselines3.common.policies import BasePolicy

from sb3_chdp.common.td3 import HybridTD3
from sb3_chdp.hhqn_td3.policies import CnnPolicy, MlpPolicy, MultiInputPolicy


class HHQNTD3(HybridTD3):
    """
    Hierarchical Hybrid Q-Network with TD3 (HHQN-TD3), as a baseline of HyAR and CHDP

    An upper actor gives a score to every discrete action, a lower actor that sees these scores gives the parameters of all
    actions; the action of highest score is taken with its own parameters. The critics see all scores and parameters.

    Papers: Fu et al. (2019), https://arxiv.org/abs/1903.04959 (the hierarchy); Fujimoto et al. (2018),
    https://arxiv.org/abs/1802.09477. Reference scripts: HyAR repository.

    Differences from the reference scripts:
        1. two independent critics (there the second one evaluates the first one's layers);
        2. the lower actor has a target network that moves (there it stays at its random initialisation);
        3. gradients are taken at the present state (there the lower actor is evaluated at the next one);
        4. TD3's target smoothing and policy delay, which the scripts parse and do not use;
        5. one learning rate of 3e-4 for all networks and no weight decay;
        6. the lower actor sees the noisy scores that decide what is executed;
        7. uniformly random actions with a decreasing probability (``exploration_*``; initial and final rate 0: the scripts);
        8. plain policy gradients; ``inverting_gradients=True`` for inverted ones, no clipping of gradient norms.

    The parameters are those of :class:`HybridTD3`.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
