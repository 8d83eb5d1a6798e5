"""Everything that an SB3 user does with a model, on every layout of hybrid actions."""

from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecCheckNan,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
)
from stable_baselines3.td3.policies import TD3Policy

from sb3_chdp import CHDP, HPPO, PATD3, FlattenHybridAction, HyARTD3, check_hybrid_env
from tests.algorithms import LAYOUTS, OFF_POLICY_ALGORITHMS, has_learnt, make_model, snapshot
from tests.hybrid_envs import LayoutEnv, box, layouts, make_layout_env


@pytest.mark.parametrize("layout", LAYOUTS)
def test_raw_env(algorithm, layout):
    """The environment itself checks that every action it gets is in its action space."""
    env = make_layout_env(layout)
    model = make_model(algorithm, env).learn(30)
    assert model.action_space == env.action_space
    obs, _ = env.reset(seed=0)
    for deterministic in (True, False):
        action, state = model.predict(obs, deterministic=deterministic)
        assert state is None and env.action_space.contains(action)
        env.step(action)
        env.step(model.policy.predict(obs, deterministic=deterministic)[0])
    for evaluated in (model, model.policy):
        rewards, lengths = evaluate_policy(evaluated, Monitor(env), 2, return_episode_rewards=True)
        assert lengths == [10, 10] and np.isfinite(rewards).all()


def run_in_vec_env(algorithm, layout, vec_env_cls, n_envs):
    env_kwargs = dict(env_kwargs={"layout": layout}, vec_env_cls=vec_env_cls, seed=0)
    vec_env = make_vec_env(make_layout_env, n_envs, **env_kwargs)
    model = make_model(algorithm, vec_env).learn(40)
    actions = model.predict(vec_env.reset())[0]
    assert len(actions) == n_envs
    vec_env.step(actions)
    vec_env.close()


@pytest.mark.parametrize("layout", LAYOUTS)
def test_vec_envs(algorithm, layout):
    run_in_vec_env(algorithm, layout, DummyVecEnv, 4)


@pytest.mark.parametrize("n_envs", [1, 4])
def test_subprocesses(algorithm, n_envs):
    run_in_vec_env(algorithm, "nested", SubprocVecEnv, n_envs)


# All algorithms send actions in the same way
@pytest.mark.parametrize("layout", LAYOUTS)
def test_subprocesses_get_actions_of_every_layout(layout):
    run_in_vec_env(PATD3, layout, SubprocVecEnv, 4)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_vec_wrappers(algorithm, layout):
    for wrapper in (VecNormalize, VecMonitor, lambda env: VecFrameStack(env, 2)):
        env = wrapper(make_vec_env(make_layout_env, 2, env_kwargs={"layout": layout}))
        model = make_model(algorithm, env).learn(30)
        env.step(model.predict(env.reset())[0])


def test_vec_check_nan_is_refused(algorithm):
    env = VecNormalize(VecCheckNan(make_vec_env(make_layout_env, 2)))
    with pytest.raises(ValueError, match="VecCheckNan can not look into hybrid actions"):
        make_model(algorithm, env)


@pytest.mark.parametrize("layout", ["nested", "dict", "one_of"])
def test_callbacks(algorithm, layout, tmp_path):
    env = VecNormalize(make_vec_env(make_layout_env, 1, env_kwargs={"layout": layout}))
    eval_env = VecNormalize(make_vec_env(make_layout_env, 1, env_kwargs={"layout": layout}), training=False)
    callbacks = [
        EvalCallback(eval_env, n_eval_episodes=2, eval_freq=15, log_path=str(tmp_path), best_model_save_path=str(tmp_path)),
        CheckpointCallback(20, str(tmp_path), save_replay_buffer=True, save_vecnormalize=True),
    ]
    make_model(algorithm, env).learn(45, callback=callbacks)
    assert len(np.load(tmp_path / "evaluations.npz")["successes"]) == 3
    algorithm.load(tmp_path / "best_model")
    algorithm.load(tmp_path / "rl_model_40_steps", env=make_layout_env(layout))


OBSERVATIONS = {
    "MultiInputPolicy": spaces.Dict({"vector": box(-1, 1, 2), "image": spaces.Box(0, 255, (36, 36, 1), dtype=np.uint8)}),
    "CnnPolicy": spaces.Box(0, 255, (36, 36, 1), dtype=np.uint8),
}


@pytest.mark.parametrize("policy", OBSERVATIONS)
@pytest.mark.parametrize("share_features_extractor", [False, True])
def test_dict_and_image_observations(algorithm, policy, share_features_extractor, tmp_path):
    env = make_layout_env(observation_space=OBSERVATIONS[policy])
    policy_kwargs = dict(net_arch=[8], share_features_extractor=share_features_extractor)
    if issubclass(algorithm, CHDP):
        if not share_features_extractor:
            pytest.skip("all networks of CHDP see the features of one extractor")
        del policy_kwargs["share_features_extractor"]
    model = make_model(algorithm, env, policy, policy_kwargs=policy_kwargs)
    before = {name: p.clone() for name, p in model.policy.named_parameters() if "features_extractor" in name}
    model.learn(20)
    after = dict(model.policy.named_parameters())
    # A shared extractor is listed once, under its first owner
    owners = {name.split(".")[0] for name in before}
    moved = {name.split(".")[0] for name, p in before.items() if (p != after[name]).any()}
    n_networks = 1 if share_features_extractor else 2
    assert moved == owners and len(owners) == n_networks * (2 if hasattr(model, "critic_target") else 1)
    obs = env.reset(seed=0)[0]
    action = model.predict(obs, deterministic=True)[0]
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    np.testing.assert_equal(loaded.predict(obs, deterministic=True)[0], action)


@pytest.mark.parametrize(
    "kwargs",
    [
        dict(train_freq=(1, "episode"), gradient_steps=-1),
        dict(train_freq=(3, "step"), gradient_steps=2),
        dict(n_steps=3),
        dict(optimize_memory_usage=True, replay_buffer_kwargs=dict(handle_timeout_termination=False)),
    ],
    ids=lambda kwargs: "-".join(kwargs),  # the same in every worker of pytest-xdist
)
def test_off_policy_options(off_policy_algorithm, kwargs):
    if off_policy_algorithm is HyARTD3 and "optimize_memory_usage" in kwargs:
        with pytest.raises(ValueError, match="optimize_memory_usage must be False, HyARTD3 needs all next states"):
            make_model(off_policy_algorithm, make_layout_env(), **kwargs)
        return
    model = make_model(off_policy_algorithm, make_layout_env(), **kwargs)
    before = snapshot(model)
    model.learn(40)
    assert has_learnt(model, before) and model.num_timesteps >= 40
    if "n_steps" in kwargs:
        assert model.replay_buffer.sample(4).discounts is not None


@pytest.mark.parametrize(
    "kwargs",
    [
        dict(learning_rate=lambda progress: 1e-3 * progress),
        dict(tensorboard_log="."),
        dict(action_layout="per_action"),
    ],
    ids=lambda kwargs: "-".join(kwargs),
)
def test_training_options(algorithm, kwargs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    model = make_model(algorithm, make_layout_env(), **kwargs)
    before = snapshot(model)
    model.learn(40)
    assert has_learnt(model, before) and model.num_timesteps >= 40
    if "tensorboard_log" in kwargs:
        assert list(tmp_path.glob(f"{algorithm.__name__}_1/events*"))


def test_a_frozen_parameter_stays(algorithm):
    model = make_model(algorithm, make_layout_env())
    frozen = next(layer.weight for layer in model.policy.modules() if isinstance(layer, th.nn.Linear))
    frozen.requires_grad_(False)
    before, first = snapshot(model), frozen.clone()
    model.learn(30)
    assert th.equal(frozen, first) and has_learnt(model, before)


def test_without_a_seed_random_actions_are_the_users(algorithm):
    env = make_layout_env()
    env.action_space.seed(1)
    expected = deepcopy(env.action_space).sample()
    make_model(algorithm, env, seed=None)
    np.testing.assert_equal(env.action_space.sample(), expected)


def test_progress_bar(algorithm):
    pytest.importorskip("rich")
    make_model(algorithm, make_layout_env()).learn(20, progress_bar=True)


def test_env_by_id(algorithm):
    model = make_model(algorithm, "Platform-v0").learn(30)
    env = gym.make("Platform-v0")
    obs, _ = env.reset()
    env.step(model.predict(obs)[0])


def test_success_rate_is_logged(algorithm, tmp_path):
    model = make_model(algorithm, "HardMove4-v0")
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(130, log_interval=1)
    header = (tmp_path / "progress.csv").read_text().splitlines()[0].split(",")
    assert {"rollout/success_rate", "rollout/ep_rew_mean"} <= set(header)
    if algorithm in OFF_POLICY_ALGORITHMS:
        assert {"rollout/exploration_rate", "train/critic_loss"} <= set(header)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_flattened_for_stock_algorithms(layout):
    from stable_baselines3 import PPO, TD3

    env = FlattenHybridAction(make_layout_env(layout))
    check_hybrid_env(env.env)
    for stock in (TD3, PPO):
        kwargs: dict[str, Any] = dict(learning_starts=10) if stock is TD3 else dict(n_steps=16, batch_size=16)
        stock("MlpPolicy", env, policy_kwargs=dict(net_arch=[8]), **kwargs).learn(24)


def test_flatten_takes_the_best_score_and_its_parameters():
    env = FlattenHybridAction(make_layout_env("nested"))
    k, parameters = env.action(np.array([0.1, 0.9, 0.2, -1, -0.5, 1.0]))
    assert k == 1 and parameters[1] == pytest.approx(5.0)
    k, parameters = env.action(np.array([0.9, 0.1, 0.2, -1, -0.5, 1.0]))
    assert k == 0 and parameters[0].tolist() == [-1.0, -0.5]


def test_bad_observations_for_predict(algorithm):
    model = make_model(algorithm, make_layout_env())
    with pytest.raises(ValueError, match="must be finite"):
        model.predict(np.array([0.0, np.nan], dtype=np.float32))
    with pytest.raises(ValueError, match="tuple"):
        model.predict((np.zeros(2, dtype=np.float32), {}))


def test_no_observation_no_action(algorithm):
    model = make_model(algorithm, make_layout_env())
    for deterministic in (False, True):
        assert model.predict(np.zeros((0, 2), np.float32), deterministic=deterministic)[0] == []


def test_unknown_policy_kwargs(algorithm):
    with pytest.raises(ValueError, match=r"unknown key\(s\) \['n_neurons'\].*net_arch"):
        make_model(algorithm, make_layout_env(), policy_kwargs=dict(n_neurons=3))


@pytest.mark.parametrize("space", [box(-1, 1, 2), spaces.Discrete(3)])
def test_actions_that_are_not_hybrid(algorithm, space):
    with pytest.raises(ValueError, match=r"env\.action_space must be a Tuple, Dict or OneOf of a discrete choice"):
        make_model(algorithm, LayoutEnv(space))


class NoActions(gym.Env):
    observation_space = box(-1, 1, 2)


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (LayoutEnv, r"an environment, got the class LayoutEnv: give an object of it, LayoutEnv\(\)"),
        (3, "an environment of .* got 3"),
        (None, "an environment of .* got None"),
        (NoActions(), "an environment of .*, and set action_space"),
        (
            gym.make_vec("sb3_chdp/Goal-v0", 2, "sync"),
            r"a VecEnv of SB3's, as make_vec_env\(\) .* got Gymnasium's SyncVectorEnv",
        ),
    ],
    ids=["class", "number", "none", "actions", "vector"],
)
def test_what_is_no_environment(algorithm, env, message):
    with pytest.raises(ValueError, match=f"env must be {message}"):
        make_model(algorithm, env)


def test_environments_by_name(algorithm, tmp_path):
    model = make_model(algorithm, "HardMove4-v0")
    model.save(tmp_path / "model")
    algorithm.load(tmp_path / "model", env="HardMove4-v0").set_env("HardMove4-v0")
    with pytest.raises(ValueError, match=r"env must be an environment.*got None"):
        model.set_env(None)


def test_policies_that_do_not_fit(algorithm):
    with pytest.raises(ValueError, match=r"policy must be one of .*'MlpPolicy'.*got 'MlpPolcy'"):
        make_model(algorithm, make_layout_env(), "MlpPolcy")
    with pytest.raises(ValueError, match=r"policy must be 'MlpPolicy', or 'CnnPolicy' for images, .*got \w*MultiInputPolicy"):
        make_model(algorithm, make_layout_env(), "MultiInputPolicy")
    for policy in (5, TD3Policy):
        with pytest.raises(ValueError, match=r"policy must be one of \('MlpPolicy', .*\) or derived from one, got (5|<class)"):
            make_model(algorithm, make_layout_env(), policy)
    with pytest.raises(ValueError, match=r"policy_kwargs\['activation_fn'\] must be a class, got 'relu'"):
        make_model(algorithm, make_layout_env(), policy_kwargs=dict(activation_fn="relu"))
    with pytest.raises(ValueError, match=r"policy_kwargs must be a dict, or None, got \[1\]"):
        make_model(algorithm, make_layout_env(), policy_kwargs=[1])


@pytest.mark.parametrize("arch", [8, [8, "8"], dict(pi=[8], qf=8)], ids=str)
def test_networks_that_are_none(algorithm, arch):
    with pytest.raises(ValueError, match=r"net_arch must be a list of whole numbers, or a dict of such lists, got "):
        make_model(algorithm, make_layout_env(), policy_kwargs=dict(net_arch=arch))
    make_model(algorithm, make_layout_env(), policy_kwargs=dict(net_arch=(8, 8)))


def test_network_of_a_wrong_name():
    with pytest.raises(ValueError, match=r"net_arch must have no keys but 'pi' and 'vf', got \{'pi'"):
        make_model(HPPO, make_layout_env(), policy_kwargs=dict(net_arch=dict(pi=[8], qf=[8])))


@pytest.mark.parametrize("steps", ["100", float("nan")])
def test_numbers_of_steps_that_are_none(algorithm, steps):
    with pytest.raises(ValueError, match="total_timesteps must be a finite number, got"):
        make_model(algorithm, make_layout_env()).learn(steps)


def test_a_training_without_a_gradient_step_says_so(off_policy_algorithm):
    with pytest.warns(UserWarning, match="Nothing is learnt yet: the first learning_starts=12 steps are random"):
        make_model(off_policy_algorithm, make_layout_env()).learn(10)


def test_no_gradient_steps(off_policy_algorithm):
    with pytest.warns(UserWarning, match="Nothing is learnt yet: no update was due, and training ended after 20"):
        make_model(off_policy_algorithm, make_layout_env(), gradient_steps=0).learn(20)


def test_normalization_within_what_reshapes_observations(off_policy_algorithm):
    class Camera(LayoutEnv):
        def __init__(self):
            super().__init__(layouts()["shared"], spaces.Box(0, 255, (36, 36, 1), np.uint8))

    env = DummyVecEnv([Camera])
    with pytest.raises(ValueError, match=r"as VecNormalize\(VecTransposeImage\(env\)\) has, .* got shapes \(36, 36, 1\)"):
        make_model(off_policy_algorithm, VecNormalize(env, norm_obs=False), "CnnPolicy").learn(20)
    with pytest.raises(ValueError, match=r"got shapes \(2,\) in VecNormalize and \(4,\) around it"):
        make_model(off_policy_algorithm, VecFrameStack(VecNormalize(DummyVecEnv([make_layout_env])), 2)).learn(20)
    make_model(off_policy_algorithm, VecNormalize(VecTransposeImage(env), norm_obs=False), "CnnPolicy").learn(20)


def test_unbounded_parameters(algorithm):
    with pytest.raises(ValueError, match="unbounded"):
        make_model(algorithm, LayoutEnv(spaces.Tuple((spaces.Discrete(2), box(-np.inf, 1, 2)))))
