"""A folder with the last two generations of a set of files, each complete or not there at all."""

import errno
import hashlib
import json
import os
import re
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

MANIFEST = "manifest.json"
TEMPORARY = ".writing"
LOCK = ".lock"
KEPT = 2
GENERATION = re.compile(r"(\d{6,})_\d+_steps")


class DamagedError(ValueError):
    """A file of a generation is missing or not what was written; the message names it."""


def _fsync_folder(folder: Path) -> None:
    if os.name != "nt":  # Windows cannot open folders
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _checksum(files: dict[str, dict[str, Any]]) -> str:
    return hashlib.sha256(json.dumps(files).encode()).hexdigest()


class GenerationWriter:
    """
    A generation that is being written.

    :param folder: where its files go
    """

    def __init__(self, folder: Path):
        self.folder = folder
        #: size and checksum of every file by name
        self.files: dict[str, dict[str, Any]] = {}

    def write(self, name: str, content: bytes | memoryview) -> None:
        """
        :param name: name of the file, with ``/`` for folders
        :param content: what it is to hold
        """
        path = self.folder / name
        path.parent.mkdir(exist_ok=True)
        with path.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        self.files[name] = {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()}

    def link(self, name: str, base: Path, record: dict[str, Any]) -> None:
        """
        Take over an unchanged file.

        :param name: name of the file
        :param base: folder of the generation that holds it
        :param record: its size and checksum there
        """
        path = self.folder / name
        path.parent.mkdir(exist_ok=True)
        try:
            os.link(base / name, path)
        except OSError:  # not all file systems have links
            shutil.copyfile(base / name, path)
        self.files[name] = record


class CheckpointStore:
    """
    Folder with the last two generations of a checkpoint.

    A generation is written to a temporary folder, flushed to the disk and renamed: a process killed at any moment leaves
    two whole ones behind.

    :param directory: the folder
    """

    def __init__(self, directory: str | Path):
        self.directory = Path(directory)
        # Those known to be whole, the newest last
        self.whole: list[Path] = []
        self._lock: IO[str] | None = None

    def lock(self) -> None:
        """
        Keep other processes from writing here, until this one ends or the store is gone.

        :raises ValueError: if another process has done so
        """
        if fcntl is None or self._lock is not None:
            return
        file = (self.directory / LOCK).open("w")
        try:
            # Of this process and not of its children, which may outlive it
            fcntl.lockf(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.close()
            if error.errno in (errno.EACCES, errno.EAGAIN):
                raise ValueError(f"Another process writes checkpoints to {self.directory}") from error
            return  # not all file systems have locks
        self._lock = file

    def generations(self) -> list[Path]:
        """:return: folders of all generations, damaged ones too, the newest first"""
        if not self.directory.is_dir():
            return []
        numbers = {folder: GENERATION.fullmatch(folder.name) for folder in self.directory.iterdir()}
        return sorted((f for f, match in numbers.items() if match), key=lambda f: int(f.name.split("_")[0]), reverse=True)

    def write(self, n_steps: int, fill: Callable[[GenerationWriter], None]) -> Path:
        """
        :param n_steps: steps of the model, part of the name
        :param fill: writes the files
        :return: folder of the new generation
        :raises OSError: if the disk does not take it; earlier generations are still there
        """
        temporary = self.directory / TEMPORARY
        if temporary.exists():
            shutil.rmtree(temporary)
        present = self.generations()
        number = 1 + (int(present[0].name.split("_")[0]) if present else 0)
        folder = self.directory / f"{number:06d}_{n_steps}_steps"
        try:
            temporary.mkdir(parents=True)
            writer = GenerationWriter(temporary)
            fill(writer)
            files = dict(writer.files)
            writer.write(MANIFEST, json.dumps({"files": files, "sha256": _checksum(files)}).encode())
            for path in {(temporary / name).parent for name in files}:
                _fsync_folder(path)
            temporary.rename(folder)
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
        _fsync_folder(self.directory)
        self.whole = [*self.whole, folder][-KEPT:]
        for old in set(present) - set(self.whole):
            shutil.rmtree(old, ignore_errors=True)
        return folder

    def newest(self) -> Path:
        """
        :return: folder of the newest generation that is whole
        :raises FileNotFoundError: if there is no generation
        :raises DamagedError: if all are damaged
        """
        present = self.generations()
        if not present:
            raise FileNotFoundError(f"There is no checkpoint in {self.directory}")
        for folder in present:
            try:
                check_generation(folder)
            except DamagedError as error:
                damage = error
                warnings.warn(f"{error}: checkpoint {folder} is not used", stacklevel=3)
            else:
                self.whole = [folder]
                return folder
        raise DamagedError(f"All checkpoints in {self.directory} are damaged: {damage}")


def check_generation(folder: Path) -> None:
    """
    :param folder: a generation
    :raises DamagedError: if a file is missing or not what was written
    """
    manifest = folder / MANIFEST
    try:
        content = json.loads(manifest.read_bytes())
        files = content["files"]
        if content["sha256"] != _checksum(files):
            raise ValueError("its checksum is another one")
        records = [(folder / name, int(record["size"]), str(record["sha256"])) for name, record in files.items()]
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise DamagedError(f"{manifest} is damaged ({error})") from error
    for path, size, checksum in records:
        try:
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256") if hasattr(hashlib, "file_digest") else None
                if digest is None:  # Python 3.10
                    file.seek(0)
                    digest = hashlib.sha256(file.read())
        except OSError as error:
            raise DamagedError(f"{path} is damaged ({error})") from error
        if path.stat().st_size != size:
            raise DamagedError(f"{path} is damaged (it has {path.stat().st_size} bytes instead of {size})")
        if digest.hexdigest() != checksum:
            raise DamagedError(f"{path} is damaged (its checksum is another one)")
