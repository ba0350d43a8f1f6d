"""Scenarios by name or by file."""

from pathlib import Path
from typing import Any

import msgspec

from sim.catalog.check import wrong_values
from sim.errors import ScenarioError, complaint, did_you_mean
from sim.scenario import CONTROLS, Scenario
from sim.tomlfile import read_toml

ROOT = Path(__file__).resolve().parents[2] / "scenarios"
"""Folder of the shipped scenarios."""


def list_scenarios() -> list[str]:
    """Return the names of the shipped scenarios."""
    return sorted(path.parent.name for path in ROOT.glob("*/scenario.toml"))


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Load a shipped scenario by name, or any scenario by the path of its .toml (or of the folder that holds it).

    A control of a conflict is asked for as `NAME:CONTROL`, such as `ima_building:no_occluder`.

    Raises:
        ScenarioError: the scenario is unknown, or its file is not valid; one line says what and where.
    """
    if isinstance(name_or_path, str) and ":" in name_or_path and not Path(name_or_path).exists():
        return _controlled(name_or_path)
    path = _locate(name_or_path)
    scenario = read_toml(path, Scenario, ScenarioError)
    for field, expected, found, hint in wrong_values(scenario, path):
        raise ScenarioError(complaint(path, field, expected, found, hint))
    network = _beside(scenario.network, ("file", "polygons"), path.parent)
    return msgspec.structs.replace(scenario, network=network, demand=_beside(scenario.demand, ("trips",), path.parent))


def _controlled(name: str) -> Scenario:
    """Return the control NAME:CONTROL of a scenario with a conflict, under a name of its own.

    Raises:
        ScenarioError: there is no such scenario or control.
    """
    base, _, control = name.rpartition(":")
    scenario = load_scenario(base)
    if scenario.conflict is None:
        raise ScenarioError(complaint(name, "scenario", "a control of a conflict", f"'{base}', which has none"))
    if control not in CONTROLS:
        raise ScenarioError(
            complaint(name, "control", "a known control", f"'{control}'", did_you_mean(control, CONTROLS))
        )
    conflict = msgspec.structs.replace(scenario.conflict, control=control)
    return msgspec.structs.replace(scenario, name=f"{scenario.name}-{control}", conflict=conflict)


def _beside(table: Any, names: tuple[str, ...], folder: Path) -> Any:
    """Replace the names of files that lie beside the scenario file by their full paths."""
    named = {name: getattr(table, name) for name in names}
    found = {name: str((folder / value).resolve()) for name, value in named.items() if (folder / value).is_file()}
    return msgspec.structs.replace(table, **found)


def _locate(name_or_path: str | Path) -> Path:
    path = Path(name_or_path)
    if path.is_dir() and (path / "scenario.toml").is_file():
        return path / "scenario.toml"
    if path.suffix == ".toml" or len(path.parts) > 1:
        if not path.is_file():
            raise ScenarioError(complaint(path, "scenario", "an existing .toml file", "no such file"))
        return path
    shipped = ROOT / str(name_or_path) / "scenario.toml"
    if str(name_or_path) in ("", ".", "..") or not shipped.is_file():
        hint = did_you_mean(str(name_or_path), list_scenarios())
        raise ScenarioError(f"unknown scenario '{name_or_path}'{hint}")
    return shipped
