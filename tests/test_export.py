"""Exported policies decide what ``predict`` decides."""

import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO

import sb3_chdp
from sb3_chdp.common.export import ExportablePolicy
from sb3_chdp.registry import ALGORITHMS as REGISTRY
from tests.hybrid_envs import LayoutEnv, box, layouts, make_layout_env

ort = pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript")

# Of algorithms that export alike one is enough in a hurry
ALGORITHMS = [
    pytest.param(line.class_name, marks=pytest.mark.slow) if line.name == "chdp_paper" else line.class_name
    for line in REGISTRY.values()
]
FACTORING = [
    pytest.param(line.class_name, marks=pytest.mark.slow) if line.name.startswith("chdp") else line.class_name
    for line in REGISTRY.values()
    if line.load_class().takes_factored
]
N = 1_000
MODEL = Path(__file__).parent.parent / "benchmarks" / "models" / "chdp" / "Platform-v0_1" / "Platform-v0.zip"
PAGE = Path(__file__).parent.parent / "docs" / "guide" / "export.md"
FACTORED = spaces.Tuple((spaces.MultiDiscrete([40, 3, 30]), box(-1, 1, 2)))
MANY = spaces.Tuple((spaces.Discrete(2_500), box(-1, 1, 1)))


def batch_of(space, n):
    """:return: n observations, stacked"""
    samples = [space.sample() for _ in range(n)]
    if isinstance(space, spaces.Dict):
        return {key: np.stack([sample[key] for sample in samples]) for key in space.spaces}
    return np.stack(samples)


def as_tensors(observations):
    if isinstance(observations, dict):
        return {key: th.as_tensor(part) for key, part in observations.items()}
    return th.as_tensor(observations)


def export(model, path, observations, example):
    """:return: decisions of the exported program, and of its ONNX form, about the observations"""
    size = {0: th.export.Dim("n")}
    shapes = ({key: size for key in example} if isinstance(example, dict) else size,)
    program = th.export.export(ExportablePolicy(model.policy), (example,), dynamic_shapes=shapes)
    with th.no_grad():
        exported = [part.numpy() for part in program.module()(observations)]
    th.onnx.export(program, f=str(path), verbose=False)
    session = ort.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    parts = list(observations.values()) if isinstance(observations, dict) else [observations]
    feed = {place.name: part.numpy() for place, part in zip(session.get_inputs(), parts, strict=True)}
    return exported, session.run(None, feed)


def check(model, tmp_path, n=N):
    """Export with a batch of two, and compare with ``predict`` on n observations."""
    with th.no_grad():
        # Untrained policies decide the same nearly everywhere
        for weight in model.policy.parameters():
            weight.mul_(3)
    space = model.observation_space
    space.seed(0)
    example, observations = (as_tensors(batch_of(space, size)) for size in (2, n))
    both = export(model, tmp_path / "policy.onnx", observations, example)

    is_dict = isinstance(observations, dict)
    arrays = {key: part.numpy() for key, part in observations.items()} if is_dict else observations.numpy()
    actions, _ = model.predict(arrays, deterministic=True)
    spec = model.policy.action_space.spec
    expected = np.stack([spec.to_row(action) for action in actions])
    choices, own_parameters = spec.columns.discrete_actions(expected), spec.columns.view(expected, "parameters")
    options = spec.options_of(choices)
    if not isinstance(space, spaces.Discrete):
        assert len(np.unique(choices, axis=0)) > 1, "a policy that always decides the same shows nothing"
    half = np.where(spec.half_range > 0, spec.half_range, 1)[options]
    for k, parameters in both:
        np.testing.assert_array_equal(k, choices)
        np.testing.assert_allclose((parameters - spec.centre[options]) / half, own_parameters, atol=1e-5)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm(name, tmp_path):
    # Others decide the same everywhere before they are trained
    seed = 8 if name == "CHDP" else 1
    check(getattr(sb3_chdp, name)("MlpPolicy", make_layout_env("flat"), seed=seed), tmp_path)


@pytest.mark.slow
def test_rewards_that_count_for_more(tmp_path):
    model = sb3_chdp.CHDP("MlpPolicy", make_layout_env("flat"), seed=8)
    model.policy.set_foresight(0.5)
    check(model, tmp_path, n=50)


@pytest.mark.slow
def test_a_trained_model(tmp_path):
    """Where a decision differs, the critics hold another candidate for as good, to the rounding of their values."""
    model = sb3_chdp.CHDP.load(MODEL, device="cpu")
    model.observation_space.seed(0)
    observations = th.as_tensor(batch_of(model.observation_space, N))
    _, (k, parameters) = export(model, tmp_path / "policy.onnx", observations, observations[:2])
    values: tuple[list, list] = ([], [])
    for network, kept in zip(model.critic_target.q_networks, values, strict=True):
        network.register_forward_hook(lambda module, args, outputs, kept=kept: kept.append(outputs.detach()[:, 0]))
    with th.no_grad():
        own_k, own_parameters = (part.numpy() for part in ExportablePolicy(model.policy)(observations))
    of_all = th.min(values[0][0], values[1][0]).view(N, -1)
    tied = (of_all.max(dim=1, keepdim=True).values - of_all < 1e-5).sum(dim=1).numpy() > 1
    half = np.where(model.hybrid_space.spec.half_range > 0, model.hybrid_space.spec.half_range, 1)[own_k]
    equal = (k == own_k) & (np.abs(parameters - own_parameters) / half < 1e-5).all(axis=1)
    assert (equal | tied).all() and equal.mean() >= 0.99


OBSERVATIONS = {
    "image": ("CnnPolicy", spaces.Box(0, 255, (36, 36, 3), np.uint8)),
    "dict": ("MultiInputPolicy", spaces.Dict({"a": box(-1, 1, 3), "kind": spaces.Discrete(4)})),
    "discrete": ("MlpPolicy", spaces.Discrete(5)),
}


@pytest.mark.parametrize("kind", OBSERVATIONS)
def test_observations(kind, tmp_path):
    policy, space = OBSERVATIONS[kind]
    check(sb3_chdp.PATD3(policy, make_layout_env("shared", observation_space=space), seed=0, buffer_size=10), tmp_path, n=50)


def test_many_discrete_actions(tmp_path):
    check(sb3_chdp.HyARTD3("MlpPolicy", LayoutEnv(MANY), seed=0, buffer_size=10), tmp_path, n=50)


@pytest.mark.parametrize("name", FACTORING)
def test_factored_actions(name, tmp_path):
    check(getattr(sb3_chdp, name)("MlpPolicy", LayoutEnv(FACTORED), seed=0), tmp_path, n=50)


@pytest.mark.parametrize("layout", layouts())
def test_parameters_are_in_the_units_of_the_space(layout):
    """What the page says about the order of parts: as rows are decoded."""
    model = sb3_chdp.PATD3("MlpPolicy", make_layout_env(layout), buffer_size=10)
    spec = model.policy.action_space.spec
    observations = np.random.default_rng(0).uniform(-1, 1, (20, 2)).astype(np.float32)
    with th.no_grad():
        k, parameters = (part.numpy() for part in ExportablePolicy(model.policy)(th.as_tensor(observations)))
    low, high = spec.centre - spec.half_range, spec.centre + spec.half_range
    assert (low[k] <= parameters).all() and (parameters <= high[k]).all() and not parameters[~spec.parameter_mask[k]].any()
    for action, choice, own in zip(model.predict(observations, deterministic=True)[0], k, parameters, strict=True):
        row = spec.to_row(action)
        assert row[0] == choice
        np.testing.assert_allclose(spec.centre[choice] + spec.half_range[choice] * row[1:], own, atol=1e-5)


def test_other_policies_are_refused():
    with pytest.raises(TypeError, match=r"policy must be model\.policy of a model of sb3_chdp, got ActorCriticPolicy"):
        ExportablePolicy(PPO("MlpPolicy", gym.make("CartPole-v1")).policy)  # type: ignore[arg-type]


def test_the_page(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code = "".join(re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL))
    names: dict = {}
    exec(code.replace("2_000", "64").replace('device="cpu"', 'device="cpu", n_steps=32'), names)
    model, observation, action = names["model"], names["observation"], names["action"]
    assert model.action_space.contains(action)
    expected, _ = model.predict(observation, deterministic=True)
    assert expected[0] == action[0]
    np.testing.assert_allclose(expected[1][action[0]], action[1][action[0]], atol=1e-5)
    assert (tmp_path / "policy.pt2").is_file()
