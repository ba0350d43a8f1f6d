"""The rooms import one way, without circles, and each heavy package has one door."""

import ast
import importlib
import re
from collections import defaultdict
from functools import lru_cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from tests.paths import ROOT

ROOMS = ("sim", "sensors", "dsrc")
MODULES = {
    path.relative_to(ROOT).with_suffix("").as_posix().removesuffix("/__init__").replace("/", "."): path
    for room in ROOMS
    for path in sorted((ROOT / room).rglob("*.py"))
}
DOORS = {
    "torch": (
        "dsrc/ops/coding.py",
        "dsrc/models/",
        "dsrc/training/",
        "dsrc/evaluation/",
        "dsrc/review/",
        "dsrc/closed_loop/",
    ),
    "lightning": ("dsrc/training/",),
    "viser": ("dsrc/review/",),
    "libsumo": ("sim/traffic/sumo/traffic.py",),
    "embreex": ("sensors/raycast/",),
    "numba": (
        "sensors/compiled.py",
        "sensors/raycast/fused/",
        "dsrc/data/formats/",
    ),
    "highway_env": ("sim/traffic/highway/", "dsrc/closed_loop/environments/"),
}
FULL = {
    "sensors/corruptions": "one file per kind of corruption",
    "dsrc/models/fusion": "one file per method",
}
"""Folders of more than a dozen modules, and why."""


@lru_cache(maxsize=1)
def imported() -> dict[str, dict[str, set[str]]]:
    """Return for each module the modules of ours and the top-level names of others that it imports anywhere in it."""
    found: dict[str, dict[str, set[str]]] = {}
    for name, path in MODULES.items():
        ours, others = set(), set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
                whole = [f"{node.module}.{alias.name}" for alias in node.names]
                names = [child if child in MODULES else node.module for child in whole]
            if isinstance(node, ast.Call):
                names = named(node)
            for each in names:
                if each.split(".")[0] in ROOMS:
                    ours.add(each)
                else:
                    others.add(each.split(".")[0])
        found[name] = {"ours": ours, "others": others}
    return found


def named(call: ast.Call) -> list[str]:
    """Return the module that `import_module` is given as text; the command line's table, an f-string, is data."""
    of_text = ast.unparse(call.func).endswith("import_module") and isinstance(call.args[0], ast.Constant)
    return [str(ast.literal_eval(call.args[0]))] if of_text else []


def circle(edges: dict[str, set[str]]) -> list[str]:
    """Return the names around a circle of a graph, none where there is no circle."""
    try:
        TopologicalSorter(edges).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_a_room_never_imports_a_later_one() -> None:
    for name, path in MODULES.items():
        room = name.split(".")[0]
        later = set(ROOMS[ROOMS.index(room) + 1 :])
        assert not {other.split(".")[0] for other in imported()[name]["ours"]} & later, path


def test_no_product_and_no_example_needs_the_studies() -> None:
    outside = {"studies", "examples", "benchmarks", "tests"}
    assert {name: found["others"] & outside for name, found in imported().items() if found["others"] & outside} == {}
    for example in (ROOT / "examples").glob("*.py"):
        assert not re.search(r"^\s*(from|import) (studies|benchmarks|tests)\b", example.read_text(), re.MULTILINE), (
            example
        )


def test_a_heavy_package_comes_through_its_door() -> None:
    for name, path in MODULES.items():
        place = path.relative_to(ROOT).as_posix()
        for package in imported()[name]["others"] & set(DOORS):
            assert place.startswith(DOORS[package]), f"{place} imports {package}, only {DOORS[package]} may"


def test_dsrc_sensors_holds_what_its_modules_import() -> None:
    tree = ast.parse((ROOT / "packaging/sensors/hatch_build.py").read_text())
    (held,) = (ast.literal_eval(node.value) for node in tree.body if isinstance(node, ast.Assign))
    place = {name: path.relative_to(ROOT).as_posix() for name, path in MODULES.items()}
    for name, found in imported().items():
        if name != "dsrc" and place[name].startswith(held):  # dsrc itself imports by name, when asked
            assert {other for other in found["ours"] if not place[other].startswith(held)} == set(), name


def test_an_import_by_text_is_an_import() -> None:
    for text in ("import_module('sim.boxes')", "importlib.import_module('sim.boxes').CLASSES"):
        calls = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.Call)]
        assert [name for call in calls for name in named(call)] == ["sim.boxes"]


def test_files_import_each_other_without_circles() -> None:
    assert circle({name: found["ours"] - {name} for name, found in imported().items()}) == []


def test_what_stands_in_one_folder_imports_each_other_without_circles() -> None:
    """Files and folders side by side: a circle of packages at any depth is one between two of them."""
    side_by_side: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for name, found in imported().items():
        here = name.split(".")
        for other in found["ours"] - {name}:
            there = other.split(".")
            same = next((i for i, pair in enumerate(zip(here, there, strict=False)) if pair[0] != pair[1]), None)
            if same is not None:  # else one is the folder of the other
                side_by_side[".".join(here[:same])][here[same]].add(there[same])
    for folder, edges in side_by_side.items():
        assert circle(edges) == [], folder


def test_a_folder_has_about_a_dozen_modules_or_a_reason() -> None:
    count: dict[str, int] = defaultdict(int)
    for path in MODULES.values():
        if path.name not in ("__init__.py", "__main__.py"):
            count[path.parent.relative_to(ROOT).as_posix()] += 1
    many = {folder for folder, files in count.items() if files > 13}
    assert many == set(FULL)


@pytest.mark.parametrize("package", [*ROOMS, "scenarios"])
def test_a_package_name_resolves_to_our_files(package: str) -> None:
    module = importlib.import_module(package)
    assert Path(str(module.__file__)).parents[1] == ROOT
