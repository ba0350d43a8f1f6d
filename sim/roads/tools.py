"""Command-line tools of eclipse-sumo: netconvert, netgenerate, polyconvert."""

import os
import subprocess
import sys
from collections.abc import Mapping
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

from sim.errors import ScenarioError, one_line

Option = str | int | float | bool

_MOST_S = 600.0
"""Longest run of a program, s: some files keep netconvert busy for ever."""


@lru_cache(maxsize=1)
def sumo_home() -> Path:
    """Return the folder of the installed eclipse-sumo package.

    Raises:
        ScenarioError: it is not installed.
    """
    spec = find_spec("sumo")
    if spec is None or not spec.submodule_search_locations:
        raise ScenarioError("the package eclipse-sumo is not installed; run: pip install eclipse-sumo")
    return Path(next(iter(spec.submodule_search_locations)))


def sumo_tools() -> Path:
    """Return the `tools` folder of eclipse-sumo, which holds real networks and a city mesh."""
    return sumo_home() / "tools"


def run_tool(name: str, options: Mapping[str, Option], made: Path, what: str) -> None:
    """Run netconvert, netgenerate or polyconvert.

    Args:
        what: begins the error message, such as the file to convert.

    Raises:
        ScenarioError: the program fails or does not end; the message holds its output.
    """
    binary = sumo_home() / "bin" / (f"{name}.exe" if sys.platform == "win32" else name)
    arguments = [
        f"--{key}={str(value).lower() if isinstance(value, bool) else value}" for key, value in options.items()
    ]
    # Without it the programs search for projections elsewhere and warn.
    places = {"PROJ_DATA": str(sumo_home() / "data" / "proj")}
    try:
        done = subprocess.run(
            [str(binary), *arguments],
            capture_output=True,
            text=True,
            errors="replace",
            check=False,
            env=os.environ | places,
            timeout=_MOST_S,
        )
    except subprocess.TimeoutExpired:
        raise ScenarioError(f"{what}: {name} has not ended after {_MOST_S:g} s") from None
    if done.returncode != 0 or not made.is_file():
        _, error, reason = done.stderr.partition("Error: ")
        reason = reason.replace("Quitting (on error).", "") if error else "nothing came out"
        raise ScenarioError(f"{what}: {name} refuses it: {one_line(reason, 300)}")


def drop_header(path: Path) -> None:
    """Remove the comment with date and paths from a made file: its bytes depend on options only."""
    text = path.read_text(encoding="utf-8")
    start, end = text.find("<!--"), text.find("-->")
    if 0 <= start < end:
        path.write_text(text[:start] + text[end + 3 :].lstrip(), encoding="utf-8")
