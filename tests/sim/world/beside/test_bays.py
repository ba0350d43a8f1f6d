"""Right behind parking bays stand tall things, whose crowns hang over parked cars and never over the carriageway."""

from functools import cache

import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from sim.mesh.materials import material_index
from sim.mesh.solids import MeshPart, join
from sim.world.beside import build
from sim.world.beside.build import Site, beside
from sim.world.furniture.map_objects import MapObjects
from sim.world.roads.streets import NOTHING, Lane, Streets
from sim.world.roads.terrain import level_land

AREA, WINDOW = (-60.0, -20.0, 60.0, 20.0), (-80.0, -40.0, 80.0, 40.0)
KERB_M = 3.5
BAY_M = (6.2, 2.55)
SEEDS = range(3)
PLANTS = [material_index(name) for name in ("hedge", "leaves")]


def bays() -> list[shapely.Polygon]:
    """Return 20 bays in two rows a side."""
    length, width = BAY_M
    rows = [(side * (KERB_M + 0.5 * width), start) for side in (-1.0, 1.0) for start in (-50.0, 15.0)]
    return [
        shapely.box(start + k * length, y - 0.5 * width, start + (k + 1) * length, y + 0.5 * width)
        for y, start in rows
        for k in range(5)
    ]


def _lane(way: float) -> Lane:
    line = np.array([[-80.0 * way, -1.75 * way], [80.0 * way, -1.75 * way]])
    return Lane(
        kind="road",
        line=line,
        width=3.5,
        edge=f"{way}",
        index=0,
        count=1,
        verge=0.0,
        internal=False,
        speed=13.9,
        stop="",
        opposite=True,
        beside_road=True,
    )


def street(parking: bool) -> Site:
    """Return a level, straight street of two lanes along x, with or without parking bays, and a house far off it."""
    road = shapely.box(WINDOW[0], -KERB_M, WINDOW[2], KERB_M)
    along = shapely.union_all(bays()) if parking else NOTHING
    lanes = (_lane(1.0), _lane(-1.0))
    streets = Streets(AREA, WINDOW, lanes, road | along, NOTHING, NOTHING, level_land(WINDOW, 0.0), along)
    return Site(streets, shapely.box(-75.0, 30.0, -70.0, 35.0), (), NOTHING, np.zeros((0, 3)), MapObjects())


@cache
def planted(seed: int, density: float = 1.0) -> MeshPart:
    return join(beside(street(parking=True), seed, density))


def without_bays(seed: int, density: float = 1.0) -> MeshPart:
    """Return what stands beside the road where nobody plants anything behind bays."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build, "behind_bays", lambda *_: [])
        return join(beside(street(parking=True), seed, density))


def triangles(part: MeshPart) -> NDArray[np.float64]:
    return np.asarray(part.vertices[part.faces], np.float64)


def flat(corners: NDArray[np.float64]) -> NDArray[np.object_]:
    """Return the shapes of (N, 3, 3) triangles seen from above."""
    row = np.repeat(np.arange(len(corners)), 3)
    shapes: NDArray[np.object_] = shapely.convex_hull(
        shapely.multipoints(corners[:, :, :2].reshape(-1, 2), indices=row)
    )
    return shapes


def over(shape: shapely.Geometry, corners: NDArray[np.float64]) -> NDArray[np.bool_]:
    shapely.prepare(shape)
    return np.asarray(shapely.intersects(shape, flat(corners)))


def same(one: MeshPart, other: MeshPart) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ("vertices", "faces", "material"))


def test_a_street_without_bays_has_the_mesh_that_it_had(monkeypatch: pytest.MonkeyPatch) -> None:
    site = street(parking=False)
    now = join(beside(site, 1))
    monkeypatch.setattr(build, "behind_bays", lambda *_: [])
    assert len(now.faces) > 5000
    assert same(now, join(beside(site, 1)))


def test_one_seed_gives_one_mesh() -> None:
    assert same(planted(1), join(beside(street(parking=True), 1)))
    assert len(planted(1).faces) != len(planted(2).faces)


@pytest.mark.parametrize("seed", SEEDS)
def test_nothing_stands_on_the_carriageway_or_in_a_bay(seed: int) -> None:
    corners = triangles(planted(seed))
    low = corners[corners[:, :, 2].min(axis=1) < 1.4]
    assert len(low) > 5000
    assert not over(street(parking=True).streets.road, low).any()


@pytest.mark.slow
def test_crowns_hang_over_bays_and_over_the_carriageway_from_its_clearance_on() -> None:
    lowest = []
    carriageway = shapely.box(WINDOW[0], -KERB_M + 0.01, WINDOW[2], KERB_M - 0.01)
    reaching = 0
    for seed in SEEDS:
        corners = triangles(planted(seed))
        above = corners[over(carriageway, corners)]
        reaching += len(above)
        assert above[:, :, 2].min(initial=np.inf) > 4.5
        cars = corners[over(shapely.union_all(bays()), corners)]
        lowest.append(cars[:, :, 2].min())
    assert reaching > 0
    assert 1.4 < min(lowest) < 2.7


def _tall_behind(part: MeshPart) -> NDArray[np.bool_]:
    """Return behind which bays something is taller than 1.5 m, within 1.5 m."""
    corners = triangles(part)
    tall = flat(corners[corners[:, :, 2].max(axis=1) > 1.5])
    (_, width), found = BAY_M, []
    for bay in bays():
        low_x, low_y, high_x, _ = bay.bounds
        back = low_y - 1.5 if low_y < 0 else low_y + width
        strip = shapely.box(low_x, back, high_x, back + 1.5)
        shapely.prepare(strip)
        found.append(shapely.intersects(strip, tall).any())
    return np.array(found)


@pytest.mark.slow
def test_something_tall_stands_right_behind_most_bays() -> None:
    now = np.concatenate([_tall_behind(planted(seed)) for seed in SEEDS])
    before = np.concatenate([_tall_behind(without_bays(seed)) for seed in SEEDS])
    assert now.mean() > 0.85
    assert before.mean() < 0.2


def test_density_0_plants_nothing() -> None:
    bare = planted(1, 0.0)
    assert not np.isin(bare.material, PLANTS).any()
    assert same(bare, without_bays(1, 0.0))
