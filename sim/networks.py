"""Road networks: those shipped in the eclipse-sumo package, made by netgenerate, or a user's own file."""

import hashlib
import json
import os
import tempfile
from collections.abc import Callable
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sim.errors import ScenarioError, complaint
from sim.places.rounding import rounded_network
from sim.places.tools import Option, drop_header, run_tool, sumo_home
from sim.scenario import Scenario

__all__ = ["cache_folder", "read_network", "resolve_network", "sumo_home", "sumo_tools"]

ROUND: dict[str, Option] = {
    "junctions.internal-link-detail": 20,
    "junctions.limit-turn-speed": 3.5,
    "junctions.limit-turn-speed.min-angle": 5,
    "offset.disable-normalization": True,
    "no-warnings": True,
}
"""How netconvert builds the junctions of a network anew: smooth lanes, on which nobody feels more than 3.5 m/s2."""


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
    """Return the .net.xml(.gz) file of a scenario, making it in the cache when it is not there yet.

    Args:
        scenario: names the network.
        seed: for the random options of netgenerate; real networks do not depend on it.

    Raises:
        ScenarioError: the file is missing, or netgenerate or netconvert refuses it.
    """
    network = scenario.network
    if scenario.conflict is not None and not (network.shipped or network.generate or network.file):
        return _of_conflict(scenario, seed)
    if network.generate:
        return _generate(scenario.name, network.generate, seed)
    path = sumo_tools() / network.shipped if network.shipped else Path(network.file)
    if not path.is_file():
        field = "network.shipped" if network.shipped else "network.file"
        raise ScenarioError(complaint(scenario.name, field, "an existing network file", str(path)))
    return _round(path) if network.round else path


def _of_conflict(scenario: Scenario, seed: int) -> Path:
    from sim.conflicts import instance_of  # its modules read networks themselves
    from sim.conflicts.roads import write_roads

    roads = instance_of(scenario, seed).layout.roads
    if roads is None:
        raise ScenarioError(complaint(scenario.name, "network", "one of shipped, generate, file", "none of them"))
    return write_roads(scenario.name, roads)


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


def _generate(name: str, options: dict[str, Option], seed: int) -> Path:
    options = {**dict(sorted(options.items())), "seed": seed % 2**31, "no-warnings": True}  # an int of netgenerate

    def make(made: Path) -> None:
        run_tool("netgenerate", options | {"output-file": str(made)}, made, f"{name}: network.generate")
        drop_header(made)

    return cached("networks", name, ".net.xml", [list(options.items())], make)


def _round(path: Path) -> Path:
    """Build the junctions of a network anew and round the bends of its streets."""

    def make(made: Path) -> None:
        run_tool("netconvert", {"sumo-net-file": str(path), "output-file": str(made)} | ROUND, made, str(path))
        drop_header(made)
        made.write_text(rounded_network(made.read_text(encoding="utf-8")), encoding="utf-8")

    content = hashlib.sha256(path.read_bytes()).hexdigest()
    return cached("networks", path.name.split(".")[0], ".net.xml", [content, list(ROUND.items())], make)


def cached(kind: str, name: str, ending: str, key: object, make: Callable[[Path], None]) -> Path:
    """Return a file of the cache, made once per key; other processes may make it at the same time.

    Args:
        kind: folder of the cache.
        name: begins the name of the file.
        ending: of its name.
        key: everything that its content depends on, but for the version of eclipse-sumo, which is added.
        make: writes the file at the path that it is given.
    """
    digest = hashlib.sha256(json.dumps([key, version("eclipse-sumo")]).encode()).hexdigest()[:16]
    folder = cache_folder() / kind
    target = folder / f"{name}-{digest}{ending}"
    if target.is_file():
        return target
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as work:
        made = Path(work) / f"made{ending}"
        make(made)
        os.replace(made, target)
    return target
