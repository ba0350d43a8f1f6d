"""Provenance of a result: settings, versions, machine, code and data, for every result file."""

import platform
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sim.machine import installed_versions

PACKAGES = (
    "dsrc-testbed",
    "numpy",
    "torch",
    "lightning",
    "powerboxes",
    "scipy",
    "trimesh",
    "embreex",
    "libsumo",
    "eclipse-sumo",
    "highway-env",
)
"""Packages whose version can change a number."""


def provenance(settings: Mapping[str, Any], seed: int, data: Sequence[Path] = ()) -> dict[str, Any]:
    """Return the provenance of a run; equal runs give equal values.

    Args:
        settings: of the run, JSON types only.
        seed: the root seed.
        data: drives, recorded by their hashes.
    """
    return {
        "settings": dict(settings),
        "seed": seed,
        "versions": versions(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "commit": commit(),
        "data": hashes(data),
    }


def hashes(drives: Sequence[Path]) -> dict[str, str]:
    """Return the hash of each drive by its name, or by its folder's too where drives share a name."""
    from dsrc.data.drives import open_drive

    names = [drive.name for drive in drives]
    return {
        drive.name if names.count(drive.name) == 1 else f"{drive.parent.name}/{drive.name}": open_drive(drive).digest()
        for drive in drives
    }


def versions() -> dict[str, str]:
    """Return the versions of those `PACKAGES` that are installed."""
    return installed_versions(PACKAGES)


def commit(folder: Path | None = None) -> str | None:
    """Return the git commit of the code, with `-dirty` where files differ from it; None outside a repository."""
    folder = Path(__file__).resolve().parents[2] if folder is None else folder
    if not (folder / ".git").exists():
        return None
    command = ["git", "-C", str(folder), "describe", "--always", "--dirty", "--abbrev=40", "--exclude", "*"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None
