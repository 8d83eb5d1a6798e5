"""TD3 on scores and parameters (PADDPG with TD3)."""

from typing import ClassVar

from stable_baselines3.common.policies import BasePolicy

from sb3_chdp.common.td3 import HybridTD3
from sb3_chdp.pa_td3.policies import CnnPolicy, MlpPolicy, MultiInputPolicy


class PATD3(HybridTD3):
    """
    Parameterized Action TD3 (PA-TD3), PADDPG with TD3 in place of DDPG

    One actor gives a score to every discrete action and parameters to all of them; the action of highest score is taken
    with its own parameters. The critics see all scores and parameters. It learns as SB3's TD3 does on the same environment
    behind :class:`FlattenHybridAction`, and deals in native actions.

    Papers: Hausknecht and Stone (2016), https://arxiv.org/abs/1511.04143; Fujimoto et al. (2018),
    https://arxiv.org/abs/1802.09477. Reference scripts: HyAR repository.

    Differences from the reference scripts:
        1. uniformly random actions with a decreasing probability (``exploration_*``; initial and final rate 0: the scripts);
        2. tanh outputs with plain policy gradients; ``inverting_gradients=True`` inverts them on top of tanh, as the
           scripts do, which damps them twice;
        3. no clipping of the actor's gradient norm;
        4. one linear output layer for scores and parameters, which is the same network as two heads on a common trunk;
        5. time limits bootstrap in all environments.

    The parameters are those of :class:`HybridTD3`.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
