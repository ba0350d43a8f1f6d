"""Provenance of a result: settings, versions, machine, code and data, for every result file."""

import platform
import subprocess
from collections.abc import Mapping
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


def provenance(settings: Mapping[str, object], seed: int, data: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Return the provenance of a run; equal runs give equal values.

    Args:
        settings: of the run, JSON types only.
        data: hashes of drives by name; None where the settings hold them.
    """
    return {
        "settings": dict(settings),
        "seed": seed,
        "versions": versions(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "commit": commit(),
        **({} if data is None else {"data": dict(data)}),
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
