"""Scenario loading, by name or by file: shipped, registered or anywhere on disk.

A scenario of another package is an entry point of the group `dsrc.scenarios` that names a path,

    [project.entry-points."dsrc.scenarios"]
    my_town = "my_package:MY_TOWN"  # MY_TOWN = Path(__file__).parent / "my_town", a folder with a scenario.toml

and is found by every command and worker process.
"""

import os
from pathlib import Path
from typing import Any

import msgspec

from sim.catalog.check import wrong_values
from sim.catalog.registry import Registry
from sim.errors import ScenarioError, SettingsError, complaint, did_you_mean
from sim.scenario import CONTROLS, TRAFFIC_LEVELS, Scenario
from sim.settings import read_toml

ROOT = Path(__file__).resolve().parents[2] / "scenarios"
"""Folder of the shipped scenarios."""

_REGISTERED: Registry[Path] = Registry("dsrc.scenarios", {}, lambda value: _toml(Path(os.fspath(value))))
"""Paths of scenario files by name."""


def list_scenarios() -> list[str]:
    """Return the names of the shipped and registered scenarios, sorted."""
    return sorted({path.parent.name for path in ROOT.glob("*/scenario.toml")} | set(_REGISTERED))


def register_scenario(path: str | Path) -> Scenario:
    """Add a scenario, which every function and command then takes by its name, in this process.

    Worker processes find it by an entry point of the group `dsrc.scenarios`.
    `sensors.recording.scenario_check.check_scenario` tests it.

    Args:
        path: a scenario.toml, or the folder that holds it.

    Returns:
        The scenario; its `name` is the one it is registered by.

    Raises:
        ScenarioError: the file is missing or not valid.
        SettingsError: the name is that of another scenario.
    """
    file = _toml(Path(path)).resolve()
    scenario = load_scenario(file)
    if (ROOT / scenario.name / "scenario.toml").is_file():
        raise SettingsError(complaint("dsrc.scenarios", "name", "a new one", f"'{scenario.name}', which is shipped"))
    _REGISTERED.register(scenario.name, file)
    return scenario


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Load a scenario by its name, or by the path of its .toml or of the folder that holds it.

    `NAME:CONTROL` is an encounter under a control condition, such as `ima_building:no_occluder`, `NAME:light` or
    `NAME:dense` one with background traffic; `NAME:dense:no_occluder` is both.

    Raises:
        ScenarioError: the scenario is unknown or its file invalid.
    """
    if isinstance(name_or_path, str) and ":" in name_or_path and not Path(name_or_path).exists():
        return _varied(name_or_path)
    path = _locate(name_or_path)
    scenario = read_toml(path, Scenario, ScenarioError)
    for field, expected, found, hint in wrong_values(scenario, path):
        raise ScenarioError(complaint(path, field, expected, found, hint))
    network = _beside(scenario.network, ("file", "polygons"), path.parent)
    return msgspec.structs.replace(scenario, network=network, demand=_beside(scenario.demand, ("trips",), path.parent))


def scenarios_in(name: str) -> list[str]:
    """Return the scenarios in the folders of a folder, sorted; a name or path that is no such folder stands for itself.

    `FOLDER:VARIANT` gives that variant of each.
    """
    folder, colon, variant = (name, "", "") if Path(name).exists() else name.partition(":")
    path = Path(folder)
    inside = sorted(path.glob("*/scenario.toml")) if not (path / "scenario.toml").is_file() else []
    if (ROOT / folder / "scenario.toml").is_file():
        return [name]
    return [f"{file.parent}{colon}{variant}" for file in inside] or [name]


def _varied(name: str) -> Scenario:
    """Return the encounter NAME:CONTROL or NAME:TRAFFIC, renamed accordingly.

    Raises:
        ScenarioError: the scenario, control or level of traffic is unknown.
    """
    base, _, variant = name.rpartition(":")
    scenario = load_scenario(base)
    if scenario.conflict is None:
        raise ScenarioError(complaint(name, "scenario", "a variant of an encounter", f"'{base}', which is none"))
    known = (*CONTROLS, *TRAFFIC_LEVELS)
    if variant not in known:
        expected = "a known control or level of traffic"
        raise ScenarioError(complaint(name, "variant", expected, f"'{variant}'", did_you_mean(variant, known)))
    field = "traffic" if variant in TRAFFIC_LEVELS else "control"
    before = getattr(scenario.conflict, field)
    if before not in ("", "none", msgspec.UNSET):
        raise ScenarioError(complaint(name, field, "one", f"'{before}' and '{variant}'"))
    conflict = msgspec.structs.replace(scenario.conflict, **{field: variant})
    return msgspec.structs.replace(scenario, name=f"{scenario.name}-{variant}", conflict=conflict)


def _beside(table: Any, names: tuple[str, ...], folder: Path) -> Any:
    """Replace names of files beside the scenario file by their full paths."""
    named = {name: getattr(table, name) for name in names}
    found = {name: str((folder / value).resolve()) for name, value in named.items() if (folder / value).is_file()}
    return msgspec.structs.replace(table, **found)


def _locate(name_or_path: str | Path) -> Path:
    path, name = Path(name_or_path), str(name_or_path)
    if (path / "scenario.toml").is_file() or path.suffix == ".toml" or len(path.parts) > 1:
        return _toml(path)
    shipped = ROOT / name / "scenario.toml"
    if name not in ("", ".", "..") and shipped.is_file():
        return shipped
    if name not in _REGISTERED:
        if path.is_dir():
            return _toml(path)
        raise ScenarioError(f"unknown scenario '{name_or_path}'{did_you_mean(name, list_scenarios())}")
    return _REGISTERED[name]


def _toml(path: Path) -> Path:
    """Return the scenario file at a path, or in the folder at a path."""
    file = path / "scenario.toml" if (path / "scenario.toml").is_file() else path
    if file.is_dir():
        expected = "a folder with a scenario.toml (dsrc drive: or with folders that have one)"
        raise ScenarioError(complaint(path, "scenario", expected, "one without"))
    if not file.is_file():
        raise ScenarioError(complaint(path, "scenario", "an existing .toml file", "no such file"))
    return file
