"""Side of traffic: maps of left-driving countries, networks of SUMO and OpenDRIVE roads whose rule is LHT."""

import re
from pathlib import Path

import numpy as np
import pytest

from sim.errors import ScenarioError
from sim.roads.convert import convert_map
from sim.roads.network import Network
from sim.roads.networks import read_network
from sim.roads.osm import keeps_left
from sim.scenario import AgentRule, DemandSpec, NetworkSpec, Scenario
from sim.traffic.parking import parked_cars
from sim.traffic.sumo.traffic import SumoTraffic
from sim.world.furniture.kerbside import street_edges
from sim.world.roads.streets import read_streets

PLACES = {
    "London": (51.50, -0.12, True), "Dublin": (53.35, -6.26, True), "Calais": (50.95, 1.86, False),
    "Dover": (51.13, 1.31, True), "Tokyo": (35.68, 139.76, True), "Fukuoka": (33.59, 130.40, True),
    "Busan": (35.18, 129.08, False), "Mumbai": (19.08, 72.88, True), "Delhi": (28.61, 77.21, True),
    "Kabul": (34.53, 69.17, False), "Sydney": (-33.87, 151.21, True), "Auckland": (-36.85, 174.76, True),
    "Singapore": (1.35, 103.82, True), "Jakarta": (-6.2, 106.85, True), "Manila": (14.6, 120.98, False),
    "Bangkok": (13.75, 100.5, True), "Hanoi": (21.03, 105.85, False), "Phnom Penh": (11.56, 104.92, False),
    "Yangon": (16.87, 96.2, False), "Hong Kong": (22.3, 114.17, True), "Shenzhen": (22.6, 114.06, False),
    "Nairobi": (-1.29, 36.82, True), "Kigali": (-1.95, 30.06, False), "Cape Town": (-33.92, 18.42, True),
    "Luanda": (-8.84, 13.23, False), "Lusaka": (-15.39, 28.32, True), "Valletta": (35.9, 14.51, True),
    "Berlin": (52.52, 13.4, False), "New York": (40.71, -74.0, False), "Kingston": (17.97, -76.79, True),
    "Santo Domingo": (18.49, -69.93, False), "Perth": (-31.95, 115.86, True), "Beirut": (33.89, 35.5, False),
    "Martinique": (14.61, -61.07, False), "Guadeloupe": (16.24, -61.53, False), "Dominica": (15.3, -61.39, True),
    "Barbados": (13.1, -59.61, True), "Saint Lucia": (14.01, -60.99, True), "Antigua": (17.12, -61.85, True),
    "Port of Spain": (10.65, -61.51, True), "Sint Maarten": (18.03, -63.05, False), "Anguilla": (18.22, -63.06, True),
    "Charlotte Amalie": (18.34, -64.93, True), "Culebra": (18.3, -65.3, False), "Bermuda": (32.29, -64.78, True),
    "George Town": (19.29, -81.38, True), "Nassau": (25.06, -77.34, True), "Freeport": (26.53, -78.7, True),
    "Guantanamo": (20.14, -75.21, False), "Miami": (25.76, -80.19, False), "Caracas": (10.48, -66.9, False),
    "Stanley": (-51.69, -57.86, True), "Nouméa": (-22.27, 166.45, False), "Port Vila": (-17.73, 168.32, False),
    "Honiara": (-9.43, 159.95, True), "Suva": (-18.14, 178.44, True), "Nuku'alofa": (-21.14, -175.2, True),
    "Apia": (-13.83, -171.77, True), "Pago Pago": (-14.28, -170.7, False), "Papeete": (-17.54, -149.57, False),
    "Tarawa": (1.35, 173.0, True), "Majuro": (7.1, 171.37, False), "Koror": (7.34, 134.48, False),
    "Port Moresby": (-9.44, 147.18, True), "Dili": (-8.55, 125.57, True), "Sandakan": (5.84, 118.1, True),
    "Zamboanga": (6.91, 122.07, False), "Hobart": (-42.88, 147.33, True), "Naha": (26.21, 127.68, True),
    "Nakhon Si Thammarat": (8.43, 99.97, True), "Vientiane": (17.97, 102.6, False), "Nong Khai": (17.88, 102.75, True),
    "Savannakhet": (16.57, 104.75, False), "Phuket": (7.88, 98.39, True), "Nan": (18.78, 100.77, True),
    "Luang Prabang": (19.89, 102.13, False), "Port Blair": (11.67, 92.73, True), "Gilgit": (35.92, 74.31, True),
    "Dhaka": (23.81, 90.41, True), "Sittwe": (20.15, 92.9, False), "Lhasa": (29.65, 91.1, False),
    "Kathmandu": (27.7, 85.32, True), "Kigoma": (-4.88, 29.63, True), "Bujumbura": (-3.38, 29.36, False),
    "Nyagatare": (-1.3, 30.33, False), "Kabale": (-1.25, 29.99, True), "Lubumbashi": (-11.66, 27.48, False),
    "Kitwe": (-12.8, 28.2, True), "Juba": (4.85, 31.6, False), "Victoria": (-4.62, 55.45, True),
    "Saint-Denis": (-20.88, 55.45, False), "Port Louis": (-20.16, 57.5, True), "Antananarivo": (-18.88, 47.51, False),
    "Moroni": (-11.7, 43.26, False), "Maputo": (-25.97, 32.58, True), "Windhoek": (-22.56, 17.08, True),
    "Paramaribo": (5.85, -55.17, True), "Cayenne": (4.93, -52.33, False), "Taipei": (25.03, 121.56, False),
}  # fmt: skip


def crossing(lat: float = 51.5, lon: float = -0.12, tags: str = "") -> str:
    """Return a crossing of two streets of 30 mph as OpenStreetMap XML."""
    step = 0.0036
    ends = [(0, 0), (0, -1), (0, 1), (-1, 0), (1, 0)]
    nodes = "".join(
        f'<node id="{k + 1}" lat="{lat + step * y:.6f}" lon="{lon + 1.6 * step * x:.6f}">'
        f"{tags if k == 0 else ''}</node>"
        for k, (y, x) in enumerate(ends)
    )
    ways = "".join(
        f'<way id="{k}"><nd ref="{a}"/><nd ref="1"/><nd ref="{b}"/><tag k="highway" v="secondary"/>'
        f'<tag k="lanes" v="2"/><tag k="maxspeed" v="30 mph"/></way>'
        for k, a, b in ((11, 2, 3), (12, 4, 5))
    )
    return f'<osm version="0.6">{nodes}{ways}</osm>'


def converted(folder: Path, text: str, name: str = "map.osm") -> Network:
    source, out = folder / name, folder / "out"
    source.write_text(text)
    out.mkdir()
    return read_network(convert_map(source, out).net)


def scenario_of(folder: Path) -> Scenario:
    return Scenario(
        name="town",
        description="",
        network=NetworkSpec(file=str(folder / "out" / "map.net.xml"), round=False),
        demand=DemandSpec(vehicles_per_hour=1800.0, parked_per_km=60.0),
        agents=AgentRule(vehicles=1),
        warmup_s=60.0,
    )


def left_of_middle(net: Network, scenario: Scenario) -> tuple[int, int]:
    """Return how many moving vehicles between junctions keep left of the middle of their road, and of how many."""
    found, middle = [], np.array([0.5 * (net.getBoundary()[k] + net.getBoundary()[k + 2]) for k in (0, 1)])
    with SumoTraffic(scenario, 1) as traffic:
        actors = traffic.actors
        for row in np.flatnonzero(~actors.parked()):
            xy, yaw = actors.boxes.center[row, :2] - middle, actors.boxes.yaw[row]
            if np.hypot(*xy) > 30.0:
                # Both roads lead through the middle, so that their line through a vehicle is known.
                found.append(float(-xy @ [-np.sin(yaw), np.cos(yaw)]) < 0.0)
    return sum(found), len(found)


@pytest.mark.parametrize("place", PLACES)
def test_a_place_keeps_the_side_of_its_country(place: str, tmp_path: Path) -> None:
    lat, lon, left = PLACES[place]
    path = tmp_path / "map.osm"
    path.write_text(crossing(lat, lon))
    assert keeps_left(path) is left


@pytest.mark.parametrize(
    ("tags", "left"),
    [
        ('<tag k="addr:country" v="GB"/>', True),
        ('<tag k="is_in:country_code" v="de"/>', False),
        ('<tag k="addr:country" v="DE"/><tag k="driving_side" v="left"/>', True),
    ],
)
def test_tags_of_a_map_decide_before_its_place(tags: str, left: bool, tmp_path: Path) -> None:
    path = tmp_path / "map.osm"
    path.write_text(crossing(0.0 if left else 51.5, -0.12, tags))
    assert keeps_left(path) is left


@pytest.mark.slow
def test_vehicles_and_parked_cars_of_a_british_town_keep_left(tmp_path: Path) -> None:
    net = converted(tmp_path, crossing())
    scenario = scenario_of(tmp_path)
    left, of = left_of_middle(net, scenario)
    assert left == of > 10
    cars = parked_cars(scenario, net, 1)
    streets = read_streets(net, None, 20.0)
    assert {lane.kerb_side for lane in streets.lanes} == {1.0}
    assert all(side == 1.0 for lane, side in street_edges(streets) if lane.index == 0 and lane.opposite)
    mirror = tmp_path / "mirror"
    mirror.mkdir()
    other = converted(mirror, crossing(51.5, 9.0))
    mirrored = parked_cars(scenario_of(mirror), other, 1)
    assert 0.9 * len(mirrored) < len(cars) < 1.1 * len(mirrored) and len(cars) > 20
    assert left_of_middle(other, scenario_of(mirror))[0] == 0


def test_an_option_decides_before_the_map_and_a_network_has_its_side(tmp_path: Path) -> None:
    source, out = tmp_path / "map.osm", tmp_path / "out"
    source.write_text(crossing())
    out.mkdir()
    assert read_network(convert_map(source, out, "right").net).kerb_side == -1.0
    with pytest.raises(ScenarioError, match="traffic_side: expected auto for a SUMO network"):
        convert_map(out / "map.net.xml", tmp_path, "left")


def test_a_left_hand_network_of_sumo_stays_one(tmp_path: Path) -> None:
    converted(tmp_path, crossing())
    again = tmp_path / "again"
    again.mkdir()
    assert read_network(convert_map(tmp_path / "out" / "map.net.xml", again).net).kerb_side == 1.0


def test_ways_before_nodes_are_read_as_if_sorted(tmp_path: Path) -> None:
    text = crossing()
    start, end = text.index("<node"), text.index("<way")
    nodes = text[start:end]
    plain = converted(tmp_path, text)
    swapped = tmp_path / "swapped"
    swapped.mkdir()
    other = converted(swapped, text.replace(nodes, "").replace("</osm>", f"{nodes}</osm>"))
    shapes = [{edge.getID(): edge.getShape() for edge in net.getEdges(False)} for net in (plain, other)]
    assert shapes[0] == shapes[1] and len(shapes[0]) > 3


def test_a_map_without_nodes_or_roads_says_what_it_has(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="root: expected <osm> of an OpenStreetMap extract, found <html>"):
        converted(tmp_path, "<!DOCTYPE html>\n<html><body>429 Too Many Requests</body></html>")
    other, text = tmp_path / "other", crossing()
    other.mkdir()
    for kind in set(re.findall(r'<tag k="highway" v="(\w+)"', text)):
        text = text.replace(f'<tag k="highway" v="{kind}"/>', '<tag k="highway" v="cycleway"/>')
    with pytest.raises(ScenarioError, match=r"highways: expected roads open to passenger cars.* found cycleway"):
        converted(other, text)


def test_a_lanelet2_map_is_named(tmp_path: Path) -> None:
    """As Lanelet2's OSM format is documented in its `lanelet2_maps`."""
    text = crossing().replace('<tag k="highway" v="secondary"/>', '<tag k="type" v="line_thin"/>')
    relation = '<relation id="9"><member type="way" ref="11" role="left"/><tag k="type" v="lanelet"/></relation>'
    with pytest.raises(ScenarioError, match=r"expected an OpenStreetMap extract.*found a Lanelet2 map"):
        converted(tmp_path, text.replace("</osm>", f"{relation}</osm>"))
