"""Buildings from polygons: closed, where the map has them, on no lane, and every broken file is told."""

from pathlib import Path

import msgspec
import numpy as np
import pytest
import shapely
import sumolib

from sim.catalog.load import load_scenario
from sim.errors import ScenarioError
from sim.mesh.materials import material_index
from sim.mesh.solids import join, to_mesh
from sim.roads.networks import read_network, resolve_network
from sim.roads.polygons import read_outlines
from sim.roads.tools import sumo_tools
from sim.scenario import Scenario
from sim.world.build import build_world
from sim.world.buildings.facades import WALLS
from sim.world.buildings.footprints import outlined
from sim.world.ground import MARGIN_M
from sim.world.roads.streets import Streets, read_streets
from sim.world.roads.terrain import level_land

SHIPPED = sumo_tools() / "game" / "A10KW" / "osm.poly.xml"
SQUARE = "0,0 20,0 20,20 0,20 0,0"


def write(folder: Path, *polys: str) -> Path:
    path = folder / "town.poly.xml"
    path.write_text(f"<additional>{''.join(polys)}</additional>", encoding="utf-8")
    return path


def poly(shape: str = SQUARE, kind: str = "building.yes", **params: str) -> str:
    inner = "".join(f'<param key="{k.replace("_", ":")}" value="{v}"/>' for k, v in params.items())
    return f'<poly id="7" type="{kind}" shape="{shape}">{inner}</poly>'


def open_field(road: shapely.Geometry | None = None) -> Streets:
    """Return a flat window of 200 m without lanes but with a road."""
    nothing, window = shapely.Polygon(), (-100.0, -100.0, 100.0, 100.0)
    return Streets(window, window, (), road or nothing, nothing, nothing, level_land(window, 0.0))


def seed(number: int = 0) -> np.random.Generator:
    return np.random.default_rng(number)


def top(path: Path, number: int = 0) -> float:
    return float(join(outlined(path, open_field(), seed(number)).parts).vertices[:, 2].max())


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario("koenigs_wusterhausen")


@pytest.fixture(scope="module")
def streets(scenario: Scenario) -> Streets:
    return read_streets(read_network(resolve_network(scenario, 1)), scenario.network.area_m, MARGIN_M)


def test_the_shipped_map_has_fifteen_buildings_with_walls() -> None:
    outlines = read_outlines(SHIPPED)
    assert len(outlines) == 15  # 14 `building.yes` and a `building.retail`; two roofs on posts are left out
    assert all(outline.shape.is_valid and outline.shape.area > 200.0 for outline in outlines)
    theirs = [p for p in sumolib.shapes.polygon.read(str(SHIPPED)) if p.type in ("building.yes", "building.retail")]
    areas = [shapely.Polygon(polygon.shape).area for polygon in theirs]
    assert [outline.shape.area for outline in outlines] == pytest.approx(areas)


def test_real_buildings_stand_where_the_map_has_them_and_on_no_lane(streets: Streets) -> None:
    town = outlined(SHIPPED, streets, seed())
    map_objects = shapely.union_all([outline.shape for outline in read_outlines(SHIPPED)])
    frame = shapely.box(*streets.window)
    lanes = streets.road | streets.walk | streets.rail
    assert (town.footprint - map_objects.buffer(0.05)).area < 1e-3
    assert shapely.within(town.footprint, frame.buffer(1e-6))
    assert town.footprint.distance(lanes) > 0.4
    free = (map_objects & frame) - lanes.buffer(2.0)
    assert (free - town.footprint).area < 0.01 * free.area
    flat = join(town.parts).vertices[:, :2]
    assert shapely.dwithin(town.footprint, shapely.points(flat), 0.05).all()  # panes are a little proud


def test_walls_and_roof_close_over_the_ground(streets: Streets) -> None:
    mesh = to_mesh(join(outlined(SHIPPED, streets, seed()).parts))
    solid = np.isin(mesh.face_attributes["material"], [material_index(name) for name in (*WALLS, "roof")])
    corners, index = np.unique(mesh.vertices[mesh.faces[solid]].reshape(-1, 3).round(6), axis=0, return_inverse=True)
    edges = index.reshape(-1, 3)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    # Every edge is met once in each direction, but those of the foot, which stand in the ground.
    _, forth, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
    assert count.max() == 1 and len(forth) == len(edges)
    back = {tuple(edge) for edge in edges[:, ::-1]}
    open_edges = np.array([edge for edge in edges if tuple(edge) not in back])
    assert len(open_edges) > 50 and (corners[open_edges.ravel(), 2] == -0.6).all()


@pytest.mark.slow
def test_the_world_of_the_shipped_scenario_shows_them(scenario: Scenario, streets: Streets) -> None:
    mesh, again, other = build_world(scenario, 1), build_world(scenario, 1), build_world(scenario, 2)
    assert np.array_equal(mesh.vertices, again.vertices) and np.array_equal(mesh.faces, again.faces)
    roofs = [m.triangles[m.face_attributes["material"] == material_index("roof")] for m in (mesh, other)]
    assert roofs[0].shape == roofs[1].shape  # their places do not depend on the seed, their heights do
    assert np.array_equal(roofs[0][..., :2], roofs[1][..., :2]) and not np.array_equal(roofs[0], roofs[1])
    for roof in roofs:
        assert len(np.unique(roof[..., 2])) > 5
        assert 9.0 <= roof[..., 2].min() and roof[..., 2].max() <= 18.0


def test_the_file_tells_the_height_in_metres_or_levels(tmp_path: Path) -> None:
    assert top(write(tmp_path, poly(height="12.5"))) == pytest.approx(12.5)
    assert top(write(tmp_path, poly(height="7 m", building_levels="9"))) == pytest.approx(7.0)
    assert top(write(tmp_path, poly(building_levels="4"))) == pytest.approx(12.0)


@pytest.mark.parametrize("height", ["", "high", "nan", "inf", "-3", "0", "9000"])
def test_a_height_that_cannot_be_is_drawn(tmp_path: Path, height: str) -> None:
    path = write(tmp_path, poly(height=height))
    assert 9.0 <= top(path) <= 18.0 and top(path) == top(path) != top(path, 1)


def test_heights_do_not_change_when_another_building_leaves_the_window(tmp_path: Path) -> None:
    near, far = poly(), poly("500,0 520,0 520,20 500,20")
    assert top(write(tmp_path, far, near)) == top(write(tmp_path, poly("-90,0 -80,0 -80,9", height="3"), near))


def test_crossing_outlines_are_repaired_and_those_without_area_skipped(tmp_path: Path) -> None:
    bow_tie, line, point = poly("0,0 20,20 20,0 0,20"), poly("0,0 9,9 18,18"), poly("1,1")
    outlines = read_outlines(write(tmp_path, bow_tie, line, point))
    assert [outline.shape.is_valid for outline in outlines] == [True]
    assert outlines[0].shape.area == pytest.approx(200.0)
    assert outlined(tmp_path / "town.poly.xml", open_field(), seed()).footprint.area == pytest.approx(200.0, abs=4.0)


def test_a_road_cuts_through_and_leaves_no_slivers(tmp_path: Path) -> None:
    road = shapely.box(-100.0, 5.0, 100.0, 19.0)  # leaves 0-4.5 m on one side and half a metre on the other
    town = outlined(write(tmp_path, poly()), open_field(road), seed())
    assert town.footprint.bounds == pytest.approx((0.0, 0.0, 20.0, 4.5), abs=0.05)


def test_overlapping_outlines_share_no_ground_and_the_window_crops(tmp_path: Path) -> None:
    town = outlined(write(tmp_path, poly(), poly(), poly("90,0 130,0 130,20 90,20")), open_field(), seed())
    assert town.footprint.area == pytest.approx(400.0 + 200.0, abs=0.1)
    roof = [p.material == material_index("roof") for p in town.parts]
    assert sum(rows.sum() for rows in roof) == 4


def test_a_window_without_buildings_is_an_open_field(tmp_path: Path) -> None:
    town = outlined(write(tmp_path, poly("500,0 520,0 520,20 500,20")), open_field(), seed())
    assert town.parts == () and town.footprint.is_empty


BROKEN = {
    "not xml": ("<additional><poly", "not a readable"),
    "no building": (f"<additional>{poly(kind='natural.water')}{poly(kind='building.roof')}</additional>", "building"),
    "no numbers": (f"<additional>{poly('0,0 x,0 1,1')}</additional>", "poly '7': shape"),
    "no pairs": (f"<additional>{poly('0 1 2')}</additional>", "poly '7': shape"),
    "not finite": (f"<additional>{poly('0,0 nan,0 1,1')}</additional>", "finite"),
    "degrees": ("<additional>" + poly().replace("<poly", "<poly geo='1'") + "</additional>", "poly '7': geo"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_file_is_one_line(tmp_path: Path, case: str) -> None:
    path = tmp_path / "town.poly.xml"
    path.write_text(BROKEN[case][0])
    with pytest.raises(ScenarioError, match=r"town\.poly\.xml") as caught:
        read_outlines(path)
    assert BROKEN[case][1] in str(caught.value) and "\n" not in str(caught.value)


def test_a_missing_file_is_told(scenario: Scenario, tmp_path: Path) -> None:
    network = msgspec.structs.replace(scenario.network, polygons=str(tmp_path / "gone.poly.xml"))
    with pytest.raises(ScenarioError, match=r"gone\.poly\.xml: file not found"):
        build_world(msgspec.structs.replace(scenario, network=network), 1)
