"""Kinds of TOML files and the commands that take them, so that a command names the right one."""

from pathlib import Path
from typing import Literal

Kind = Literal["scenario", "data set", "benchmark", "campaign"]

_KEYS: dict[Kind, set[str]] = {
    "data set": {"split"},
    "benchmark": {"methods", "datasets"},
    "campaign": {"perceptions", "scenarios"},
    "scenario": {"network", "demand", "agents", "conflict"},
}
_COMMANDS: dict[Kind, str] = {
    "scenario": "generate {} --out data",
    "data set": "dataset build {} --out data",
    "benchmark": "benchmark {} --out runs/benchmark",
    "campaign": "drive {} --out runs/drive",
}


def require_kind(command: str, place: str | Path, *kinds: Kind) -> None:
    """Raise SettingsError that names the right command where a name or TOML is of another kind than a command takes."""
    from sim.errors import SettingsError

    found = _kind_of(str(place))
    if found is not None and found not in kinds:
        right = _COMMANDS[found].format(place)
        raise SettingsError(f"{command}: {place} is a {found}, not a {' or '.join(kinds)}; run: dsrc {right}")


def _kind_of(place: str) -> Kind | None:
    """Return the kind of a shipped name, a folder or a TOML; None where it cannot be told."""
    from dsrc.data.datasets.spec import find_split_file
    from sim.catalog.load import list_scenarios
    from sim.errors import DataError
    from sim.settings import read_tables

    path = Path(place)
    if path.suffix != ".toml" or not path.is_file():
        if find_split_file(place) is not None:
            return "data set"
        return "scenario" if place in list_scenarios() else None
    try:
        fields = read_tables(path, DataError).keys()
    except DataError:
        return None  # told by who reads it
    return next((kind for kind, keys in _KEYS.items() if fields & keys), None)
