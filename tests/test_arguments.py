"""Arguments out of range are refused, by every algorithm that has them, with what was given and what is accepted."""

import re
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.env_util import make_vec_env

from sb3_chdp import CHDP, HPPO, PDQNTD3, HyARTD3
from sb3_chdp.common.arguments import constructor_defaults
from tests.algorithms import ALGORITHMS, OFF_POLICY, make_model
from tests.hybrid_envs import box, make_layout_env

NAN, INF = float("nan"), float("inf")
NO_NUMBER = [NAN, INF, "1", True]
FRACTION = [-0.1, 1.5, *NO_NUMBER]
COUNT = [0, -1, 1.5, *NO_NUMBER]
AT_LEAST_0 = [-1, *NO_NUMBER]
ABOVE_0 = [0, *AT_LEAST_0]
SWITCH = ["no", 2, NAN]
BAD = {
    "learning_rate": AT_LEAST_0,
    "gamma": FRACTION,
    "batch_size": COUNT,
    "n_steps": [-2, *COUNT],
    "max_grad_norm": ABOVE_0,
    "stats_window_size": COUNT,
    "seed": [-1, 2**32, *NO_NUMBER],
    "action_layout": ["both", 1],
    "device": ["cuda:99", "gpu", 1.5],
    # Off-policy algorithms
    "buffer_size": [1e6, *COUNT],
    "learning_starts": AT_LEAST_0,
    "tau": FRACTION,
    "train_freq": [*COUNT, (1, "steps"), (0, "step"), (1,)],
    "gradient_steps": [-7, 1.5, *NO_NUMBER],
    "optimize_memory_usage": SWITCH,
    "policy_delay": COUNT,
    "action_noise": [0.1, "normal"],
    "replay_buffer_class": ["ReplayBuffer", dict],
    "exploration_fraction": FRACTION,
    "exploration_initial_eps": [2, *FRACTION],
    "exploration_final_eps": [2, *FRACTION],
    # TD3
    "target_policy_noise": AT_LEAST_0,
    "target_noise_clip": AT_LEAST_0,
    "exploration_noise": AT_LEAST_0,
    "inverting_gradients": SWITCH,
    "actor_learning_rate": AT_LEAST_0,
    "multi_pass": SWITCH,
    "embedding_dim": COUNT,
    "parameter_latent_dim": COUNT,
    "representation_learning_rate": AT_LEAST_0,
    "representation_batch_size": COUNT,
    "representation_warmup_steps": COUNT,
    "representation_freq": COUNT,
    "representation_steps": COUNT,
    # HPPO
    "n_epochs": COUNT,
    "gae_lambda": FRACTION,
    "clip_range": ABOVE_0,
    "clip_range_vf": ABOVE_0,
    "normalize_advantage": SWITCH,
    "ent_coef": AT_LEAST_0,
    "vf_coef": AT_LEAST_0,
    "target_kl": ABOVE_0,
    "use_masking": SWITCH,
    # CHDP
    "latent_dim": COUNT,
    "n_diffusion_steps": COUNT,
    "eta": AT_LEAST_0,
    "n_action_candidates": COUNT,
    "codebook_lr_factor": AT_LEAST_0,
}
# Objects, whose classes check them
UNCHECKED = {
    "policy", "env", "replay_buffer_kwargs", "rollout_buffer_class", "passthrough",
    "rollout_buffer_kwargs", "tensorboard_log", "policy_kwargs", "verbose", "_init_setup_model",
}  # fmt: skip


@pytest.mark.parametrize("algorithm", ALGORITHMS, ids=lambda algorithm: algorithm.__name__)
def test_the_table_is_complete(algorithm):
    assert {*constructor_defaults(algorithm)} <= {*BAD, *UNCHECKED}


def refused(algorithm, name, value):
    with pytest.raises(ValueError, match=rf"{name} must be .*got {re.escape(repr(value))}"):
        make_model(algorithm, make_layout_env(), **{name: value})


@pytest.mark.parametrize("name", BAD)
def test_bad_values(algorithm, name):
    if name not in constructor_defaults(algorithm):
        return
    for value in BAD[name]:
        refused(algorithm, name, value)


@pytest.mark.skipif(th.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize("device", ["cuda", th.device("cuda")], ids=["string", "device"])
def test_a_gpu_that_is_not_there(algorithm, device, tmp_path):
    refused(algorithm, "device", device)
    make_model(algorithm, make_layout_env()).save(tmp_path / "model")
    with pytest.raises(ValueError, match="device must be one that PyTorch finds"):
        algorithm.load(tmp_path / "model", device=device)


@pytest.mark.parametrize(
    "kwargs",
    [dict(learning_rate=np.float32(1e-3)), dict(learning_rate=0), dict(gamma=1), dict(gamma=0.0), dict(seed=np.int64(3)),
     dict(device=th.device("cpu")), dict(max_grad_norm=0.1), dict(batch_size=np.int32(4)), dict(train_freq=(2, "episode")),
     dict(gradient_steps=-1), dict(gradient_steps=0), dict(tau=1.0), dict(exploration_fraction=0.0), dict(seed=None),
     dict(learning_rate=lambda progress: 1e-3 * progress), dict(clip_range_vf=0.2), dict(exploration_noise=1.0)],
    ids=lambda kwargs: "-".join(kwargs),
)  # fmt: skip
def test_good_values(algorithm, kwargs):
    if {*kwargs} <= {*constructor_defaults(algorithm)}:
        make_model(algorithm, make_layout_env(), **kwargs).learn(20)


def test_a_schedule_that_gives_no_number(algorithm):
    model = make_model(algorithm, make_layout_env(), learning_rate=lambda progress: NAN if progress < 0.5 else 1e-3)
    with pytest.raises(ValueError, match="learning_rate must be a finite number of at least 0, got nan"):
        model.learn(60)
    assert all(p.isfinite().all() for p in model.policy.parameters())
    with pytest.raises(ValueError, match="learning_rate must be a finite number of at least 0, got -1"):
        make_model(algorithm, make_layout_env(), learning_rate=lambda progress: -1.0)


def test_load_refuses_what_is_no_argument(algorithm, tmp_path):
    make_model(algorithm, make_layout_env()).save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"unknown argument gama=0\.9, did you mean gamma\? It must be one of .*seed"):
        algorithm.load(tmp_path / "model", gama=0.9)
    with pytest.raises(ValueError, match=r"gamma must be a number between 0 and 1, got 1\.5"):
        algorithm.load(tmp_path / "model", gamma=1.5)
    loaded = algorithm.load(tmp_path / "model", gamma=0.5, seed=4, verbose=0)
    assert (loaded.gamma, loaded.seed) == (0.5, 4)


@pytest.mark.parametrize(
    "algorithm, kwargs",
    [(CHDP, dict(n_diffusion_steps=7)), (CHDP, dict(latent_dim=5)), (PDQNTD3, dict(multi_pass=True)),
     (PDQNTD3, dict(inverting_gradients=False)), (HyARTD3, dict(embedding_dim=9)), (HPPO, dict(action_layout="shared"))],
    ids=str,
)  # fmt: skip
def test_load_keeps_the_networks(algorithm, kwargs, tmp_path):
    make_model(algorithm, make_layout_env()).save(tmp_path / "model")
    ((name, value),) = kwargs.items()
    with pytest.raises(ValueError, match=f"{name} must stay .*model has networks, got {value!r}"):
        algorithm.load(tmp_path / "model", **kwargs)


def test_load_with_another_observation_space(algorithm, tmp_path):
    make_model(algorithm, make_layout_env()).save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"model was not loaded with observation_space: \w+: "):
        algorithm.load(tmp_path / "model", observation_space=box(-1, 1, 5))


def test_costly_settings():
    with pytest.warns(UserWarning, match=r"about \d+ times the work .* n_diffusion_steps=10000 \(default 5\)"):
        make_model(CHDP, make_layout_env(), n_diffusion_steps=10_000)


def test_a_buffer_that_does_not_fit_into_the_memory(off_policy_algorithm):
    with pytest.raises(ValueError, match=r"buffer_size must be such that .* got 1000000000000.* optimize_memory_usage=True"):
        make_model(off_policy_algorithm, make_layout_env(), buffer_size=10**12)


@pytest.mark.parametrize(
    "algorithm, name, value", [(CHDP, "latent_dim", 33), (PDQNTD3, "multi_pass", True), (HyARTD3, "embedding_dim", 2)]
)
def test_arguments_of_the_algorithm_in_policy_kwargs(algorithm, name, value):
    with pytest.raises(ValueError, match=f"policy_kwargs must not have '{name}': it is an argument of {algorithm.__name__}"):
        make_model(algorithm, make_layout_env(), policy_kwargs={name: value})


@pytest.mark.parametrize("name", ["use_sde", "squash_output"])
def test_arguments_that_policies_set_themselves(algorithm, name):
    with pytest.raises(ValueError, match=rf"policy_kwargs has unknown key\(s\) \['{name}'\]"):
        make_model(algorithm, make_layout_env(), policy_kwargs={name: True})


OTHERS: dict[str, dict[str, Any]] = {
    "class": dict(replay_buffer_class=NStepReplayBuffer, replay_buffer_kwargs=dict(n_steps=2, gamma=0.9)),
    "observation_space": dict(env=make_layout_env(observation_space=box(-2, 2, 2))),
    "action_space": dict(env=make_layout_env("flat")),
    "n_envs": dict(env=make_vec_env(make_layout_env, 2)),
}


@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize("trusted", [False, True])
def test_replay_buffers_of_other_models(off_policy_algorithm, name, trusted, tmp_path):
    other = make_model(off_policy_algorithm, **{"env": make_layout_env(), **OTHERS[name]}).learn(15)
    other.save_replay_buffer(tmp_path / "buffer")
    model = make_model(off_policy_algorithm, make_layout_env()).learn(15)
    own = model.replay_buffer
    with pytest.raises(ValueError, match=f"must hold a replay buffer like that of the model, with {name} .*, got "):
        model.load_replay_buffer(tmp_path / "buffer", trusted=trusted)
    assert model.replay_buffer is own
    model.learn(20, reset_num_timesteps=False)


def test_n_step_buffers_discount_as_the_algorithm_does(off_policy_algorithm):
    model = make_model(off_policy_algorithm, make_layout_env(), gamma=0.5, replay_buffer_class=NStepReplayBuffer)
    assert isinstance(model.replay_buffer, NStepReplayBuffer) and model.replay_buffer.gamma == 0.5
    kwargs = dict(replay_buffer_class=NStepReplayBuffer, replay_buffer_kwargs=dict(gamma=0.7))
    assert make_model(off_policy_algorithm, make_layout_env(), **kwargs).replay_buffer.gamma == 0.7
    with pytest.raises(ValueError, match="replay_buffer_kwargs must be a dict, or None, got 5"):
        make_model(off_policy_algorithm, make_layout_env(), replay_buffer_kwargs=5)
    kwargs = dict(replay_buffer_class=NStepReplayBuffer, replay_buffer_kwargs=dict(n_steps=0))
    with pytest.raises(ValueError, match="n_steps must be a whole number of at least 1, got 0"):
        make_model(off_policy_algorithm, make_layout_env(), **kwargs)


def test_replay_buffers_of_other_returns(off_policy_algorithm, tmp_path):
    make_model(off_policy_algorithm, make_layout_env(), n_steps=3).save_replay_buffer(tmp_path / "buffer")
    model = make_model(off_policy_algorithm, make_layout_env(), n_steps=2)
    assert isinstance(model.replay_buffer, NStepReplayBuffer)
    with pytest.raises(ValueError, match="with n_steps 2, got 3"):
        model.load_replay_buffer(tmp_path / "buffer")


def test_a_larger_replay_buffer_is_welcome(off_policy_algorithm, tmp_path):
    make_model(off_policy_algorithm, make_layout_env()).learn(15).save_replay_buffer(tmp_path / "buffer")
    model = make_model(off_policy_algorithm, make_layout_env(), buffer_size=OFF_POLICY["buffer_size"] // 2)
    model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer.size() == 15
