"""Uneven land: streets level across but for their crowns, no steeper than their land along it, rough ground beside."""

import msgspec
import numpy as np
import pytest
import shapely
import trimesh

from sim.catalog.load import load_scenario
from sim.mesh.materials import material_index
from sim.scenario import RoadsideUnit, Scenario
from sim.world.build import build_world
from sim.world.buildings.houses import guard_rails
from sim.world.ground import streets_of
from sim.world.roads.kerbs import DROPPED_M, KERB_M, prolonged
from sim.world.roads.landscape import CROSS_FALL, DITCH_M, ROUGH_M
from sim.world.roads.markings import offset
from sim.world.roads.relief import MOTORWAY, TOWN
from sim.world.roads.streets import Lane, Streets
from sim.world.roads.surfaces import GROUND_BELOW_M, pavement
from sim.world.standing import stand
from tests.sensors.fakes import cars
from tests.sim.world.test_world_build import look, names


def scenario(name: str = "four_way") -> Scenario:
    return msgspec.structs.replace(load_scenario(name), world=2)


@pytest.fixture(scope="module")
def world() -> trimesh.Trimesh:
    return build_world(scenario(), 1)


@pytest.fixture(scope="module")
def town() -> Streets:
    return streets_of(scenario(), 1)


def arms(streets: Streets) -> list[Lane]:
    """Return the lanes of the arms of the crossing."""
    return [lane for lane in streets.lanes if lane.kind == "road" and not lane.internal]


def places(lane: Lane) -> np.ndarray:
    line = shapely.segmentize(shapely.LineString(lane.line), 2.0)
    return np.asarray(shapely.get_coordinates(line))[5:-5]


def within(streets: Streets, xy: np.ndarray) -> np.ndarray:
    frame = np.array(streets.window)
    return xy[((xy > frame[:2] + 20.0) & (xy < frame[2:] - 20.0)).all(axis=1)]


def corners_of(mesh: trimesh.Trimesh, name: str) -> np.ndarray:
    """Return the (N, 3) corners of the faces of a material."""
    return np.asarray(mesh.vertices[np.unique(mesh.faces[mesh.face_attributes["material"] == material_index(name)])])


def test_along_its_lanes_a_street_is_no_steeper_than_its_land(town: Streets) -> None:
    steep = []
    for lane in arms(town):
        xy = within(town, places(lane))
        rise = np.diff(town.height(xy)) / np.hypot(*np.diff(xy, axis=0).T)
        steep.append(np.abs(rise))
    # Triangles of 4 m let the crown show where a lane runs along its edge.
    assert 0.01 < np.quantile(np.concatenate(steep), 0.9) and np.concatenate(steep).max() < TOWN.steepest[1] + 0.02


@pytest.mark.parametrize("size", [(16.5, 2.5, 3.8), (4.6, 1.8, 1.5)])
def test_bodies_stand_within_5_cm_of_the_carriageway_anywhere_along_its_lanes(
    town: Streets, size: tuple[float, float, float]
) -> None:
    """Of the longest body a radius of 250 m, that of crests, takes 4.6 cm: of 9.9 m between its wheels."""
    ends = []
    for lane in town.lanes:
        if lane.kind == "road":
            way = prolonged(lane.line, 12.0)
            back = np.arange(0.0, way.length - size[0], 2.0)
            places_m = np.stack([back, back + size[0]], axis=1)
            ends.append(shapely.get_coordinates(shapely.line_interpolate_point(way, places_m)).reshape(-1, 2, 2))
    rear, front = np.concatenate(ends).transpose(1, 0, 2)
    rows = np.column_stack([0.5 * (rear + front), np.arctan2(*(front - rear).T[::-1])])
    outline = shapely.linestrings(np.stack([rear, front], axis=1)).astype(object)
    rows = rows[shapely.contains_properly(town.road, shapely.buffer(outline, 0.5 * size[1], cap_style="flat"))]
    boxes = stand(cars(rows, size=size), town.height).boxes
    off = boxes.center[:, 2] - 0.5 * size[2] - town.height(boxes.center[:, :2])
    assert len(rows) > 1000 and np.abs(off).max() <= 0.05


def test_no_triangle_of_the_carriageway_reaches_a_bank(town: Streets) -> None:
    """Along its lanes the height of a street bends by no more than its crown does at an edge."""
    bends = []
    for lane in arms(town):
        line = shapely.LineString(lane.line)
        xy = within(
            town, shapely.get_coordinates(shapely.line_interpolate_point(line, np.arange(5, line.length - 5, 1)))
        )
        bends.append(np.abs(np.diff(town.height(xy), 2)))
    assert np.concatenate(bends).max() < CROSS_FALL


def test_across_a_street_falls_from_its_middle_to_its_edges(town: Streets) -> None:
    falls = []
    for lane in arms(town):
        if lane.index == 0:
            inner, outer = (town.height(offset(places(lane), side * 0.7 * lane.kerb_side)) for side in (-1.0, 1.0))
            falls.append((inner - outer) / 1.4)
    fall = np.concatenate(falls)
    assert np.median(fall) == pytest.approx(CROSS_FALL, abs=0.006)
    assert np.quantile(np.abs(fall - CROSS_FALL), 0.9) < 0.02


def test_unpaved_ground_is_rough_and_paved_ground_smooth(town: Streets) -> None:
    nodes = town.terrain.nodes
    frame = shapely.box(*town.window)
    paved = shapely.union_all([town.road, town.walk, pavement(town)])
    verge = (paved.buffer(12.0) - paved.buffer(2.0)) & frame
    shapely.prepare(verge)
    xy = nodes[shapely.contains_xy(verge, *nodes[:, :2].T)]

    def residual(rows: np.ndarray) -> float:
        from scipy.spatial import cKDTree

        left = []
        for near in cKDTree(rows[:, :2]).query_ball_point(rows[::40, :2], 3.0):
            if len(near) > 8:
                plane = np.column_stack([rows[near, :2] - rows[near, :2].mean(axis=0), np.ones(len(near))])
                fit, *_ = np.linalg.lstsq(plane, rows[near, 2], rcond=None)
                left.append(rows[near, 2] - plane @ fit)
        return float(np.concatenate(left).std())

    # Half a side of the road, where its crown is a plane.
    half = town.road.buffer(-0.5) - town.road.buffer(-3.5)
    shapely.prepare(half)
    road = np.random.default_rng(0).uniform(town.window[:2], town.window[2:], (200_000, 2))
    road = road[shapely.contains_xy(half, *road.T)]
    assert 0.7 * ROUGH_M < residual(xy) < 1.5 * ROUGH_M
    assert len(road) > 2000 and residual(np.column_stack([road, town.height(road)])) < 0.2 * ROUGH_M


def test_the_ground_lies_below_what_it_carries_and_the_world_is_closed(town: Streets, world: trimesh.Trimesh) -> None:
    assert town.land is not None
    for name, field, lift in (
        ("asphalt", town.terrain, 0.0),
        ("marking", town.terrain, 0.01),
        ("pavement", town.land, 0.0),
    ):
        corners = corners_of(world, name)
        np.testing.assert_allclose(corners[:, 2], field.height(corners[:, :2]) + lift, atol=1e-6)
    corners = corners_of(world, "ground")
    beside, below = (field.height(corners[:, :2]) - corners[:, 2] for field in (town.land, town.terrain))
    np.testing.assert_allclose(
        np.minimum(np.abs(beside - GROUND_BELOW_M), np.abs(below - 2.0 * GROUND_BELOW_M)), 0.0, atol=1e-6
    )
    land = [material_index(name) for name in ("asphalt", "marking", "pavement", "kerb", "ground")]
    assert np.isfinite(world.vertices).all()
    assert np.isin(world.face_attributes["material"], land).sum() < 106_000 and len(world.faces) < 235_000


@pytest.mark.parametrize("name", ["highway", "highway_env_intersection"])
def test_paint_kerbs_and_rails_keep_to_the_ground_between_their_corners(name: str) -> None:
    if name.startswith("highway_env"):
        pytest.importorskip("highway_env")
    streets, mesh = streets_of(scenario(name), 1), build_world(scenario(name), 1)
    triangles, material = np.asarray(mesh.triangles), mesh.face_attributes["material"]
    rails = guard_rails(streets)
    for chosen, height, least_m, most_m in (
        (triangles[material == material_index("marking")], streets.terrain.height, 0.009, 0.011),
        (triangles[material == material_index("kerb")], streets.terrain.height, -GROUND_BELOW_M - 0.01, KERB_M + 0.03),
        (rails.vertices[rails.faces], streets.height, 0.3, 0.9),
    ):
        if not len(chosen):  # towns have no guard rails, motorways no kerbs
            continue
        middle = chosen.mean(axis=1)
        above = middle[:, 2] - height(middle[:, :2])
        assert least_m - 1e-6 < above.min() and above.max() < most_m
        assert np.linalg.norm(chosen - np.roll(chosen, 1, axis=1), axis=2).max() < 6.0


def test_drives_that_differ_in_sensors_alone_stand_on_one_ground(town: Streets) -> None:
    own = scenario()
    agents = msgspec.structs.replace(own.agents, lidar="hdl-64e-kitti", vehicles=own.agents.vehicles + 1)
    assert streets_of(msgspec.structs.replace(own, agents=agents), 1) is streets_of(own, 1)
    beside = msgspec.structs.replace(agents, roadside=(RoadsideUnit(xyz_m=(0.0, 0.0, 5.0)),))
    assert streets_of(msgspec.structs.replace(own, agents=beside), 1) is not streets_of(own, 1)


@pytest.mark.slow
def test_equal_seeds_build_equal_ground_and_level_worlds_are_as_before(town: Streets) -> None:
    streets_of.__globals__["_uneven"].cache_clear()
    again = streets_of(scenario(), 1)
    assert again is not town and again.terrain.nodes.tobytes() == town.terrain.nodes.tobytes()
    assert streets_of(scenario(), 2).terrain.nodes.tobytes() != town.terrain.nodes.tobytes()
    level = streets_of(load_scenario("four_way"), 1)
    assert level.terrain.flat and len(level.terrain.faces) == 2
    assert streets_of(msgspec.structs.replace(scenario(), world=1), 1).terrain.flat


def test_beside_a_motorway_is_a_ditch_and_its_land_is_gentler() -> None:
    streets = streets_of(scenario("highway"), 1)
    lanes = [lane for lane in arms(streets) if lane.speed > 25.0]
    lines = [within(streets, places(lane)) for lane in lanes]
    rise = np.concatenate([np.diff(streets.height(xy)) / np.hypot(*np.diff(xy, axis=0).T) for xy in lines])
    assert np.abs(rise).max() < MOTORWAY.steepest[1] + 0.02
    outside = streets.road.buffer(3.25).exterior if hasattr(streets.road, "exterior") else None
    rings = [outside] if outside is not None else [part.buffer(3.25).exterior for part in streets.road.geoms]
    frame = shapely.box(*streets.window).buffer(-5.0)
    ditch = np.concatenate([shapely.get_coordinates(shapely.segmentize(ring, 3.0) & frame) for ring in rings])
    edge = shapely.get_coordinates(shapely.shortest_line(streets.road, shapely.points(ditch))).reshape(-1, 2, 2)[:, 0]
    depth = streets.height(edge) - streets.height(ditch)
    assert np.median(depth) == pytest.approx(DITCH_M, abs=0.2)


def test_footways_lie_a_kerb_above_the_gutter_and_less_where_people_and_cars_pass(town: Streets) -> None:
    assert town.land is not None
    border = shapely.get_coordinates(shapely.segmentize(town.road.boundary & town.kerbs.buffer(0.01), 0.5))
    border = within(town, border)
    step = town.land.height(border) - town.terrain.height(border)
    assert len(border) > 1000 and step.min() > -1e-6 and step.max() < KERB_M + 0.03
    assert np.mean(np.abs(step - KERB_M) < 0.01) > 0.7 and np.mean(step < KERB_M - 0.02) > 0.05
    # Crossings of this network end 2 to 3 m before the edge of the carriageway.
    crossings = [lane.line for lane in town.lanes if lane.kind == "crossing"]
    ends = [
        end + 2.0 * (end - other) / np.hypot(*(end - other))
        for end, other in [*crossings, *(c[::-1] for c in crossings)]
    ]
    dropped = step[shapely.dwithin(shapely.MultiPoint(ends), shapely.points(border), 1.2)]
    assert len(dropped) > 20 and np.median(dropped) == pytest.approx(DROPPED_M, abs=0.01)
    assert np.quantile(dropped, 0.9) < 0.5 * (DROPPED_M + KERB_M)


def test_from_above_the_kerb_ends_at_the_footway_and_the_wall_between_is_closed(
    town: Streets, world: trimesh.Trimesh
) -> None:
    assert town.land is not None
    mesh, rng = world, np.random.default_rng(0)
    border = within(
        town, shapely.get_coordinates(shapely.segmentize(town.road.boundary & town.kerbs.buffer(0.01), 1.0))
    )
    border = border[rng.permutation(len(border))[:2000]]
    # 5 cm to both sides of the edge: the gutter, and the stone.
    for shape, field in ((town.road.buffer(-0.05), town.terrain), (town.road.buffer(0.05), town.land)):
        xy = shapely.get_coordinates(shapely.shortest_line(shape.boundary, shapely.points(border))).reshape(-1, 2, 2)[
            :, 0
        ]
        top = np.column_stack([xy, field.height(xy) + 0.2])
        down, face = look(mesh, top, [0.0, 0.0, -1.0])
        on = np.isin(names(mesh, face), ["asphalt", "marking", "kerb", "pavement"])
        assert on.mean() > 0.9
        np.testing.assert_allclose(down[on], 0.2, atol=0.012)
