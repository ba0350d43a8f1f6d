"""A small net in hilly country: slopes up to 14 %, with bends, a junction and footways."""

import subprocess
from pathlib import Path

import msgspec
import numpy as np
import shapely

from sim.catalog.load import load_scenario
from sim.roads.network import Network
from sim.roads.tools import sumo_home
from sim.scenario import AgentRule, NetworkSpec, RoadsideUnit, Scenario

_NODES = {"a": (0, 0, 410), "b": (150, 0, 422), "c": (300, 40, 414), "d": (150, 160, 440), "e": (290, 170, 432)}
_WAYS = ("ab", "bc", "bd", "de", "ce")


def hilly_scenario(folder: Path, units: tuple[RoadsideUnit, ...] = ()) -> Scenario:
    """Write the net into a folder and return a scenario on it."""
    nodes = "".join(f'<node id="{k}" x="{x}" y="{y}" z="{z}"/>' for k, (x, y, z) in _NODES.items())
    edges = "".join(
        f'<edge id="{p}{q}" from="{p}" to="{q}" numLanes="2" speed="13.9" sidewalkWidth="2"/>'
        for way in _WAYS
        for p, q in (tuple(way), tuple(way[::-1]))
    )
    (folder / "n.nod.xml").write_text(f"<nodes>{nodes}</nodes>")
    (folder / "n.edg.xml").write_text(f"<edges>{edges}</edges>")
    command = [str(sumo_home() / "bin" / "netconvert"), "-n", "n.nod.xml", "-e", "n.edg.xml", "-o", "n.net.xml"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    network = NetworkSpec(file=str(folder / "n.net.xml"))
    return msgspec.structs.replace(load_scenario("four_way"), network=network, agents=AgentRule(roadside=units))


def lane_points(net: Network) -> np.ndarray:
    """Return (N, 3) points along the middles of all lanes of edges but their last metres."""
    lines = [shapely.LineString(lane.getShape3D()) for edge in net.getEdges(False) for lane in edge.getLanes()]
    places = [shapely.line_interpolate_point(line, np.linspace(1.0, line.length - 1.0, 81)) for line in lines]
    return shapely.get_coordinates(np.concatenate(places), include_z=True)
