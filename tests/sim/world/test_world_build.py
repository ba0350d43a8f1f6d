import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import shapely
import trimesh
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh
from numpy.typing import ArrayLike

from sensors.recording.mounting import blocked_share, place_roadside
from sensors.scan.scene import RayScene
from sim.catalog.load import list_scenarios, load_scenario
from sim.encounters import network_file, with_encounter
from sim.mesh.materials import MATERIALS, material_index
from sim.roads.networks import read_network, resolve_network
from sim.roads.tools import sumo_home
from sim.scenario import AgentRule, NetworkSpec, RoadsideUnit
from sim.world.build import build_world
from sim.world.ground import MARGIN_M
from sim.world.roads.streets import Streets, read_streets
from sim.world.roads.surfaces import pavement
from tests.sim.roads.places import MOTORWAYS, PLACES, at_hand

SOLID = ("brick", "plaster", "concrete", "roof", "glass", "metal", "dark_metal", "hedge", "bark", "leaves", "kerb")
OF_SUMO = [name for name in list_scenarios() if not load_scenario(name).network.highway_env]
# The places have tests of their own, tests/sim/roads; few are looked at here too.
ALL = [name for name in OF_SUMO if name not in PLACES or name in ("braunschweig", "four_way", "helsinki", "highway")]
LARGE = ("braunschweig", "helsinki")
"""Towns whose worlds, and those of the encounters in them, are built in the slow tests."""


def some(names: list[str]) -> list:
    return [pytest.param(one, marks=pytest.mark.slow) if one.startswith(LARGE) else one for one in names]


NAMES = some(ALL)
TOWNS = some([name for name in ALL if name in PLACES and name not in MOTORWAYS])

Worlds = Callable[[str], tuple[trimesh.Trimesh, Streets]]
"""World and streets of a scenario by its name."""


@pytest.fixture(scope="module")
def worlds() -> Worlds:
    made = {}

    def of(name: str) -> tuple[trimesh.Trimesh, Streets]:
        if name not in made:
            scenario = with_encounter(at_hand(name), 1)
            streets = read_streets(read_network(network_file(scenario, 1)), scenario.network.area_m, MARGIN_M)
            made[name] = build_world(scenario, 1), streets
        return made[name]

    return of


def look(mesh: trimesh.Trimesh, origin: ArrayLike, direction: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return (N,) distance (inf: nothing) and (N,) face of rays in the world."""
    middle = np.round(mesh.bounds.mean(axis=0))
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, (mesh.vertices - middle).astype(np.float32), mesh.faces.astype(np.int32))
    start = (np.asarray(origin) - middle).astype(np.float32)
    hits = scene.run(start, np.ascontiguousarray(np.broadcast_to(direction, start.shape), np.float32), output=1)
    return np.where(hits["primID"] >= 0, hits["tfar"], np.inf), hits["primID"]


def lane_samples(streets: Streets, kinds: tuple[str, ...] = ("road",)) -> tuple[np.ndarray, np.ndarray]:
    """Return (N, 2) points in the middle of lanes, 3 m apart, and whether each lies on a junction."""
    frame = shapely.box(*streets.area)
    points, internal = [], []
    for lane in streets.lanes:
        line = shapely.LineString(lane.line)
        at = shapely.line_interpolate_point(line, np.arange(0.5, line.length, 3.0))
        chosen = at[shapely.contains(frame, at)] if lane.kind in kinds else at[:0]
        points.append(shapely.get_coordinates(chosen))
        internal.append(np.full(len(chosen), lane.internal))
    return np.concatenate(points), np.concatenate(internal)


def names(mesh: trimesh.Trimesh, faces: np.ndarray) -> np.ndarray:
    return np.array([m.name for m in MATERIALS])[mesh.face_attributes["material"][faces]]


@pytest.mark.parametrize("name", NAMES)
def test_a_ray_straight_down_on_a_lane_meets_the_road_or_its_paint(worlds: Worlds, name: str) -> None:
    mesh, streets = worlds(name)
    points, _ = lane_samples(streets)
    assert len(points) > 100
    above = np.column_stack([points, np.full(len(points), 4.4)])
    distance, face = look(mesh, above, [0, 0, -1])
    assert set(names(mesh, face)) <= {"asphalt", "marking"}
    assert np.abs(distance - 4.4).max() < 0.011


@pytest.mark.parametrize("name", NAMES)
def test_nothing_stands_in_the_way_of_a_vehicle(worlds: Worlds, name: str) -> None:
    mesh, streets = worlds(name)
    low = mesh.triangles[:, :, 2].min(axis=1) < 4.4
    solid = np.isin(mesh.face_attributes["material"], [material_index(n) for n in SOLID]) & low
    hull = shapely.convex_hull(shapely.multipoints([shapely.points(t) for t in mesh.triangles[solid][:, :, :2]]))
    lanes = [lane for lane in streets.lanes if lane.kind == "road"]
    ways = [shapely.LineString(lane.line).buffer(0.5 * lane.width - 0.2, cap_style="flat") for lane in lanes]
    middle = shapely.unary_union(ways)
    middle &= shapely.box(*streets.window)
    shapely.prepare(middle)
    assert not shapely.intersects(middle, hull).any()


@pytest.mark.parametrize("name", NAMES)
def test_every_face_has_a_valid_material_and_finite_corners(worlds: Worlds, name: str) -> None:
    mesh, _ = worlds(name)
    material = mesh.face_attributes["material"]
    assert material.dtype == np.uint8 and material.shape == (len(mesh.faces),) and material.max() < len(MATERIALS)
    assert np.isfinite(mesh.vertices).all() and mesh.faces.max() < len(mesh.vertices)
    assert {"asphalt", "marking", "ground", "metal"} <= set(names(mesh, np.arange(len(mesh.faces))))
    assert len(mesh.faces) < 250_000


@pytest.mark.parametrize("name", NAMES)
def test_the_ground_is_below_everything_and_reaches_beyond_the_area(worlds: Worlds, name: str) -> None:
    mesh, streets = worlds(name)
    low_x, low_y, high_x, high_y = streets.area
    x, y = np.meshgrid(np.linspace(low_x - 150, high_x + 150, 23), np.linspace(low_y - 150, high_y + 150, 23))
    above = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 100.0)])
    distance, _ = look(mesh, above, [0, 0, -1])
    assert np.isfinite(distance).all()
    below, face = look(mesh, above * [1, 1, -1], [0, 0, 1])
    assert set(names(mesh, face)) <= {"ground", "bark", "kerb", "brick", "plaster", "concrete"}
    assert np.abs(below - 99.95).max() < 0.61


@pytest.mark.parametrize("name", NAMES)
def test_paint_lies_above_the_road(worlds: Worlds, name: str) -> None:
    mesh, _ = worlds(name)
    material = mesh.face_attributes["material"]
    paint = mesh.triangles[material == material_index("marking")][:, :, 2]
    roads = mesh.triangles[material == material_index("asphalt")][:, :, 2]
    assert len(paint) > 50 and paint.min() >= roads.max() + 0.005


@pytest.mark.slow
def test_no_building_of_braunschweig_covers_a_lane_near_the_signals(worlds: Worlds) -> None:
    mesh, streets = worlds("braunschweig")
    material = mesh.face_attributes["material"]
    house = np.isin(material, [material_index(n) for n in ("brick", "plaster", "concrete", "roof", "glass")])
    triangles = mesh.triangles[house]
    near = np.hypot(*(triangles[:, :, :2].mean(axis=1) - [671.0, 639.2]).T) < 250.0
    hull = shapely.convex_hull(shapely.multipoints([shapely.points(t) for t in triangles[near][:, :, :2]]))
    covered = shapely.unary_union(hull)
    net = read_network(resolve_network(load_scenario("braunschweig"), 1))
    for_cars = {edge.getID() for edge in net.getEdges(withInternal=True) if edge.allows("passenger")}
    car_lanes = replace(streets, lanes=tuple(lane for lane in streets.lanes if lane.edge in for_cars))
    points, _ = lane_samples(car_lanes)
    points = points[np.hypot(*(points - [671.0, 639.2]).T) < 250.0]
    assert len(hull) > 1000 and len(points) > 500
    assert not shapely.contains_xy(covered, *points.T).any()


@pytest.mark.slow
def test_the_real_houses_of_braunschweig_are_seen_from_the_junction(worlds: Worlds) -> None:
    mesh, _ = worlds("braunschweig")
    angle = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    eye = np.tile([671.0, 639.2, 1.9], (720, 1))
    way = np.column_stack([np.cos(angle), np.sin(angle), np.full(720, 0.02)])
    distance, face = look(mesh, eye, way)
    seen = names(mesh, face[np.isfinite(distance) & (distance < 120.0)])
    assert np.isin(seen, ["brick", "plaster", "concrete", "glass"]).sum() > 200


@pytest.mark.parametrize("name", NAMES)
def test_a_mast_does_not_stand_before_its_roadside_sensor(worlds: Worlds, name: str) -> None:
    units = load_scenario(name).agents.roadside
    mesh, _ = worlds(name)
    for unit in units:
        angle = np.linspace(0, 2 * np.pi, 360, endpoint=False)
        way = np.column_stack([np.cos(angle), np.sin(angle), np.full(360, -np.tan(np.radians(30.0)))])
        distance, _ = look(mesh, np.tile(unit.xyz_m, (360, 1)), way / np.linalg.norm(way, axis=1)[:, None])
        assert distance.min() > 1.5


def test_a_world_depends_on_its_seed_only_where_no_map_tells() -> None:
    scenario = load_scenario("four_way")
    first, again, other = build_world(scenario, 3), build_world(scenario, 3), build_world(scenario, 4)
    assert np.array_equal(first.vertices, again.vertices) and np.array_equal(first.faces, again.faces)
    assert np.array_equal(first.face_attributes["material"], again.face_attributes["material"])
    assert first.vertices.shape != other.vertices.shape or not np.array_equal(first.vertices, other.vertices)


def test_the_world_follows_the_heights_of_its_lanes(tmp_path: Path) -> None:
    nodes = "".join(
        f'<node id="{k}" x="{x}" y="{y}" z="{z}"/>' for k, x, y, z in
        [("a", 0, 0, 10), ("b", 200, 0, 20), ("c", 400, 0, 10), ("d", 200, 200, 30)]
    )  # fmt: skip
    edges = "".join(
        f'<edge id="{p}{q}" from="{p}" to="{q}" numLanes="2" speed="13.9"/>' for p, q in ("ab", "bc", "db", "ba", "bd")
    )
    (tmp_path / "n.nod.xml").write_text(f"<nodes>{nodes}</nodes>")
    (tmp_path / "n.edg.xml").write_text(f"<edges>{edges}</edges>")
    command = [str(sumo_home() / "bin" / "netconvert"), "-n", "n.nod.xml", "-e", "n.edg.xml", "-o", "n.net.xml"]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    scenario = load_scenario("four_way")
    network = NetworkSpec(file=str(tmp_path / "n.net.xml"))
    units = tuple(
        RoadsideUnit(xyz_m=(x, y, 5.0), lidar="debug-16") for x, y in ((50.0, 14.0), (120.0, 11.0), (300.0, 12.0))
    )
    scenario = msgspec.structs.replace(scenario, network=network, agents=AgentRule(roadside=units))
    mesh = build_world(scenario, 1)
    net = read_network(tmp_path / "n.net.xml")
    points = np.array([p for edge in net.getEdges(False) for lane in edge.getLanes() for p in lane.getShape3D()])
    starts, ends = points[::2], points[1::2]
    on_lanes = np.concatenate([starts + f * (ends - starts) for f in (0.2, 0.35, 0.5, 0.65, 0.8)])
    assert np.ptp(on_lanes[:, 2]) > 10.0
    distance, face = look(mesh, on_lanes + np.array([0, 0, 4.0]), [0, 0, -1])
    assert set(names(mesh, face)) <= {"asphalt", "marking"}
    assert np.abs(distance - 4.0).max() < 0.15
    scene = RayScene(mesh)
    for unit in place_roadside(scene, units):
        assert blocked_share(scene, unit) < 0.05


@pytest.mark.parametrize("name", TOWNS)
def test_towns_have_houses_kerbs_and_trees(worlds: Worlds, name: str) -> None:
    mesh, _ = worlds(name)
    found = set(names(mesh, np.arange(len(mesh.faces))))
    assert {"roof", "kerb", "pavement", "leaves", "bark", "signal_lamp", "glass"} <= found


def test_no_pavement_runs_along_a_motorway(worlds: Worlds) -> None:
    _, streets = worlds("highway")
    roads = [lane for lane in streets.lanes if lane.kind == "road" and not lane.internal]
    fast = [lane for lane in roads if lane.speed > 25.0 and lane.index == 0]
    beside = shapely.union_all(
        [shapely.LineString(lane.line).offset_curve(-0.5 * lane.width - 1.0).buffer(0.5) for lane in fast]
    )
    slow = shapely.union_all([shapely.LineString(lane.line).buffer(12.0) for lane in roads if lane.speed < 25.0])
    verge = (beside - slow - streets.road.buffer(0.1)) & shapely.box(*streets.area)
    assert verge.area > 100.0
    assert pavement(streets).intersection(verge).area == 0.0


def test_names_of_materials_are_unique_and_reflectivities_physical() -> None:
    assert len({m.name for m in MATERIALS}) == len(MATERIALS) < 256
    assert all(0.0 <= m.reflectivity <= 1.0 for m in MATERIALS)
    assert all(MATERIALS[material_index(m.name)] is m for m in MATERIALS)
