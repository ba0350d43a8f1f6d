"""The world along highway-env's roads: asphalt under every lane, nothing on it, lines between lanes."""

from functools import cache

import numpy as np
import pytest
import trimesh

from sensors.scan.scene import RayScene
from sim.catalog.load import load_scenario
from sim.mesh.materials import MATERIALS, material_index
from sim.traffic.highway.roads import read_roads
from sim.world.build import build_world

PLACES = ("merge", "roundabout", "intersection", "racetrack", "two_way")


@cache
def world_of(name: str) -> trimesh.Trimesh:
    return build_world(load_scenario(f"highway_env_{name}"), 2)


def lane_points(name: str) -> np.ndarray:
    scenario = load_scenario(f"highway_env_{name}")
    points = np.concatenate([lane.line[::3] for lane in read_roads(scenario.network.highway_env).lanes])
    if scenario.network.area_m:
        x_min, _, x_max, _ = scenario.network.area_m
        points = points[(points[:, 0] > x_min) & (points[:, 0] < x_max)]
    return points


def below(name: str, xy: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """Return height and material of the first surface under places 4.4 m above the road."""
    mesh = world_of(name)
    hits = RayScene(mesh).cast(np.column_stack([xy, np.full(len(xy), 4.4)]), np.tile([0, 0, -1.0], (len(xy), 1)), 9.0)
    assert (hits.face >= 0).all()
    return 4.4 - hits.distance, [MATERIALS[i].name for i in mesh.face_attributes["material"][hits.face]]


@pytest.mark.parametrize("name", PLACES)
def test_no_lane_leads_through_a_house_or_a_tree(name: str) -> None:
    height, material = below(name, lane_points(name))
    assert set(material) <= {"asphalt", "marking"}
    assert np.abs(height).max() < 0.02


@pytest.mark.parametrize("name", PLACES)
def test_something_stands_beside_the_road(name: str) -> None:
    material = world_of(name).face_attributes["material"]
    beside = ("metal", "leaves") if name == "merge" else ("roof", "leaves", "kerb", "pavement")
    assert all((material == material_index(kind)).any() for kind in beside)


def test_a_dashed_line_divides_the_lanes_of_the_two_way_road() -> None:
    x = np.arange(200.0, 600.0, 0.5)
    share = {}
    # highway-env paints dashes between the lanes, at y = -2, and whole lines along the edges, at 2 and -6.
    for y in (-1.94, -5.94, 1.94):
        _, material = below("two_way", np.column_stack([x, np.full(len(x), y)]))
        share[y] = np.mean([name == "marking" for name in material])
    assert 0.2 < share[-1.94] < 0.45
    assert share[-5.94] > 0.95 and share[1.94] > 0.95


def test_the_seed_builds_the_same_world_again_and_another_one_other_houses() -> None:
    scenario = load_scenario("highway_env_intersection")
    again, other = build_world(scenario, 2), build_world(scenario, 3)
    assert again.vertices.tobytes() == world_of("intersection").vertices.tobytes()
    assert other.vertices.tobytes() != again.vertices.tobytes()
