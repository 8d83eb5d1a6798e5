"""The model card: what a repository of the Hub says about its model."""

from collections.abc import Mapping
from pprint import pformat
from typing import Any, NamedTuple

import numpy as np
from huggingface_hub import EvalResult, ModelCard, ModelCardData

from sb3_chdp.registry import ALGORITHMS


class Evaluation(NamedTuple):
    """
    Deterministic episodes of a model.

    :ivar returns: (n,) returns of the episodes
    :ivar successes: (n,) whether they succeeded, empty if the environment does not say so
    """

    returns: list[float]
    successes: list[float]

    def metrics(self) -> dict[str, str]:
        """:return: what is measured, in words and with numbers"""
        metrics = {"mean return": f"{np.mean(self.returns):.2f} ± {np.std(self.returns):.2f}"}
        if self.successes:
            metrics["success"] = f"{100 * np.mean(self.successes):.1f} %"
        return metrics


def make_card(
    algo: str,
    env_id: str,
    repo_id: str,
    model_file: str,
    evaluation: Evaluation,
    hyperparams: Mapping[str, Any],
    n_timesteps: int,
    has_video: bool,
) -> ModelCard:
    """
    :param algo: name of the algorithm
    :param env_id: environment
    :param repo_id: ``organization/name`` of the repository
    :param model_file: the model in it
    :param evaluation: what the model achieves
    :param hyperparams: those of the training
    :param n_timesteps: number of steps that the model was trained for
    :param has_video: whether there is a ``replay.mp4``, which the Hub shows beside the card
    :return: the card
    """
    is_own = algo in ALGORITHMS
    class_name = ALGORITHMS[algo].class_name if is_own else algo.upper()
    display_name = ALGORITHMS[algo].display_name if is_own else class_name
    metrics = evaluation.metrics()
    data = ModelCardData(
        library_name="stable-baselines3",
        tags=[env_id, "deep-reinforcement-learning", "reinforcement-learning", "stable-baselines3", "sb3_chdp"],
        model_name=display_name,
        eval_results=[
            EvalResult(
                task_type="reinforcement-learning",
                task_name="reinforcement-learning",
                dataset_type=env_id,
                dataset_name=env_id,
                metric_type=name.replace(" ", "_"),
                metric_name=name,
                metric_value=value,
            )
            for name, value in metrics.items()
        ],
    )
    organization, name = repo_id.split("/")
    algo_option = f"--algo {algo}" if is_own else f"--algo sb3:{algo}"
    trust = "" if is_own else " --trusted"
    results = "\n".join(f"| {name} | {value} |" for name, value in metrics.items())
    in_python = f"""
```python
from huggingface_hub import hf_hub_download
from sb3_chdp import {class_name}

model = {class_name}.load(hf_hub_download("{repo_id}", "{model_file}"))
```

No code of the file's runs. The observation that `model.predict` wants is that of the environment, and its action one for it.
"""
    text = f"""
# {display_name} on {env_id}

Trained with sb3_chdp, which brings hybrid (parameterized) action spaces to
[Stable-Baselines3](https://github.com/DLR-RM/stable-baselines3).
{"The video shows the model." if has_video else ""}

| {len(evaluation.returns)} deterministic episodes | |
|---|---|
{results}

## Load
{in_python if is_own else ""}
On the command line, in a folder of your own. An environment that is not part of sb3_chdp needs `--gym-packages MODULE` too.

```bash
sb3-chdp load_from_hub {algo_option} --env {env_id} -orga {organization} -name {name}{trust}
sb3-chdp enjoy {algo_option} --env {env_id}
```

## Train

```bash
sb3-chdp train {algo_option} --env {env_id} -n {n_timesteps}
```

The hyperparameters were these; `-params` or a file for `-conf` sets what differs from the file of today.

```python
{pformat({**hyperparams, 'n_timesteps': n_timesteps}, sort_dicts=True)}
```
"""
    return ModelCard(f"---\n{data.to_yaml()}\n---\n{text}")
