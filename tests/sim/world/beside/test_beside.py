"""Worlds of version 2 have things beside their roads, and nothing on them."""

from functools import cache

import msgspec
import numpy as np
import pytest
import shapely
import trimesh

from sim.catalog.load import load_scenario
from sim.encounters import encounter_of, network_file
from sim.mesh.materials import material_index
from sim.roads.networks import read_network
from sim.scenario import Scenario
from sim.traffic.parking import parked_cars
from sim.world.build import build_world
from sim.world.ground import streets_of as scenario_streets
from sim.world.roads.streets import Streets
from tests.sim.roads.places import at_hand

PLACES = ("rilsa_1", *(pytest.param(name, marks=pytest.mark.slow) for name in ("four_way", "motorway_a10")))


def furnished(name: str) -> Scenario:
    return msgspec.structs.replace(at_hand(name), world=2)


@cache
def world_of(name: str) -> trimesh.Trimesh:
    return build_world(furnished(name), 1)


@cache
def streets_of(name: str) -> Streets:
    return scenario_streets(furnished(name), 1)


def _flat(triangles: np.ndarray) -> np.ndarray:
    corner = np.repeat(np.arange(len(triangles)), 3)
    return shapely.convex_hull(shapely.multipoints(triangles[:, :, :2].reshape(-1, 2), indices=corner))


def _standing(mesh: trimesh.Trimesh, streets: Streets, low_m: float, high_m: float) -> np.ndarray:
    """Return (N, 3, 3) triangles that reach into a band of heights above the ground."""
    triangles = np.asarray(mesh.triangles)
    ground = streets.height(triangles[:, :, :2].reshape(-1, 2)).reshape(-1, 3)
    above = triangles[:, :, 2] - ground
    return triangles[(above.max(axis=1) > low_m) & (above.min(axis=1) < high_m)]


@pytest.mark.parametrize("name", PLACES)
def test_nothing_stands_on_a_lane(name: str) -> None:
    streets = streets_of(name)
    solid = _standing(world_of(name), streets, 0.2, 4.4)
    ways = [
        shapely.LineString(lane.line).buffer(0.5 * lane.width - 0.1, cap_style="flat")
        for lane in streets.lanes
        if lane.kind in ("road", "bicycle")
    ]
    lanes = shapely.unary_union(ways) & shapely.box(*streets.window)
    shapely.prepare(lanes)
    assert len(solid) > 10_000
    assert not shapely.intersects(lanes, _flat(solid)).any()


@pytest.mark.slow
def test_nothing_stands_in_a_parked_car() -> None:
    scenario, streets = furnished("rilsa_1"), streets_of("rilsa_1")
    cars = parked_cars(scenario, read_network(network_file(scenario, 1)), 1)
    corners = [0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * kind.size[:2] for kind in cars.kind]
    turns = [np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]) for yaw in cars.yaw]
    footprints = shapely.polygons([c @ t + base[:2] for c, t, base in zip(corners, turns, cars.base, strict=True)])
    bodies = shapely.union_all(footprints)
    shapely.prepare(bodies)
    assert len(cars) > 20
    assert not shapely.intersects(bodies, _flat(_standing(world_of("rilsa_1"), streets, 0.2, 1.4))).any()
    # Some stand below crowns.
    assert shapely.intersects(bodies, _flat(_standing(world_of("rilsa_1"), streets, 1.5, 6.0))).any()


@pytest.mark.slow
@pytest.mark.parametrize("name", PLACES)
def test_footways_stay_passable(name: str) -> None:
    streets = streets_of(name)
    solid = _standing(world_of(name), streets, 0.2, 2.0)
    ways = [
        shapely.LineString(lane.line).buffer(max(0.5 * lane.width - 0.5, 0.1), cap_style="flat")
        for lane in streets.lanes
        if lane.kind in ("walk", "crossing")
    ]
    middle = shapely.unary_union(ways)
    shapely.prepare(middle)
    # Posts of a version 1 world stand at the side of a footway.
    assert not shapely.intersects(middle, _flat(solid)).any()


@pytest.mark.slow
def test_one_seed_gives_one_world() -> None:
    first, again = world_of("rilsa_1"), build_world(furnished("rilsa_1"), 1)
    assert np.array_equal(first.vertices, again.vertices) and np.array_equal(first.faces, again.faces)
    other = build_world(furnished("rilsa_1"), 2)
    assert first.vertices.shape != other.vertices.shape


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ima_building", pytest.param("cyclist_right_hook", marks=pytest.mark.slow)])
def test_encounters_keep_their_ground_clear(name: str) -> None:
    scenario = msgspec.structs.replace(load_scenario(name), world=2)
    mesh = build_world(scenario, 1)
    layout = encounter_of(scenario, 1).layout
    inside = layout.clear - shapely.union_all([structure.outline for structure in layout.structures]).buffer(0.3)
    shapely.prepare(inside)
    plants = np.isin(mesh.face_attributes["material"], [material_index(one) for one in ("hedge", "leaves", "bark")])
    triangles = np.asarray(mesh.triangles)[plants]
    assert len(triangles) > 1000
    near = shapely.intersects(inside, _flat(triangles))
    assert not near.any()


@pytest.mark.slow
def test_density_0_leaves_what_a_bare_world_has() -> None:
    scenario = furnished("rilsa_1")
    bare = msgspec.structs.replace(scenario, network=msgspec.structs.replace(scenario.network, beside=0.0))
    plants = [material_index(one) for one in ("hedge", "leaves")]
    empty, full = build_world(bare, 1), world_of("rilsa_1")
    assert not np.isin(empty.face_attributes["material"], plants).any()
    assert np.isin(full.face_attributes["material"], plants).sum() > 5000
    assert np.isin(empty.face_attributes["material"], [material_index("signal_lamp")]).any()


def test_an_unset_density_is_no_setting_of_a_drive() -> None:
    assert b"beside" not in msgspec.json.encode(load_scenario("four_way"))
