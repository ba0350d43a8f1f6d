"""Recorded demand: files as SUMO's own tools write them, and after its documentation."""

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from sim.errors import ScenarioError
from sim.roads.tools import run_tool, sumo_home, sumo_tools
from sim.traffic.sumo.trips import read_trips


@pytest.fixture(scope="module")
def net(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("grid") / "grid.net.xml"
    run_tool("netgenerate", {"grid": True, "grid.number": 3, "output-file": str(made)}, made, "grid")
    return made


def random_trips(net: Path, out: Path, *options: str) -> Path:
    """Write demand by SUMO's randomTrips.py."""
    tool = sumo_tools() / "randomTrips.py"
    command = [sys.executable, str(tool), "-n", str(net), "-o", str(out), "-e", "60", "--seed", "1", *options]
    # With --persons it leaves routes.rou.xml where it runs.
    environment = os.environ | {"SUMO_HOME": str(sumo_home())}
    subprocess.run(command, check=True, capture_output=True, env=environment, cwd=out.parent)
    return out


def test_trips_and_their_routes_of_sumos_tools_are_the_same_trips(net: Path, tmp_path: Path) -> None:
    trips, routes = random_trips(net, tmp_path / "t.xml"), tmp_path / "r.rou.xml"
    run_tool("duarouter", {"net-file": str(net), "route-files": str(trips), "output-file": str(routes)}, routes, "grid")
    asked, driven = read_trips(trips), read_trips(routes)
    assert len(asked) == len(driven) == 60
    assert not any(trip.is_route for trip in asked) and all(trip.is_route for trip in driven)
    ends = [{(trip.depart_s, trip.edges[0], trip.edges[-1]) for trip in one} for one in (asked, driven)]
    assert ends[0] == ends[1]


def test_flows_of_sumos_tool_give_their_vehicles(net: Path, tmp_path: Path) -> None:
    flows = random_trips(net, tmp_path / "flows.xml", "--flows", "4", "--period", "2")
    trips = read_trips(flows)
    assert 26 <= len(trips) <= 34 and 0.0 <= trips[0].depart_s and trips[-1].depart_s < 60.0


def test_pedestrians_of_sumos_tool_walk(net: Path, tmp_path: Path) -> None:
    walks = read_trips(random_trips(net, tmp_path / "p.xml", "--pedestrians", "--period", "5"))
    assert len(walks) == 12 and {walk.label for walk in walks} == {"pedestrian"}


def test_routes_by_id_classes_and_rates_are_those_of_the_file(tmp_path: Path) -> None:
    path = tmp_path / "own.rou.xml"
    path.write_text(
        '<routes><vType id="lorry" vClass="truck"/><vType id="bike" vClass="bicycle"/><route id="r" edges="a b c"/>'
        '<vehicle id="1" type="lorry" route="r" depart="2"/>'
        '<flow id="2" type="bike" route="r" begin="0" end="60" vehsPerHour="600"/>'
        '<flow id="3" from="a" to="c" via="b" begin="0" end="30" number="3"/></routes>'
    )
    trips = read_trips(path)
    assert Counter(trip.label for trip in trips) == {"truck": 1, "bicycle": 10, "car": 3}
    assert [trip.depart_s for trip in trips if trip.label == "bicycle"] == [6.0 * k for k in range(10)]
    assert {tuple(trip.edges) for trip in trips} == {("a", "b", "c")}


def test_distributions_give_their_members_by_their_probabilities(tmp_path: Path) -> None:
    """After SUMO's documentation, "Route and vehicle type distributions": members inside, or named by ids."""
    path = tmp_path / "mixed.rou.xml"
    path.write_text(
        '<routes><vType id="car" probability="0.5"/><vTypeDistribution id="fleet"><vType id="bus" vClass="bus" '
        'probability="0.25"/><vType id="lorry" vClass="truck" probability="0.75"/></vTypeDistribution>'
        '<vTypeDistribution id="named" vTypes="car DEFAULT_BIKETYPE" probabilities="0.9 0.1"/>'
        '<route id="r" edges="a b"/><routeDistribution id="ways"><route id="s" edges="a c" probability="3"/>'
        '<route refId="r" probability="1"/></routeDistribution>'
        '<flow id="f" type="fleet" route="ways" begin="0:00:00" end="0:01:40" period="1"/>'
        '<flow id="g" type="named" route="r" begin="0" end="100" number="50"/></routes>'
    )
    trips = read_trips(path)
    assert Counter(trip.label for trip in trips) == {"bus": 25, "truck": 75, "car": 45, "bicycle": 5}
    assert Counter(tuple(trip.edges) for trip in trips) == {("a", "c"): 75, ("a", "b"): 75}
    assert max(trip.depart_s for trip in trips) == 99.0


def test_included_files_are_read_once(tmp_path: Path) -> None:
    (tmp_path / "own.rou.xml").write_text(
        '<routes><include href="types/types.xml"/><vehicle id="v" type="lorry" depart="0:10:00"><route edges="a b"/>'
        "</vehicle></routes>"
    )
    (tmp_path / "types").mkdir()
    types = tmp_path / "types" / "types.xml"
    types.write_text('<additional><vType id="lorry" vClass="truck"/></additional>')
    assert [(trip.label, trip.depart_s) for trip in read_trips(tmp_path / "own.rou.xml")] == [("truck", 600.0)]
    types.write_text('<additional><include href="../own.rou.xml"/></additional>')
    with pytest.raises(ScenarioError, match=r"types\.xml: include: expected at most 20 files, each once"):
        read_trips(tmp_path / "own.rou.xml")


def test_stops_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "own.rou.xml"
    path.write_text(
        '<routes><vehicle id="v" depart="1"><route edges="a b"/><stop edge="a" duration="9"/></vehicle></routes>'
    )
    assert len(read_trips(path)) == 1
    assert "1 stops of vehicles or routes are left out" in caplog.text


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ('<person id="p" depart="0"><ride from="a" to="b"/></person>', "1 x person with ride"),
        ('<container id="c" depart="0"><tranship from="a" to="b"/></container>', "1 x container with tranship"),
        ('<vehicle id="v" route="gone" depart="0"/>', "1 x vehicle with a route 'gone' that is not there"),
        ('<flow id="f" fromTaz="a" toTaz="b" begin="0" end="9" number="3"/>', "1 x flow with fromTaz"),
        ('<trip id="t" fromJunction="a" toJunction="b" depart="0"/>', "1 x trip with fromJunction"),
        ('<interval begin="0" end="9"><flow id="f" from="a" to="b" number="1"/></interval>', "1 x interval with flow"),
        ('<trip id="t" from="a" to="b" depart="nan"/>', "'nan' is no time"),
        ('<include href="gone.xml"/>', "gone.xml: file not found"),
        (
            '<vType id="s" vClass="ship"/><trip id="t" type="s" from="a" to="b" depart="0"/>',
            "trip of type 's', which is",
        ),
        ('<flow id="f" from="a" to="b" begin="0" end="9" period="0"/>', "not a readable .rou.xml file"),
        ('<trip id="t" from="a" to="b" depart="triggered"/>', "not a readable .rou.xml file"),
    ],
)
def test_demand_that_is_not_read_is_named(tmp_path: Path, row: str, said: str) -> None:
    path = tmp_path / "odd.rou.xml"
    path.write_text(f'<routes><trip id="ok" from="a" to="b" depart="1"/>{row}</routes>')
    with pytest.raises(ScenarioError) as caught:
        read_trips(path)
    assert said in str(caught.value) and "\n" not in str(caught.value)
