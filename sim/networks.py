"""Road networks: those shipped in the eclipse-sumo package, made by netgenerate, or a user's own file."""

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from functools import lru_cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sim.errors import ScenarioError, complaint
from sim.scenario import Scenario


@lru_cache(maxsize=1)
def sumo_home() -> Path:
    """Return the folder of the installed eclipse-sumo package."""
    spec = find_spec("sumo")
    if spec is None or not spec.submodule_search_locations:
        raise ScenarioError("the package eclipse-sumo is not installed; run: pip install eclipse-sumo")
    return Path(next(iter(spec.submodule_search_locations)))


def sumo_tools() -> Path:
    """Return the `tools` folder of eclipse-sumo, which holds real networks and a city mesh."""
    return sumo_home() / "tools"


def cache_folder() -> Path:
    """Return the folder of generated networks: $DSRC_CACHE, else dsrc-testbed in the user's cache."""
    base = os.environ.get("DSRC_CACHE")
    if base:
        return Path(base)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dsrc-testbed"


def resolve_network(scenario: Scenario, seed: int) -> Path:
    """Return the .net.xml(.gz) file of a scenario, generating it into the cache when it is not there yet.

    Args:
        scenario: names the network.
        seed: for the random options of netgenerate; real networks do not depend on it.

    Raises:
        ScenarioError: the file is missing or netgenerate refuses its options.
    """
    network = scenario.network
    if network.generate:
        return _generate(scenario.name, network.generate, seed)
    path = sumo_tools() / network.shipped if network.shipped else Path(network.file)
    if not path.is_file():
        field = "network.shipped" if network.shipped else "network.file"
        raise ScenarioError(complaint(scenario.name, field, "an existing network file", str(path)))
    return path


def read_network(path: Path | str) -> Any:
    """Read a network with its internal (junction) lanes; the last few are kept in memory.

    Returns:
        `sumolib.net.Net`; coordinates are SUMO's, which are ours: x east, y north, m.

    Raises:
        ScenarioError: the file is missing or not a SUMO network.
    """
    return _read(str(path), os.stat(path).st_mtime_ns if Path(path).is_file() else 0)


@lru_cache(maxsize=4)
def _read(path: str, _changed_ns: int) -> Any:
    import sumolib

    try:
        net = sumolib.net.readNet(path, withInternal=True)
    except Exception as error:  # sumolib passes on whatever its XML reader raises
        raise ScenarioError(f"{path}: not a readable SUMO network: {' '.join(str(error).split())}") from None
    if not net.getEdges():
        raise ScenarioError(complaint(path, "network", "at least one edge", "none"))
    return net


def _generate(name: str, options: dict[str, str | int | float | bool], seed: int) -> Path:
    """Run netgenerate once per set of options and seed; other processes may do the same at the same time."""
    arguments = []
    for option, value in sorted(options.items()):
        text = str(value).lower() if isinstance(value, bool) else str(value)
        arguments += [f"--{option}={text}"]
    arguments += [f"--seed={seed % 2**31}", "--no-warnings=true"]  # an int of netgenerate
    binary = sumo_home() / "bin" / ("netgenerate.exe" if sys.platform == "win32" else "netgenerate")
    key = hashlib.sha256(json.dumps([arguments, version("eclipse-sumo")]).encode()).hexdigest()[:16]
    folder = cache_folder() / "networks"
    target = folder / f"{name}-{key}.net.xml"
    if target.is_file():
        return target
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as work:
        made = Path(work) / "made.net.xml"
        done = subprocess.run(
            [str(binary), *arguments, "--output-file", str(made)], capture_output=True, text=True, check=False
        )
        if done.returncode != 0 or not made.is_file():
            _, error, reason = done.stderr.partition("Error: ")
            reason = " ".join(reason.removesuffix("Quitting (on error).\n").split()) if error else "no network came out"
            raise ScenarioError(f"{name}: network.generate: netgenerate refuses the options: {reason}")
        text = made.read_text(encoding="utf-8")
        # The header comment holds the date and paths of this run: without it the bytes depend on the options only.
        start, end = text.find("<!--"), text.find("-->")
        made.write_text(text[:start] + text[end + 3 :].lstrip() if 0 <= start < end else text, encoding="utf-8")
        os.replace(made, target)
    return target
