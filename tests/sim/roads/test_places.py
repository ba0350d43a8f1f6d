"""In every place traffic stays physical, cars park off the lanes, and no lane leads through a house."""

import re
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import pytest
import shapely

from dsrc.data.write import generate
from sim.boxes import CLASSES
from sim.collisions import overlapping_pairs
from sim.geometry import wrap_angle
from sim.mesh.materials import material_index
from sim.roads.networks import read_network, resolve_network, resolve_polygons, resolve_trips
from sim.roads.polygons import has_buildings
from sim.scenario import Scenario
from sim.traffic.base import Actors
from sim.traffic.parking import parked_cars
from sim.traffic.sumo.demand import write_demand
from sim.traffic.sumo.traffic import SumoTraffic
from sim.world.buildings.footprints import outlined
from sim.world.ground import MARGIN_M
from tests.sim.roads.places import MOTORWAYS, PLACES, at_hand, every, streets_of, world_of

LATERAL_M, YAW_DEGPS, DEEP_M = 0.25, 120.0, 0.15
TOUCHING = 0.1
"""Share of the instants at which SUMO, which knows no bodies, lets some two of them overlap by more than `DEEP_M`."""


def near(actors: Actors, scenario: Scenario, margin: float) -> np.ndarray:
    x_min, y_min, x_max, y_max = scenario.network.area_m or (-np.inf, -np.inf, np.inf, np.inf)
    x, y = actors.boxes.center[:, 0], actors.boxes.center[:, 1]
    return (x > x_min - margin) & (x < x_max + margin) & (y > y_min - margin) & (y < y_max + margin)


@pytest.mark.parametrize("name", every(quick=("four_way",)))
def test_traffic_stays_physical_for_a_minute(name: str) -> None:
    scenario = at_hand(name)
    with SumoTraffic(scenario, 1) as traffic:
        drive = [traffic.actors] + [traffic.step() for _ in range(600)]
    lateral, turn = [], []
    for before, after in pairwise(drive):
        _, i, j = np.intersect1d(before.boxes.object_id, after.boxes.object_id, return_indices=True)
        driving = (before.boxes.label[i] != CLASSES.index("pedestrian")) & near(before, scenario, MARGIN_M)[i]
        i, j = i[driving], j[driving]
        turned = wrap_angle(after.boxes.yaw[j] - before.boxes.yaw[i])
        yaw = before.boxes.yaw[i] + 0.5 * turned
        move = after.boxes.center[j, :2] - before.boxes.center[i, :2]
        lateral.append(np.abs(np.cos(yaw) * move[:, 1] - np.sin(yaw) * move[:, 0]))
        turn.append(np.abs(turned) / 0.1)
    assert len(np.concatenate(lateral)) > 5000
    assert np.concatenate(lateral).max() < LATERAL_M
    assert np.degrees(np.concatenate(turn).max()) < YAW_DEGPS
    crowds = [actors.boxes[actors.boxes.is_vehicle & near(actors, scenario, 0.0)] for actors in drive[::5]]
    assert np.mean([len(overlapping_pairs(boxes, margin=-DEEP_M)) > 0 for boxes in crowds]) < TOUCHING


@pytest.mark.parametrize("name", every(quick=("four_way",)))
def test_no_lane_centre_lies_inside_a_house(name: str) -> None:
    scenario, mesh, streets = at_hand(name), world_of(name), streets_of(name)
    material = mesh.face_attributes["material"]
    house = np.isin(material, [material_index(kind) for kind in ("brick", "plaster", "concrete", "roof", "glass")])
    triangles = mesh.triangles[house]
    low = triangles[triangles[:, :, 2].min(axis=1) < 4.4][:, :, :2]
    hulls = shapely.convex_hull(shapely.multipoints(low.reshape(-1, 2), indices=np.repeat(np.arange(len(low)), 3)))
    frame = shapely.box(*streets.window)
    places = []
    for lane in streets.lanes:
        if lane.kind in ("road", "bicycle"):
            line = shapely.LineString(lane.line)
            at = shapely.line_interpolate_point(line, np.arange(0.5, line.length, 2.0))
            places.append(at[shapely.contains(frame, at)])
    points = np.concatenate(places)
    assert len(points) > 500
    assert not len(shapely.STRtree(hulls).query(points, predicate="intersects")[0])
    path = resolve_polygons(scenario)
    if path is not None and has_buildings(path):
        footprint = outlined(path, streets, np.random.default_rng(0)).footprint
        shapely.prepare(footprint)
        assert not shapely.contains(footprint, points).any()


@pytest.mark.parametrize("name", every([name for name in PLACES if name not in MOTORWAYS]))
def test_a_town_has_lights_kerbs_and_something_that_hides(name: str) -> None:
    mesh = world_of(name)
    material = mesh.face_attributes["material"]
    for kind in ("kerb", "signal_lamp", "pavement", "leaves", "metal"):
        assert (material == material_index(kind)).any(), kind
    assert len(mesh.faces) < 250_000


@pytest.mark.parametrize("name", every(["four_way", "helsinki", "rilsa_1"]))
def test_a_light_stands_at_every_stop_line_of_a_signalled_junction_and_none_on_the_road(name: str) -> None:
    mesh, streets = world_of(name), streets_of(name)
    lamps = mesh.triangles[mesh.face_attributes["material"] == material_index("signal_lamp")].mean(axis=1)[:, :2]
    area = shapely.box(*streets.area)
    ends = [
        lane.line[-1]
        for lane in streets.lanes
        if lane.kind == "road" and lane.stop == "signal" and lane.index == 0 and lane.speed >= 8.0
    ]
    ends = [end for end in ends if area.contains(shapely.Point(end))]
    assert len(ends) >= 4
    assert all(np.hypot(*(lamps - end).T).min() < 9.0 for end in ends)
    assert not shapely.contains_xy(streets.road, *lamps.T).any()


@pytest.mark.parametrize("name", every(["rilsa_1", "helsinki"]))
def test_parked_cars_stand_beside_the_lanes_and_are_the_same_again(name: str) -> None:
    scenario = at_hand(name)
    net = read_network(resolve_network(scenario, 1))
    cars, again, other = (parked_cars(scenario, net, seed) for seed in (1, 1, 2))
    assert len(cars) > 20
    assert np.array_equal(cars.base, again.base) and cars.kind == again.kind
    assert len(other) != len(cars) or not np.array_equal(other.base, cars.base)
    with SumoTraffic(msgspec.structs.replace(scenario, warmup_s=1.0), 1) as traffic:
        first, later = traffic.actors, [traffic.step() for _ in range(3)][-1]
    parked = first.parked()
    assert parked.sum() == len(cars) and later.parked().sum() == len(cars)
    boxes = first.boxes[parked]
    assert np.array_equal(boxes.array, later.boxes[later.parked()].array)
    assert not len(overlapping_pairs(boxes))
    streets = streets_of(name)
    lanes = shapely.union_all(
        [
            shapely.LineString(lane.line).buffer(0.5 * lane.width, cap_style="flat")
            for lane in streets.lanes
            if lane.kind in ("road", "walk")
        ]
    )
    footprints = shapely.polygons(boxes.bev_polygons())
    assert (shapely.area(shapely.intersection(footprints, lanes)) < 0.05).all()
    assert (shapely.distance(footprints, lanes) < 0.6).all()


def test_recorded_trips_drive_and_each_seed_takes_another_part_of_their_hour(tmp_path: Path) -> None:
    scenario = at_hand("resco_cologne1")
    net = read_network(resolve_network(scenario, 1))
    written = [write_demand(scenario, net, seed, tmp_path / f"{seed}.rou.xml").read_text() for seed in (1, 1, 2)]
    assert written[0] == written[1] != written[2]
    recorded = resolve_trips(scenario).read_text()
    ends = set(re.findall(r'<trip [^>]*from="([^"]+)" to="([^"]+)"', recorded))
    ours = re.findall(r'<trip [^>]*from="([^"]+)" to="([^"]+)"', written[0])
    assert len(ours) > 100 and set(ours) <= ends


def test_without_a_rate_nobody_parks() -> None:
    scenario = at_hand("rilsa_1")
    empty = msgspec.structs.replace(scenario, demand=msgspec.structs.replace(scenario.demand, parked_per_km=0.0))
    cars = parked_cars(empty, read_network(resolve_network(empty, 1)), 1)
    assert len(cars) == 0 and cars.bays.is_empty


@pytest.mark.parametrize("name", every(quick=("rilsa_1",)))
def test_a_drive_of_two_frames_can_be_made(name: str, tmp_path: Path) -> None:
    scenario = at_hand(name)
    agents = msgspec.structs.replace(scenario.agents, lidar="debug-16")
    quick = msgspec.structs.replace(scenario, agents=agents)
    drive = generate(quick, tmp_path, frames=2, seed=1)
    clouds = sorted(drive.glob("*/*.pcd"))
    assert len(clouds) == 2 * (scenario.agents.vehicles + len(scenario.agents.roadside))
    assert all(cloud.stat().st_size > 2_000 for cloud in clouds)
