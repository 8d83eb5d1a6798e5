"""Saved models that tests take apart, change and compare."""

import io
import json
import os
import sys
import zipfile

import numpy as np
import torch as th

from tests.algorithms import make_model
from tests.hybrid_envs import make_layout_env

OBS = np.random.default_rng(0).uniform(-1, 1, (20, 2)).astype(np.float32)
UNPICKLED: list[str] = []
sys.addaudithook(lambda event, args: UNPICKLED.append(f"{args[0]}.{args[1]}") if event == "pickle.find_class" else None)


class Payload:
    """Makes a file when it is unpickled."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.system, (f"touch {self.marker}",)


def saved_model(algorithm, tmp_path, **kwargs):
    model = make_model(algorithm, make_layout_env(), **kwargs).learn(20)
    model.save(tmp_path / "model")
    return model


def rewrite(path, changes):
    """Copy a zip with some entries replaced or added."""
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    changed = path.with_name("changed.zip")
    with zipfile.ZipFile(changed, "w") as archive:
        for name, content in {**entries, **changes}.items():
            archive.writestr(name, content)
    return changed


def entry(path, name):
    with zipfile.ZipFile(path) as archive:
        return archive.read(name)


def with_data(path, **items):
    return rewrite(path, {"data": json.dumps({**json.loads(entry(path, "data")), **items})})


def torch_file(obj):
    file = io.BytesIO()
    th.save(obj, file)
    return file.getvalue()


def same_predictions(first, second):
    np.testing.assert_equal(first.predict(OBS, deterministic=True)[0], second.predict(OBS, deterministic=True)[0])
