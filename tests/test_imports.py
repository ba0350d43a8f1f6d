"""The rooms import one way, and each heavy package has one door."""

import ast
import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = ("sim", "sensors", "dsrc")
MODULES = sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py"))
DOORS = {
    "torch": ("dsrc/",),
    "lightning": ("dsrc/training/",),
    "viser": ("dsrc/review/",),
    "libsumo": ("sim/traffic/sumo/traffic.py",),
    "embreex": ("sensors/raycast/",),
    "numba": ("sensors/raycast/", "dsrc/data/kernel.py", "dsrc/data/formats/lzf.py"),
    "highway_env": ("sim/traffic/highway/traffic",),
}


def imports(path: Path) -> set[str]:
    """Return the top-level names that a module imports anywhere in it."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and node.level == 0:
            found.add(node.module.split(".")[0])
    return found


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_a_room_never_imports_a_later_one(path: Path) -> None:
    room = path.relative_to(ROOT).parts[0]
    later = set(ROOMS[ROOMS.index(room) + 1 :])
    assert not imports(path) & later


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT)))
def test_a_heavy_package_comes_through_its_door(path: Path) -> None:
    name = path.relative_to(ROOT).as_posix()
    for package in imports(path) & set(DOORS):
        assert name.startswith(DOORS[package]), f"{name} imports {package}, only {DOORS[package]} may"


@pytest.mark.parametrize("package", [*ROOMS, "scenarios"])
def test_a_package_name_resolves_to_our_files(package: str) -> None:
    module = importlib.import_module(package)
    assert Path(str(module.__file__)).parents[1] == ROOT
