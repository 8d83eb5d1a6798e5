"""Imports run one way: common, then environments and algorithms, then what brings them together."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from sb3_chdp.registry import ALGORITHMS as REGISTRY

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / "sb3_chdp"
MODULES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in PACKAGE.rglob("*.py")
}


def imports_of(name):
    """:return: the modules of this package that a module imports, anywhere in it"""
    found = set()
    for node in ast.walk(ast.parse(MODULES[name].read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0 and node.module, f"{name}: imports are absolute"
            # What is imported from a package may be a module of it
            inner = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= (inner & MODULES.keys()) or {node.module}
    return {module for module in found if module in MODULES}


def room_of(module):
    """:return: the folder or file of the package that a module belongs to"""
    return module.split(".")[1] if "." in module else "__init__"


ROOMS = {name: {room_of(module) for module in imports_of(name)} - {room_of(name)} for name in MODULES}
ALGORITHMS = sorted({line.class_path.split(".")[1] for line in REGISTRY.values()})


def imported_by(room):
    """:return: the other rooms that a room imports"""
    return set().union(*(rooms for name, rooms in ROOMS.items() if room_of(name) == room))


def test_there_is_something_to_test():
    assert {"chdp", "hppo", "pa_td3", "pdqn_td3", "hhqn_td3", "hyar_td3"} <= set(ALGORITHMS)
    assert imports_of("sb3_chdp.hppo.hppo") >= {"sb3_chdp.common.base_class", "sb3_chdp.hppo.policies"}


def test_common_imports_nothing_of_the_package():
    assert imported_by("common") == set()


@pytest.mark.parametrize("room", ["envs", "wrappers", *ALGORITHMS])
def test_envs_and_algorithms_import_common_alone(room):
    assert imported_by(room) <= {"common"}


def test_the_checker_imports_common_and_the_wrapper():
    assert imported_by("env_checker") <= {"common", "wrappers"}


def test_no_module_imports_itself_in_the_end():
    graph = {name: imports_of(name) - {name} for name in MODULES}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        raise AssertionError(" -> ".join(error.args[1])) from error
