"""Registry of values by name: built in, registered, or entry points of other packages."""

import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from sim.catalog import registry as module
from sim.catalog.registry import Registry, import_path, instance_of
from sim.errors import SettingsError

PLUGIN = """
from tests.sim.catalog.test_registry import HEIGHTS
TOWER = 30.0
HEIGHTS[0].register("tower", TOWER)
NAME = "a word"
"""
HEIGHTS: list[Registry[float]] = []
"""The registry of a test, where a plugin finds it."""


@pytest.fixture
def heights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Registry[float]:
    """Registry of one built-in value and three entry points of a package: one right, two broken."""
    (tmp_path / "heights_plugin.py").write_text(PLUGIN)
    names = {"tower": "TOWER", "shed": "SHED", "word": "NAME", "house": "TOWER"}
    points = [EntryPoint(name, f"heights_plugin:{value}", "test.heights") for name, value in names.items()]
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "heights_plugin", raising=False)
    monkeypatch.setattr(module, "entry_points", lambda group: points if group == "test.heights" else [])
    HEIGHTS[:] = [Registry("test.heights", {"house": 8.0}, instance_of(float))]
    return HEIGHTS[0]


def test_an_entry_point_is_imported_when_its_name_is_first_used(heights: Registry[float]) -> None:
    assert list(heights) == ["house", "tower", "shed", "word"] and len(heights) == 4
    assert "shed" in heights and "hut" not in heights and "heights_plugin" not in sys.modules
    assert heights["tower"] == 30.0  # its module registers it too
    assert "heights_plugin" in sys.modules


def test_what_is_built_in_comes_before_an_entry_point(heights: Registry[float]) -> None:
    assert heights["house"] == 8.0
    with pytest.raises(KeyError):
        heights["hut"]


def test_a_broken_entry_point_is_one_line_each_time(heights: Registry[float]) -> None:
    for _ in range(2):
        with pytest.raises(SettingsError, match=r"^entry point test\.heights: shed: .* found AttributeError: [^\n]*$"):
            heights["shed"]
        with pytest.raises(SettingsError, match=r"word: .* TypeError: expected a float, found str"):
            heights["word"]


@pytest.mark.parametrize("name", ["house", "tower"])
def test_a_name_belongs_to_one_value(heights: Registry[float], name: str) -> None:
    heights.register("mast", 20.0)
    heights.register("mast", 20.0)
    assert heights["mast"] == 20.0
    with pytest.raises(SettingsError, match=f"name: expected a new one, found '{name}', which is registered"):
        heights.register(name, 9.0)
    heights.remove("mast")
    assert "mast" not in heights


def test_a_class_of_a_cell_that_runs_again_replaces_itself() -> None:
    def cell() -> type:
        class Mine:
            pass

        return Mine

    classes: Registry[type] = Registry("test.classes", {}, instance_of(type), key=import_path)
    for made in (cell(), cell()):
        classes.register("mine", made)
        assert classes["mine"] is made
    with pytest.raises(SettingsError, match="'mine', which is registered"):
        classes.register("mine", int)
