"""Imported maps hold: with every seed enough cars stay in the area for the agents of a drive.

Networks of SUMO are written by netconvert and netgenerate, OpenDRIVE by scenariogeneration.
"""

import logging
from pathlib import Path

import msgspec
import pytest

from sensors.recording.record import record
from sim.catalog.import_map import import_map
from sim.catalog.load import load_scenario
from sim.errors import ScenarioError
from sim.roads.networks import read_network
from sim.roads.tools import Option, run_tool
from sim.traffic.sumo.routes import candidate_routes
from sim.traffic.sumo.traffic import SumoTraffic

STREET = """<osm version="0.6"><node id="1" lat="52.0000" lon="9.0000"/><node id="2" lat="52.0015" lon="9.0040"/>
<node id="3" lat="52.0020" lon="9.0080"/><way id="10"><nd ref="1"/><nd ref="2"/><nd ref="3"/>
<tag k="highway" v="primary"/><tag k="lanes" v="2"/></way></osm>"""


def road(folder: Path, length_m: float, speed_mps: float = 13.9) -> Path:
    """Write a network of one straight road along x, a lane each way, and no junction."""
    net, nodes, edges = (folder / name for name in ("road.net.xml", "n.nod.xml", "e.edg.xml"))
    nodes.write_text(f'<nodes><node id="a" x="0" y="0"/><node id="b" x="{length_m}" y="0"/></nodes>')
    ends = (("ab", "a", "b"), ("ba", "b", "a"))
    rows = "".join(
        f'<edge id="{name}" from="{start}" to="{end}" numLanes="1" speed="{speed_mps}"/>' for name, start, end in ends
    )
    edges.write_text(f"<edges>{rows}</edges>")
    run_tool("netconvert", {"node-files": str(nodes), "edge-files": str(edges), "output-file": str(net)}, net, "road")
    return net


def grid(folder: Path, **options: Option) -> Path:
    """Write a closed grid of streets: nobody enters it or leaves."""
    net = folder / "grid.net.xml"
    shape: dict[str, Option] = {"grid": True, "grid.number": 4, "grid.length": 80.0, "no-turnarounds": True}
    run_tool("netgenerate", shape | options | {"output-file": str(net)}, net, "grid")
    return net


def holds(folder: Path, seed: int) -> None:
    """Record the first frame of a drive of ten seconds, in a cheap sensor's eyes."""
    scenario = load_scenario(folder)
    agents = msgspec.structs.replace(scenario.agents, lidar="debug-16", roadside=())
    scenario = msgspec.structs.replace(scenario, agents=agents)
    with SumoTraffic(scenario, seed) as traffic:
        recording = record(traffic, None, scenario, seed, frames=100, visibility=False)
    assert len(recording.vehicles) == 3
    assert len(recording.frame(0).agents) == 3


@pytest.mark.parametrize("speed_mps", [13.9, pytest.param(30.0, marks=pytest.mark.slow)])
def test_a_road_without_a_junction_along_an_axis_has_traffic(tmp_path: Path, speed_mps: float) -> None:
    made = import_map(road(tmp_path, 800.0, speed_mps), out=tmp_path / "made", seeds=(1, 2))
    x_min, y_min, x_max, y_max = load_scenario(made).network.area_m or (0.0,) * 4
    assert y_max - y_min > 30.0 and x_max - x_min >= min(20.0 * speed_mps, 800.0)
    holds(made, 2)


@pytest.mark.slow
def test_a_street_alone_of_openstreetmap_is_kept(tmp_path: Path) -> None:
    (tmp_path / "street.osm").write_text(STREET)
    holds(import_map(tmp_path / "street.osm", out=tmp_path / "made", seeds=(1, 2)), 1)


@pytest.mark.slow
def test_trips_begin_and_end_inside_a_closed_town(tmp_path: Path) -> None:
    net = grid(tmp_path)
    routes = candidate_routes(read_network(net), "passenger", None, None)
    used = {edge for route in routes.edges for edge in route}
    assert len(routes.edges) > 500 and len(used) == len(read_network(net).getEdges(False))
    holds(import_map(net, out=tmp_path / "made", seeds=(1, 2)), 1)


def test_one_gate_of_a_closed_town_does_not_take_all_trips(tmp_path: Path) -> None:
    nodes, edges, net = tmp_path / "n.nod.xml", tmp_path / "e.edg.xml", tmp_path / "gate.net.xml"
    nodes.write_text('<nodes><node id="gate" x="-120" y="0"/></nodes>')
    edges.write_text('<edges><edge id="in" from="gate" to="A0"/><edge id="out" from="A0" to="gate"/></edges>')
    more: dict[str, Option] = {"no-turnarounds": True, "output-file": str(net)}
    plain = {"sumo-net-file": str(grid(tmp_path)), "node-files": str(nodes), "edge-files": str(edges)}
    run_tool("netconvert", plain | more, net, "gate")
    routes = candidate_routes(read_network(net), "passenger", None, None)
    assert len(routes.edges) > 500


@pytest.mark.slow
def test_a_road_too_short_for_a_drive_is_seen_by_its_roadside_unit_alone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        made = import_map(road(tmp_path, 90.0), out=tmp_path / "made", seeds=(1,))
    scenario = load_scenario(made)
    assert scenario.agents.vehicles == 0 and len(scenario.agents.roadside) == 1
    assert "the roadside unit is the only agent" in caplog.text


def test_roads_that_carry_no_car_are_told_in_one_line(tmp_path: Path) -> None:
    net = tmp_path / "tram.net.xml"
    text = road(tmp_path, 300.0).read_text().replace(' speed="13.90"', ' allow="tram" speed="13.90"')
    net.write_text(text)
    with pytest.raises(ScenarioError, match=r"tram\.net\.xml: map: expected a road for cars, found none"):
        import_map(net, out=tmp_path / "made")
