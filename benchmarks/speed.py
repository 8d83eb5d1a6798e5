"""
Speed, as medians over repeats in one process on one thread; the results replace the section of benchmarks/README.md.

    make speed                                        all tables
    python benchmarks/speed.py --tables step loop     some of them, printed only
    python benchmarks/speed.py --device cuda          what a GPU changes, printed only

Ratios compare what ran side by side, turn by turn. Only the original environments were measured elsewhere (AMD EPYC, 2
vCPUs, Python 3.11.7): read those ratios as orders of magnitude.
"""

import argparse
import statistics
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
import stable_baselines3 as sb3
import torch as th
from gymnasium import spaces
from publish import README, replace_section
from safety import checkpoints, guards
from stable_baselines3 import TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from timing import ENV_ID, build, medians
from torch.profiler import ProfilerActivity, profile

import sb3_chdp
from sb3_chdp import ALGORITHMS, CHDP, HPPO, PDQNTD3, FlattenHybridAction, HybridActionSpec
from sb3_chdp.benchmark.training import machine
from sb3_chdp.chdp import PaperCHDP

# Of the originals with a uniformly random policy: frames per second for Platform (with numba) and Goal, else steps
REFERENCE_RATES = {
    "Platform-v0": 21_000,
    "Goal-v0": 17_100,
    "HardGoal-v0": 16_500,
    "CatchPoint-v0": 17_400,
    "HardMove4-v0": 6_500,
    "HardMove6-v0": 3_800,
    "HardMove8-v0": 1_350,
    "HardMove10-v0": 350,
}
BIG = dict(net_arch=dict(pi=[256, 256], qf=[256, 256]))


class ManyActions(gym.Env):
    """K discrete actions with a shared parameter; nothing happens."""

    def __init__(self, n_actions: int):
        self.observation_space = spaces.Box(-1.0, 1.0, (4,), dtype=np.float32)
        self.action_space = spaces.Tuple((spaces.Discrete(n_actions), spaces.Box(-1.0, 1.0, (1,))))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        return self.np_random.uniform(-1, 1, 4).astype(np.float32), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return self.reset()[0], 0.0, False, False, {}


def off_policy() -> dict[str, type[Any]]:
    """:return: the off-policy algorithms by their display names"""
    classes = {algorithm.display_name: algorithm.load_class() for algorithm in ALGORITHMS.values()}
    return {name: algorithm for name, algorithm in classes.items() if issubclass(algorithm, OffPolicyAlgorithm)}


def environments(repeats: int) -> Iterator[str]:
    """(e) steps per second under a uniformly random policy, sampling and resets included"""
    yield "| environment | steps/s | frames/s | original (other machine) | ratio |\n|---|---|---|---|---|"
    for env_id, reference in REFERENCE_RATES.items():
        env = gym.make(env_id)
        spec = HybridActionSpec(env.action_space)
        rng = np.random.default_rng(0)
        env.reset(seed=0)
        rates = []
        for _ in range(3):
            steps = frames = 0
            start = time.perf_counter()
            while time.perf_counter() - start < repeats / 30:
                for action in spec.to_native_batch(spec.sample_rows(rng, 32)):
                    _, _, terminated, truncated, info = env.step(action)
                    steps += 1
                    frames += info["frames"]
                    if terminated or truncated:
                        env.reset()
            duration = time.perf_counter() - start
            rates.append((steps / duration, frames / duration))
        step_rate, frame_rate = (statistics.median(values) for values in zip(*rates, strict=True))
        ratio = (frame_rate if env_id in ("Platform-v0", "Goal-v0", "HardGoal-v0") else step_rate) / reference
        yield f"| {env_id} | {step_rate:,.0f} | {frame_rate:,.0f} | {reference:,} | {ratio:.0f} |"


def conversion(repeats: int) -> Iterator[str]:
    """Rows to native actions"""
    yield "| action space | microseconds per native action (batch of 8) |\n|---|---|"
    box = spaces.Box(-1.0, 1.0, (1,))
    cases = {
        "nested, K = 4": spaces.Tuple((spaces.Discrete(4), spaces.Tuple([box] * 4))),
        "nested, K = 1024": spaces.Tuple((spaces.Discrete(1024), spaces.Tuple([box] * 1024))),
        "shared, K = 1024": spaces.Tuple((spaces.Discrete(1024), box)),
        "product, K = 65,536": spaces.Tuple((spaces.MultiBinary(16), box)),
    }
    for name, space in cases.items():
        spec = HybridActionSpec(space)
        rows = spec.sample_rows(np.random.default_rng(0), 8)
        (seconds,) = medians([partial(spec.to_native_batch, rows)], 20 * repeats)
        yield f"| {name} | {seconds / 8 * 1e6:.0f} |"


def step(repeats: int, device: str) -> Iterator[str]:
    """(a) gradient step against SB3's TD3, all with batches of 128; TD3 on the flattened environment, 2 x 256"""
    cases: list[tuple[str, type[BaseAlgorithm], int, dict[str, Any]]] = [
        # Every other step of TD3 updates its policy
        ("SB3's TD3", TD3, 2, dict(wrapper=FlattenHybridAction, policy_kwargs=dict(net_arch=[256, 256]))),
        ("CHDP", CHDP, 2, {}),
        ("CHDP, 2 x 256", CHDP, 2, dict(policy_kwargs=BIG)),
        ("PaperCHDP", PaperCHDP, 1, {}),
    ]
    models = [build(algorithm, device=device, **kwargs) for _, algorithm, _, kwargs in cases]
    seconds = medians([partial(m.train, case[2], 128) for m, case in zip(models, cases, strict=True)], repeats)
    per_step = [value / case[2] for value, case in zip(seconds, cases, strict=True)]
    yield "| gradient step | ratio to TD3 | milliseconds |\n|---|---|---|"
    for (name, *_), value in zip(cases, per_step, strict=True):
        yield f"| {name} | {value / per_step[0]:.2f} | {1e3 * value:.2f} |"


def matrix_products(repeats: int) -> Iterator[str]:
    """(b) distance to the matrix products of two steps of CHDP, which are run once more on their own"""
    yield "| configuration | two steps, ms | their matrix products alone, ms | ratio |\n|---|---|---|---|"
    for name, batch_size, kwargs in (("defaults", 128, None), ("2 x 256", 256, BIG)):
        model = build(CHDP, policy_kwargs=kwargs)
        model.train(2, batch_size)
        with profile(activities=[ProfilerActivity.CPU], record_shapes=True) as record:
            model.train(2, batch_size)
        # Where an operation has its two factors; what comes after them is where the product is put
        first = {"aten::mm": 0, "aten::addmm": 1, "aten::addmm_": 1}
        shapes = [
            tuple(tuple(shape) for shape in event.input_shapes[first[event.name] :][:2])
            for event in record.events()
            if event.name in first
        ]
        pairs = {(a, b): (th.randn(a), th.randn(b)) for a, b in shapes}
        products = [pairs[a, b] for a, b in shapes]

        def only_products(products: Any = products) -> None:
            for a, b in products:
                th.mm(a, b)

        whole, floor = medians([partial(model.train, 2, batch_size), only_products], repeats)
        label = f"{name}, batch {batch_size}: {len(products)} products"
        yield f"| {label} | {1e3 * whole:.1f} | {1e3 * floor:.1f} | {whole / floor:.1f} |"


def predict(repeats: int, device: str) -> Iterator[str]:
    """(c) acting: CHDP chooses among candidates, and refines its choice in deterministic predictions"""
    yield "| observations | CHDP, ms | CHDP, deterministic, ms | PaperCHDP, ms | SB3's TD3, ms |\n|---|---|---|---|---|"
    chdp, paper = build(CHDP, device=device), build(PaperCHDP, device=device)
    td3 = build(TD3, wrapper=FlattenHybridAction, device=device)
    cases = [(chdp, False), (chdp, True), (paper, True), (td3, True)]
    for n in (1, 8, 64):
        obs = np.random.default_rng(0).uniform(-1, 1, (n, 4)).astype(np.float32)
        seconds = medians([partial(m.predict, obs, deterministic=d) for m, d in cases], repeats)
        yield f"| {n} | " + " | ".join(f"{1e3 * value:.2f}" for value in seconds) + " |"


def discrete_actions(repeats: int, device: str) -> Iterator[str]:
    """(d) number of discrete actions, CHDP's defaults"""
    yield "| K | gradient step, ms | ratio to K = 4 |\n|---|---|---|"
    sizes = (4, 64, 1024, 65_536)
    models = [build(CHDP, partial(ManyActions, k), device=device) for k in sizes]
    seconds = medians([partial(m.train, 2, 128) for m in models], repeats)
    for k, value in zip(sizes, seconds, strict=True):
        yield f"| {k:,} | {1e3 * value / 2:.1f} | {value / seconds[0]:.2f} |"


def baselines(repeats: int, device: str) -> Iterator[str]:
    """(g) gradient step of every algorithm; networks of 2 x 256, batch 128 (CHDP, PaperCHDP: their defaults)"""
    rows: list[tuple[str, Any, int]] = []
    settings: dict[str, Any] = dict(policy_kwargs=dict(net_arch=[256, 256]), device=device)
    rows.append(("SB3's TD3", build(TD3, wrapper=FlattenHybridAction, **settings), 2))
    others = {name: algorithm for name, algorithm in off_policy().items() if not issubclass(algorithm, CHDP)}
    rows += [(name, build(algorithm, **settings), 2) for name, algorithm in others.items()]
    rows.append(("PDQN-TD3, multi_pass", build(PDQNTD3, multi_pass=True, **settings), 2))
    rows += [("CHDP", build(CHDP, device=device), 2), ("PaperCHDP", build(PaperCHDP, device=device), 1)]
    seconds = medians([partial(model.train, n, 128) for _, model, n in rows], repeats)
    per_step = [value / n for value, (_, _, n) in zip(seconds, rows, strict=True)]
    env = make_vec_env(ENV_ID, 8, seed=0)
    hppo = HPPO("MlpPolicy", env, n_steps=128, n_epochs=1, seed=0, **settings)
    hppo.learn(1024)
    (rollout,) = medians([hppo.train], repeats // 3)  # 16 minibatches
    per_step.append(rollout / 16)
    yield "| algorithm | gradient step, ms | ratio to TD3 |\n|---|---|---|"
    for name, value in zip([*(row[0] for row in rows), "HPPO, minibatch 64"], per_step, strict=True):
        yield f"| {name} | {1e3 * value:.2f} | {value / per_step[0]:.2f} |"


def loop(repeats: int, device: str) -> Iterator[str]:
    """(f) the whole training loop of CHDP, one gradient step for two environment steps, and where its time goes"""
    yield "| environments | steps/s | gradient steps per step | acting | environment | buffer | update | rest |"
    yield "|---|---|---|---|---|---|---|---|"
    for n_envs in (1, 8):
        shares = dict.fromkeys(("acting", "environment", "buffer", "update"), 0.0)
        model = build(CHDP, n_envs=n_envs, train_freq=max(2 // n_envs, 1), device=device)
        model.gradient_steps = max(n_envs // 2, 1)

        def timed(owner: Any, method: str, name: str, shares: dict[str, float] = shares) -> None:
            function = getattr(owner, method)

            def wrapper(*args: Any, **kwargs: Any) -> Any:
                start = time.perf_counter()
                result = function(*args, **kwargs)
                shares[name] += time.perf_counter() - start
                return result

            setattr(owner, method, wrapper)

        timed(model, "_sample_action", "acting")
        timed(model.env, "step", "environment")
        timed(model, "_store_transition", "buffer")
        timed(model, "train", "update")
        n_steps = 40 * repeats
        start = time.perf_counter()
        model.learn(n_steps, reset_num_timesteps=False)
        total = time.perf_counter() - start
        shares["rest"] = total - sum(shares.values())
        values = " | ".join(f"{100 * value / total:.0f} %" for value in shares.values())
        yield f"| {n_envs} | {n_steps / total:.0f} | 0.5 | {values} |"


def memory(repeats: int) -> Iterator[str]:
    """(h) replay buffers of 1e6 transitions: bytes of their arrays, which are allocated at once"""
    yield "| environment | algorithm | row | replay buffer, MB |\n|---|---|---|---|"
    for env_id in ("Platform-v0", "HardMove10-v0"):
        for name, algorithm in off_policy().items():
            model = algorithm("MlpPolicy", env_id, buffer_size=10, device="cpu")
            buffer = model.replay_buffer
            arrays = [value for value in vars(buffer).values() if isinstance(value, np.ndarray)]
            size = sum(array.nbytes for array in arrays) / buffer.buffer_size
            yield f"| {env_id} | {name} | {buffer.actions.shape[-1]} | {size:,.0f} |"


TABLES = {
    function.__name__: function
    for function in (
        step, matrix_products, predict, discrete_actions, environments, conversion, loop, baselines, memory,
        guards, checkpoints,
    )
}  # fmt: skip
# What a GPU may change
OF_NETWORKS = ["step", "predict", "discrete_actions", "loop", "baselines"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tables", nargs="+", choices=list(TABLES), help="print only these")
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--device", default="cpu", help="another one than the CPU: the tables of networks, printed only")
    args = parser.parse_args()
    names = args.tables or (list(TABLES) if args.device == "cpu" else OF_NETWORKS)
    th.set_num_threads(1)
    text = (
        f"sb3_chdp {sb3_chdp.__version__}, stable_baselines3 {sb3.__version__}, torch {th.__version__}, "
        f"{machine(threads=1)}, device {args.device}\n"
    )
    print(text)
    for name in names:
        title = f"\n### {(TABLES[name].__doc__ or '').strip()}\n"
        print(title)
        lines = []
        options = {"device": args.device} if name in OF_NETWORKS else {}
        for line in TABLES[name](args.repeats, **options):
            print(line, flush=True)
            lines.append(line)
        text += "\n".join([title, *lines, ""])
    if names == list(TABLES):
        replace_section(README, "speed", text.rstrip())


if __name__ == "__main__":
    main()
