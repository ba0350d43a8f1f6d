import numpy as np
import pytest
import shapely
import trimesh

from sim.mesh.materials import material_index
from sim.mesh.solids import carpet
from sim.roads.network import Network
from sim.roads.networks import read_network, resolve_network
from sim.world.build import build_world
from sim.world.ground import MARGIN_M
from sim.world.roads.streets import Streets, read_streets
from sim.world.roads.surfaces import GROUND_BELOW_M, pavement
from sim.world.roads.terrain import BEYOND_M, CELL_M, Terrain, land, level_land
from tests.sim.world.hills import hilly_scenario, lane_points
from tests.sim.world.test_world_build import look, names

WINDOW = (0.0, 0.0, 200.0, 100.0)


@pytest.fixture(scope="module")
def hills(tmp_path_factory: pytest.TempPathFactory) -> tuple[Network, Streets, trimesh.Trimesh]:
    scenario = hilly_scenario(tmp_path_factory.mktemp("hills"))
    net = read_network(resolve_network(scenario, 1))
    return net, read_streets(net, None, MARGIN_M), build_world(scenario, 1)


def slope(rise: float = 0.1, bend: float = 0.0) -> Terrain:
    """Land around one road along x that climbs."""
    x = np.linspace(0.0, 200.0, 21)
    line = np.column_stack([x, np.full(21, 50.0), 300.0 + rise * x + bend * (x - 100.0) ** 2])
    return land(WINDOW, [line], shapely.box(0.0, 46.0, 200.0, 54.0))


def test_the_land_has_the_heights_of_a_lane_and_of_its_own_nodes() -> None:
    terrain = slope(bend=0.001)
    x = np.random.default_rng(0).uniform(10.0, 190.0, 500)
    on_road = np.column_stack([x, np.random.default_rng(1).uniform(46.0, 54.0, 500)])
    expected = 300.0 + 0.1 * x + 0.001 * (x - 100.0) ** 2
    np.testing.assert_allclose(terrain.height(on_road), expected, atol=0.001 * (CELL_M**2 + 10.0**2) / 4)
    np.testing.assert_allclose(terrain.height(terrain.nodes[:, :2]), terrain.nodes[:, 2], atol=1e-9)


def test_the_land_reaches_beyond_the_window_and_keeps_the_height_of_its_rim() -> None:
    terrain = slope()
    low, high = terrain.nodes.min(axis=0), terrain.nodes.max(axis=0)
    np.testing.assert_allclose([low[:2], high[:2]], [[-BEYOND_M] * 2, [200.0 + BEYOND_M, 100.0 + BEYOND_M]])
    rim, beyond = np.array([[-BEYOND_M, 50.0]]), np.array([[-9000.0, 50.0]])
    np.testing.assert_allclose(terrain.height(beyond), terrain.height(rim))


def test_the_triangles_of_the_land_look_up_and_leave_no_hole() -> None:
    terrain = slope(bend=0.002)
    a, b, c = (terrain.nodes[terrain.faces[:, k], :2] for k in range(3))
    doubled = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert (doubled > 0.0).all()
    assert doubled.sum() / 2.0 == pytest.approx((200.0 + 2 * BEYOND_M) * (100.0 + 2 * BEYOND_M))


def test_every_part_of_a_cut_shape_lies_on_one_triangle() -> None:
    terrain = slope(bend=0.002)
    shape = shapely.Point(80.0, 50.0).buffer(20.0) - shapely.box(70.0, 40.0, 75.0, 60.0)
    parts = terrain.cut(shape)
    assert parts.area == pytest.approx(shape.area, abs=0.01)
    surface = carpet(parts, terrain.height, 0.0, "asphalt")
    middle = surface.vertices[surface.faces].mean(axis=1)
    np.testing.assert_allclose(terrain.height(middle[:, :2]), middle[:, 2], atol=1e-6)


@pytest.mark.parametrize("width", [0.0, 1e-13])
def test_nothing_is_left_of_a_shape_without_area(width: float) -> None:
    parts = slope(bend=0.002).cut(shapely.Polygon([(40.0, 50.0), (60.0, 50.0), (60.0, 50.0 + width)]))
    assert parts.area == pytest.approx(0.0, abs=1e-9)
    assert not len(carpet(parts, slope().height, 0.0, "gravel").faces) or width


def test_a_wide_land_has_a_bounded_number_of_nodes() -> None:
    window = (0.0, 0.0, 4000.0, 4000.0)
    line = np.array([[0.0, 0.0, 0.0], [4000.0, 4000.0, 90.0]])
    terrain = land(window, [line], shapely.box(*window))
    assert 30_000 < len(terrain.nodes) < 45_000


def test_level_lanes_make_two_triangles() -> None:
    line = np.array([[0.0, 50.0, 7.0], [200.0, 50.0, 7.02]])
    terrain, shape = land(WINDOW, [line], shapely.box(0.0, 46.0, 200.0, 54.0)), shapely.box(0, 0, 9, 9)
    assert terrain.flat and len(terrain.faces) == 2
    assert terrain.cut(shape) is shape and terrain.follow(shape) is shape
    assert level_land(WINDOW, 7.0).height(np.array([[3.0, 9e9]])).tolist() == [7.0]


def test_in_hilly_country_the_road_has_the_height_of_its_lanes(hills: tuple[Network, Streets, trimesh.Trimesh]) -> None:
    net, _, mesh = hills
    points = lane_points(net)
    distance, face = look(mesh, points + np.array([0.0, 0.0, 4.0]), [0, 0, -1])
    assert np.ptp(points[:, 2]) > 25.0
    assert set(names(mesh, face)) <= {"asphalt", "marking", "pavement"}
    # netconvert leaves steps between the lanes of a corner, which land cannot have.
    assert (np.quantile(np.abs(distance - 4.0), [0.5, 0.99, 0.995]) < [0.01, 0.06, 0.15]).all()


def test_in_hilly_country_the_ground_lies_just_below_road_and_pavement(
    hills: tuple[Network, Streets, trimesh.Trimesh],
) -> None:
    _, streets, mesh = hills
    low_x, low_y, high_x, high_y = streets.window
    x, y = np.meshgrid(np.arange(low_x, high_x, 1.3), np.arange(low_y, high_y, 1.3))
    covered = (streets.road | pavement(streets)).buffer(-0.3)
    shapely.prepare(covered)
    places = np.column_stack([x.ravel(), y.ravel()])
    places = places[shapely.contains_xy(covered, *places.T)]
    top = np.column_stack([places, streets.height(places) + 0.5])
    down, _ = look(mesh, top, [0, 0, -1])
    up, face = look(mesh, top - [0.0, 0.0, 20.0], [0, 0, 1])
    ground = np.isin(names(mesh, face), ["ground"])
    gap = (20.0 - down - up)[ground]
    assert ground.mean() > 0.99 and len(gap) > 5000
    assert gap.min() > GROUND_BELOW_M - 1e-3
    # Paint lies 1 cm above the road, kerbs about 10 cm, more where their stones bridge a hollow.
    assert np.quantile(gap, 0.99) < GROUND_BELOW_M + 0.012 and gap.max() < GROUND_BELOW_M + 0.22


def test_in_hilly_country_paint_lies_on_the_road(hills: tuple[Network, Streets, trimesh.Trimesh]) -> None:
    _, streets, mesh = hills
    paint = mesh.triangles[mesh.face_attributes["material"] == material_index("marking")]
    middle = paint.mean(axis=1)
    assert len(paint) > 500
    np.testing.assert_allclose(middle[:, 2], streets.height(middle[:, :2]) + 0.01, atol=1e-6)


def test_the_mesh_of_hilly_country_is_not_large(hills: tuple[Network, Streets, trimesh.Trimesh]) -> None:
    _, streets, mesh = hills
    assert len(streets.terrain.faces) < 30_000 and len(mesh.faces) < 250_000
