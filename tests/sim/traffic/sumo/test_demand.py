"""Demand: seeded trips that the network can carry, in vehicles of many sizes."""

import xml.etree.ElementTree as ET
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest

from sim.bodies.choice import choose_model
from sim.bodies.vehicle_types import TYPES, types_of
from sim.boxes import CLASSES
from sim.catalog.load import load_scenario
from sim.errors import ScenarioError
from sim.roads.networks import read_network, resolve_network
from sim.scenario import Scenario
from sim.traffic.sumo.demand import write_demand


def demand(scenario: Scenario, seed: int, folder: Path) -> ET.Element:
    net = read_network(resolve_network(scenario, 0))
    return ET.parse(write_demand(scenario, net, seed, folder / "d.rou.xml")).getroot()


def test_one_seed_writes_the_same_bytes_and_another_writes_other_trips(tmp_path: Path) -> None:
    scenario = load_scenario("braunschweig")
    net = read_network(resolve_network(scenario, 0))
    files = [write_demand(scenario, net, seed, tmp_path / f"{k}.xml").read_bytes() for k, seed in enumerate((1, 1, 2))]
    assert files[0] == files[1] != files[2]


def test_departures_ascend_and_come_at_the_rate_asked_for(tmp_path: Path) -> None:
    scenario = load_scenario("four_way")
    root = demand(scenario, 3, tmp_path)
    departures = [float(e.get("depart")) for e in root if e.tag in ("vehicle", "person")]
    assert departures == sorted(departures)
    for letter, rate in (("v", 1700.0), ("b", 240.0), ("p", 600.0)):
        count = sum(e.get("id").startswith(letter) for e in root if e.tag != "vType")
        expected = rate * (scenario.warmup_s + scenario.duration_s + 1800.0) / 3600.0
        assert abs(count - expected) < 5.0 * np.sqrt(expected)


def test_adding_bicycles_leaves_the_cars_as_they_were(tmp_path: Path) -> None:
    scenario = load_scenario("four_way")
    without = msgspec.structs.replace(scenario, demand=msgspec.structs.replace(scenario.demand, bicycles_per_hour=0.0))
    cars = [
        [ET.tostring(e) for e in demand(s, 1, tmp_path) if e.tag == "vehicle" and e.get("id").startswith("v")]
        for s in (scenario, without)
    ]
    assert cars[0] == cars[1]


@pytest.mark.parametrize("name", ["braunschweig", "four_way", "ingolstadt", "highway", "koenigs_wusterhausen"])
def test_every_route_is_connected_for_its_class_and_nobody_turns_back(name: str, tmp_path: Path) -> None:
    scenario = load_scenario(name)
    net = read_network(resolve_network(scenario, 0))
    routes = {
        (TYPES[e.get("type")].vclass, e.find("route").get("edges"))
        for e in demand(scenario, 1, tmp_path)
        if e.tag == "vehicle"
    }
    assert len(routes) > 5
    for vclass, text in routes:
        edges = [net.getEdge(edge) for edge in text.split()]
        for edge, following in pairwise(edges):
            assert following in edge.getAllowedOutgoing(vclass)
            assert not (edge.getFromNode() is following.getToNode() and edge.getToNode() is following.getFromNode())


def test_trips_through_an_area_touch_it_and_prefer_its_focus(tmp_path: Path) -> None:
    scenario = load_scenario("braunschweig")
    junction = {"166445405", "166445407", "166445412", "4314834#3"}
    routes = [set(e.find("route").get("edges").split()) for e in demand(scenario, 1, tmp_path) if e.tag == "vehicle"]
    assert np.mean([bool(route & junction) for route in routes]) > 0.8


def test_bicycles_ride_where_they_may_and_cars_stay_off_their_lanes(tmp_path: Path) -> None:
    root = demand(load_scenario("four_way"), 1, tmp_path)
    kinds: dict[str, set[str]] = {e.get("id")[0]: set() for e in root if e.tag == "vehicle"}
    for e in root:
        if e.tag == "vehicle":
            kinds[e.get("id")[0]].add(TYPES[e.get("type")].vclass)
    assert kinds["b"] == {"bicycle"}
    assert "bicycle" not in kinds["v"] and {"passenger", "delivery", "truck"} <= kinds["v"]


def test_a_network_without_pavements_has_no_walkers(tmp_path: Path) -> None:
    scenario = load_scenario("highway")
    walkers = msgspec.structs.replace(scenario, demand=msgspec.structs.replace(scenario.demand, persons_per_hour=9.0))
    with pytest.raises(ScenarioError, match=r"highway: demand\.persons_per_hour: expected sidewalks"):
        demand(walkers, 0, tmp_path)


def test_passenger_cars_come_in_eight_lengths() -> None:
    lengths = sorted(kind.size[0] for kind in types_of("car"))
    assert len(set(lengths)) == 8 and lengths[0] == 3.6 and lengths[-1] == 5.1
    for label in CLASSES:
        assert np.isclose(sum(kind.weight for kind in types_of(label)), 1.0)


def test_looks_depend_on_seed_and_name_only() -> None:
    looks = [[choose_model("car", f"v{k}", seed) for k in range(40)] for seed in (1, 1, 2)]
    assert looks[0] == looks[1] != looks[2]
    assert len(set(looks[0])) > 1
