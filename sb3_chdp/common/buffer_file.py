"""Replay buffers as a zip of JSON and NumPy arrays."""

import json
import zipfile
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.save_util import open_path

from sb3_chdp.common.safe_zip import HEADER, PathOrFile, is_path, make_header, read_header
from sb3_chdp.common.serialization import NotSerializable, decode, encode


def save_buffer(buffer: ReplayBuffer, path: PathOrFile) -> bool:
    """
    :param buffer: a replay buffer
    :param path: where to write it to; SB3's suffix ``.pkl`` is appended if there is none
    :return: whether it was written; not if it can only be pickled (a class or an entry that is not SB3's or this package's)
    """
    # Python 3.10 has no default __getstate__
    get_state = getattr(buffer, "__getstate__", None)
    state: dict[str, Any] = dict(vars(buffer) if get_state is None else get_state())
    state.pop("device", None)
    arrays: list[np.ndarray] = []
    try:
        data = encode({"class": type(buffer), "state": state}, arrays)
    except NotSerializable:
        return False
    file = open_path(path, "w", suffix="pkl")
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(HEADER, make_header(buffer))
        archive.writestr("data", json.dumps(data, indent=4))
        for i, array in enumerate(arrays):
            with archive.open(f"{i}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)
    if is_path(path):
        file.close()
    return True


def load_buffer(path: PathOrFile) -> ReplayBuffer | None:
    """
    :param path: the file
    :return: the replay buffer, None if the file was not written by :func:`save_buffer`
    :raises ValueError: for a file of a version that this one does not read
    """
    file: Any = open_path(path, "r", suffix="pkl")
    start = file.tell()
    try:
        if not zipfile.is_zipfile(file):
            return None
        with zipfile.ZipFile(file) as archive:
            if read_header(archive, ReplayBuffer, path) is None:
                return None
            names = sorted((name for name in archive.namelist() if name.endswith(".npy")), key=lambda name: int(name[:-4]))
            data = json.loads(archive.read("data"))
            arrays = []
            for name in names:
                with archive.open(name) as entry:
                    arrays.append(np.lib.format.read_array(entry, allow_pickle=False))
    finally:
        file.seek(start) if not is_path(path) else file.close()
    content = decode(data, arrays)
    kind = content["class"]
    if not (isinstance(kind, type) and issubclass(kind, ReplayBuffer)):
        raise ValueError(f"{path} does not hold a replay buffer but a {kind}")
    buffer = kind.__new__(kind)
    if hasattr(buffer, "__setstate__"):
        buffer.__setstate__(content["state"])
    else:
        vars(buffer).update(content["state"])
    return buffer


def check_buffer(path: PathOrFile, buffer: Any, own: Any) -> None:
    """
    :param path: file of a replay buffer, for the message
    :param buffer: what was in it
    :param own: the replay buffer that it is to replace
    :raises ValueError: if it holds other data than that one; only their sizes may differ
    """

    def content(of: Any) -> dict[str, Any]:
        names = ("observation_space", "action_space", "n_envs", "n_steps", "gamma")
        state_parts = getattr(of.action_space, "state_parts", ())
        values = {name: getattr(of, name) for name in names if hasattr(of, name)}
        return {"class": type(of).__name__, "state_parts": state_parts, **values}

    found, expected = content(buffer), content(own)
    for name, value in expected.items():
        if found.get(name) != value:
            remedy = {"state_parts": "see use_masking", "gamma": "see replay_buffer_kwargs"}.get(name)
            raise ValueError(
                f"{path} must hold a replay buffer like that of the model, with {name} {value}, got {found.get(name)}"
                f"{f'; {remedy}' if remedy else ''}"
            )
