"""Zips of models and policies that load without running any code of theirs."""

import io
import json
import pathlib
import re
import zipfile
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.save_util import json_to_data, open_path
from stable_baselines3.common.utils import get_device

from sb3_chdp.common.serialization import NotSerializable, decode, encode, qualified_name

PathOrFile = str | pathlib.Path | io.BufferedIOBase

# Entry of a zip that names its class and the version of this package
HEADER = "sb3_chdp.json"
VERSION = (pathlib.Path(__file__).parents[1] / "version.txt").read_text().strip()
# First version whose files this one reads; to be set to the present one when networks or arguments change
OLDEST_VERSION = "0.2.0"
# Files from before there was a header
NO_VERSION = "0.1.0 or earlier, or another library"


class Header(NamedTuple):
    """
    What the file says of itself.

    :ivar classes: names of the class of the object and of its base classes
    :ivar version: version of this package
    """

    classes: list[str]
    version: str


def make_header(obj: Any) -> str:
    """:return: JSON for the entry ``HEADER``"""
    return json.dumps({"class": [qualified_name(kind) for kind in type(obj).__mro__[:-1]], "version": VERSION}, indent=1)


def _release(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3])


def read_header(archive: zipfile.ZipFile, cls: type, name: Any) -> Header | None:
    """
    Check what a file says of itself, before anything else of it is read.

    :param archive: the file
    :param cls: class that is to be loaded
    :param name: what messages call the file
    :return: class and version, None if it has no header
    :raises ValueError: if the file is of another class, or of a version that this one does not read
    """
    if HEADER not in archive.namelist():
        return None
    try:
        content = json.loads(archive.read(HEADER))
        header = Header([str(content["class"][0]), *map(str, content["class"][1:])], str(content["version"]))
    except (ValueError, LookupError, TypeError) as error:
        raise ValueError(f"{name} is damaged: its entry {HEADER} does not name class and version") from error
    own = [qualified_name(kind) for kind in cls.__mro__]
    if qualified_name(cls) not in header.classes and header.classes[0] not in own:
        raise ValueError(f"{name} is not a {cls.__name__}: it holds a {header.classes[0]}")
    if _release(header.version) < _release(OLDEST_VERSION):
        raise ValueError(
            f"{name} was saved by sb3_chdp {header.version}, and sb3_chdp {VERSION} reads files of {OLDEST_VERSION} or later"
        )
    return header


def is_path(path: PathOrFile) -> bool:
    """:return: whether it names a file, and is not an open one"""
    return isinstance(path, (str, pathlib.Path))


def refuse(name: Any, what: str) -> ValueError:
    """:return: the error for a file that cannot be read without running code"""
    return ValueError(
        f"{name} {what}. Loading that runs whatever code is in the file: give trusted=True if you know where it comes from"
    )


def read_bytes(path: PathOrFile) -> tuple[io.BytesIO, Any]:
    """:return: the file, read once so that it cannot change while it is checked, and what messages call it"""
    file = open_path(path, "r", suffix="zip")
    try:
        content = file.read()
        if not content and file.seekable():
            # Just written; SB3 reads from the beginning, too
            file.seek(0)
            content = file.read()
        return io.BytesIO(content), path if is_path(path) else "The file"
    finally:
        if is_path(path):
            file.close()


def write_bytes(content: bytes, path: PathOrFile, suffix: str | None = None) -> None:
    """Write a file, SB3's way: folders are made, the suffix is appended if there is none."""
    file = open_path(path, "w", suffix=suffix)
    file.write(content)
    if is_path(path):
        file.close()


def save_model(sb3_zip: io.BytesIO, model: Any, path: PathOrFile) -> None:
    """
    Write a model whose zip SB3 has made, with JSON in place of pickles wherever possible.

    :param sb3_zip: what SB3's ``save`` wrote
    :param model: the model
    :param path: where to
    """
    made = io.BytesIO()
    with zipfile.ZipFile(sb3_zip) as old, zipfile.ZipFile(made, "w") as new:
        new.writestr(HEADER, make_header(model))
        for entry in old.infolist():
            content = old.read(entry)
            if entry.filename == "data":
                data = json.loads(content)
                for key in _pickled(data):
                    try:
                        data[key] = encode(vars(model)[key])
                    except NotSerializable:
                        continue  # stays as SB3 has it
                content = json.dumps(data, indent=4).encode()
            new.writestr(entry, content)
    write_bytes(made.getvalue(), path, "zip")


def _pickled(data: dict[str, Any]) -> list[str]:
    """:return: keys of the items that SB3 has pickled"""
    return [key for key, item in data.items() if isinstance(item, dict) and ":serialized:" in item]


def read_model(
    cls: Any, path: PathOrFile, custom_objects: dict[str, Any] | None, trusted: bool
) -> tuple[io.BytesIO, dict[str, Any], str]:
    """
    Check a model's zip, and read what SB3's ``load`` would unpickle.

    :param cls: algorithm that is to be loaded
    :param path: the zip
    :param custom_objects: see SB3's ``load``; what is given here is not read
    :param trusted: whether pickles may be read
    :return: the file, and the ``custom_objects`` with which SB3's ``load`` finds nothing to unpickle in it if it is not
        trusted; the version that saved it
    :raises ValueError: if it is no zip, of another class or version, or has pickles and is not trusted
    """
    file, name = read_bytes(path)
    custom_objects = dict(custom_objects or {})
    try:
        archive = zipfile.ZipFile(file)
    except zipfile.BadZipFile as error:
        raise ValueError(f"{name} is not a zip file") from error
    with archive:
        header = read_header(archive, cls, name)
        if "data" not in archive.namelist():
            raise ValueError(f"{name} is not a {cls.__name__}: it has no entry 'data'")
        data = json.loads(archive.read("data"))
    if header is None:
        _check_policy_module(cls, data, name)
    elif header.classes[0].startswith("sb3_chdp.") and header.classes[0] not in map(qualified_name, cls.__mro__):
        # PaperCHDP is a CHDP, but its rows and networks are others; what users derive from an algorithm it loads
        raise ValueError(f"{name} is not a {cls.__name__}: it holds a {header.classes[0]}")
    # An environment by name could be one whose module Gymnasium imports
    needs_trust = [*_pickled(data), *(["env"] if isinstance(data.get("env"), str) else [])]
    pickled = [key for key in needs_trust if key not in custom_objects]
    if pickled and not trusted:
        if header is None:
            raise refuse(name, f"was saved by sb3_chdp {NO_VERSION}, in pickled form")
        raise refuse(name, f"holds {', '.join(pickled)} in pickled form")
    for key, item in data.items():
        if key not in custom_objects and key not in pickled:
            custom_objects[key] = decode(item)
    if "policy_class" in pickled:
        custom_objects |= json_to_data(json.dumps({"policy_class": data["policy_class"]}))
    accepted = tuple(cls.policy_aliases.values())
    policy = custom_objects.get("policy_class")
    if not (isinstance(policy, type) and issubclass(policy, accepted)):
        raise ValueError(f"{name} is not a {cls.__name__} model: its policy is {policy}, not one of {accepted}")
    file.seek(0)
    return file, custom_objects, header.version if header else NO_VERSION


def _check_policy_module(cls: Any, data: dict[str, Any], name: Any) -> None:
    """Tell another algorithm's zip by what SB3 wrote about its policy in plain text."""
    entry = data.get("policy_class")
    module = entry.get("__module__") if isinstance(entry, dict) else None
    accepted = {policy.__module__ for policy in cls.policy_aliases.values()}
    if str(module).startswith(("sb3_chdp.", "stable_baselines3.", "sb3_contrib.")) and module not in accepted:
        raise ValueError(f"{name} is not a {cls.__name__} model: its policy is of {module}")


def misfit(path: Any, version: str, error: Exception, changes: dict[str, Any]) -> ValueError:
    """:return: the error for a file of another version, or loaded with other arguments, that does not fit"""
    reason = str(error).strip().partition("\n")[0]
    if version == VERSION:
        return ValueError(f"{path} was not loaded with {', '.join(changes)}: {type(error).__name__}: {reason}")
    return ValueError(f"{path} was saved by sb3_chdp {version} and does not fit sb3_chdp {VERSION}: {reason}")


def save_policy(policy: Any, path: PathOrFile) -> bool:
    """
    :param policy: a policy
    :param path: where to write it to
    :return: whether it was written; not if its arguments can only be pickled
    """
    try:
        data = encode(policy._get_constructor_parameters())
    except NotSerializable:
        return False
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        archive.writestr(HEADER, make_header(policy))
        archive.writestr("data", json.dumps(data, indent=4))
        with archive.open("policy.pth", "w", force_zip64=True) as file:
            th.save(policy.state_dict(), file)
    write_bytes(made.getvalue(), path)
    return True


def load_policy(cls: Any, path: PathOrFile, device: th.device | str) -> Any:
    """
    :param cls: class of the policy
    :param path: the file
    :param device: where to put the policy
    :return: the policy, None if the file was not written by :func:`save_policy`
    :raises ValueError: for a policy of another class or version
    """
    file, name = read_bytes(path)
    if not zipfile.is_zipfile(file):
        return None
    with zipfile.ZipFile(file) as archive:
        header = read_header(archive, cls, name)
        if header is None:
            return None
        arguments = decode(json.loads(archive.read("data")))
        state_dict = th.load(io.BytesIO(archive.read("policy.pth")), map_location="cpu", weights_only=True)
    policy = cls(**arguments)
    try:
        policy.load_state_dict(state_dict)
    except RuntimeError as error:
        raise ValueError(f"{name} is not a {cls.__name__}: it holds a {header.classes[0]}") from error
    return policy.to(get_device(device))
