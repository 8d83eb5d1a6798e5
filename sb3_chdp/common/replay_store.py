"""Replay buffers on disk, of which only what has changed is written again."""

import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.her import HerReplayBuffer
from torch import device

from sb3_chdp.common.checkpoint_store import GenerationWriter
from sb3_chdp.common.plain_data import is_plain, is_setting, state_of

# Arrays that get one row per time step and keep it; all others are written as a whole
ROW_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class Written(NamedTuple):
    """A generation that holds the buffer."""

    folder: Path
    files: dict[str, dict[str, Any]]
    n_added: int
    pos: int


def row_arrays(buffer: ReplayBuffer) -> dict[str, np.ndarray]:
    """:return: (buffer_size, n_envs, ...) arrays by name"""
    arrays = {}
    for name in ROW_ARRAYS:
        value = getattr(buffer, name, None)
        parts = {f"{name}/{key}": part for key, part in value.items()} if isinstance(value, dict) else {name: value}
        arrays.update({key: part for key, part in parts.items() if isinstance(part, np.ndarray)})
    return arrays


def buffer_state(buffer: ReplayBuffer) -> dict[str, Any]:
    """
    :return: all that the buffer knows beside the rows: the place of the next one, priorities
    :raises ValueError: if it keeps something else than numbers
    """
    harmless = (spaces.Space, VecEnv, device, type)
    # Those of a buffer that does not copy them are empty
    without_infos = isinstance(buffer, HerReplayBuffer) and not buffer.copy_info_dict
    elsewhere = (*ROW_ARRAYS, "infos") if without_infos else ROW_ARRAYS
    for name, value in vars(buffer).items():
        if not is_setting(buffer, name) and name not in elsewhere and not is_plain(value) and not isinstance(value, harmless):
            raise ValueError(f"Checkpoints hold no {type(buffer).__name__}: its {name} is not numbers but {type(value)}")
    return state_of(buffer, ignored=ROW_ARRAYS)


def _filled(buffer: ReplayBuffer) -> int:
    # The row that comes next holds the latest observation if optimize_memory_usage=True
    return buffer.buffer_size if buffer.full else min(buffer.pos + 1, buffer.buffer_size)


class ReplayStore:
    """
    Writes a replay buffer in chunks of rows.

    Chunks without new rows are taken over from the generation before the last one, which is about to go: the two that are
    kept never share a file, and one survives what damages the other.

    :param chunk_bytes: size of a file
    """

    def __init__(self, chunk_bytes: int) -> None:
        self.chunk_bytes = chunk_bytes
        #: rows added to the buffer so far, to be counted by the owner
        self.n_added = 0
        self._buffer: ReplayBuffer | None = None
        self._written: list[Written] = []

    def forget(self) -> None:
        """Write everything next time: rows may have changed that nobody counted."""
        self._written = []

    def write(self, buffer: ReplayBuffer, writer: GenerationWriter) -> int:
        """
        :param buffer: the replay buffer
        :param writer: the generation that is being written
        :return: rows per chunk
        """
        if buffer is not self._buffer:
            self.forget()
            self._buffer = buffer
        arrays = row_arrays(buffer)
        row_bytes = sum(array[0].nbytes for array in arrays.values())
        n_rows = max(1, self.chunk_bytes // row_bytes)
        unchanged = self._unchanged(buffer, n_rows)
        for start in range(0, _filled(buffer), n_rows):
            name = f"replay/{start // n_rows:06d}.npy"
            if name in unchanged:
                writer.link(name, self._written[0].folder, self._written[0].files[name])
                continue
            file = io.BytesIO()
            for array in arrays.values():
                np.save(file, array[start : min(start + n_rows, _filled(buffer))], allow_pickle=False)
            writer.write(name, file.getbuffer())
        return n_rows

    def commit(self, buffer: ReplayBuffer, folder: Path, files: dict[str, dict[str, Any]]) -> None:
        """
        The generation is complete.

        :param buffer: the replay buffer, as it was written
        :param folder: where the generation is now
        :param files: records of its files
        """
        self._written = [*self._written, Written(folder, files, self.n_added, buffer.pos)][-2:]

    def _unchanged(self, buffer: ReplayBuffer, n_rows: int) -> set[str]:
        """:return: names of the files that the generation before the last one holds as they would be written"""
        if len(self._written) < 2:
            return set()
        base = self._written[0]
        n_new = self.n_added - base.n_added
        if n_new >= buffer.buffer_size or (base.pos + n_new) % buffer.buffer_size != buffer.pos:
            return set()
        # With optimize_memory_usage=True the row behind the new ones has changed too
        rows = np.arange(base.pos, base.pos + n_new + 1) % buffer.buffer_size
        changed = {f"replay/{chunk:06d}.npy" for chunk in np.unique(rows // n_rows)}
        return {name for name in base.files if name.startswith("replay/")} - changed


def read_rows(buffer: ReplayBuffer, folder: Path, n_rows: int) -> None:
    """
    Fill a buffer.

    :param buffer: an empty buffer of the same shape
    :param folder: the generation
    :param n_rows: rows per chunk
    :raises ValueError: if the rows do not fit
    """
    arrays = row_arrays(buffer)
    for path in sorted((folder / "replay").glob("*.npy")):
        start = int(path.stem) * n_rows
        with path.open("rb") as file:
            for name, array in arrays.items():
                rows = np.load(file, allow_pickle=False)
                target = array[start : start + len(rows)]
                if rows.shape != target.shape or rows.dtype != target.dtype:
                    raise ValueError(
                        f"The replay buffer's {name} are {target.dtype} of shape {array.shape[1:]} per row, "
                        f"those of the checkpoint {rows.dtype} of shape {rows.shape[1:]}"
                    )
                target[:] = rows
