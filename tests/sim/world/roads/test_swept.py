"""Ground that long vehicles sweep: they stand on it, touch nothing there, and no island reaches into it."""

from collections.abc import Iterator
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import shapely
import trimesh

from sim.catalog.load import load_scenario
from sim.geometry import Array
from sim.mesh.materials import MATERIALS
from sim.scenario import Scenario
from sim.traffic.base import Actors
from sim.world.build import build_world
from sim.world.ground import streets_of
from sim.world.roads.kerbs import DROPPED_M, KERB_M
from sim.world.roads.swept import swept_axes, with_swept
from sim.world.standing import open_standing

GROUND = ("asphalt", "marking", "pavement", "kerb", "gravel", "ground")
SEED, LOW_M, RIM_M = 2, 0.3, 10.0
"""A seed with lorries, what a body clears below it, and the rim of the world where streets end, m."""


def driven(steps: int) -> Iterator[Actors]:
    with open_standing(uneven(), SEED) as traffic:
        for step in range(steps):
            actors = traffic.step()
            if step % 5 == 0:
                yield actors


def uneven(name: str = "ingolstadt") -> Scenario:
    return msgspec.structs.replace(load_scenario(name), world=2, warmup_s=20.0)


@pytest.fixture(scope="module")
def world() -> trimesh.Trimesh:
    return build_world(uneven(), SEED)


class Things:
    """Triangles of all that stands on the ground of a world."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        flat = [number for number, material in enumerate(MATERIALS) if material.name in GROUND]
        triangles = np.asarray(mesh.triangles)[~np.isin(mesh.face_attributes["material"], flat)]
        self._low, self._high = triangles[:, :, 2].min(axis=1), triangles[:, :, 2].max(axis=1)
        # Walls seen from above are lines.
        self._tree = shapely.STRtree(shapely.linestrings(triangles[:, [0, 1, 2, 0], :2]))

    def inside(self, actors: Actors) -> list[tuple[str, Array]]:
        """Return the name and the place of each road user whose box holds a part of a thing."""
        boxes = actors.boxes
        rows, faces = self._tree.query(shapely.buffer(shapely.polygons(boxes.bev_polygons()), -0.03), "intersects")
        bottom, top = (boxes.center[rows, 2] + sign * 0.5 * boxes.size[rows, 2] for sign in (-1.0, 1.0))
        hit = (self._high[faces] > bottom + LOW_M) & (self._low[faces] < top)
        return [(actors.name[row], boxes.center[row]) for row in np.unique(rows[hit])]


def test_nobody_floats_or_sinks_or_is_inside_anything(world: trimesh.Trimesh) -> None:
    things, streets = Things(world), streets_of(uneven(), SEED)
    x_min, y_min, x_max, y_max = streets.window
    longest = 0.0
    for actors in driven(400):
        boxes = actors.boxes
        x, y = boxes.center[:, :2].T
        within = (x > x_min + RIM_M) & (x < x_max - RIM_M) & (y > y_min + RIM_M) & (y < y_max - RIM_M)
        bottom = boxes.center[:, 2] - 0.5 * boxes.size[:, 2]
        assert np.abs(bottom - streets.height(boxes.center[:, :2]))[within].max() <= 0.05
        assert things.inside(actors) == []
        longest = max(longest, float(boxes.size[within, 0].max()))
    assert longest > 15.0


def test_what_stands_in_the_way_is_found(world: trimesh.Trimesh) -> None:
    actors = next(driven(1))
    wood = np.asarray(world.face_attributes["material"]) == [material.name for material in MATERIALS].index("bark")
    trunk = np.asarray(world.triangles)[wood][0].mean(axis=0)
    center = actors.boxes.center.copy()
    center[0] = trunk
    moved = replace(actors, boxes=replace(actors.boxes, center=center))
    assert [name for name, _ in Things(world).inside(moved)] == [actors.name[0]]


def test_corners_that_a_lorry_sweeps_are_even_and_their_kerb_is_dropped() -> None:
    streets = streets_of(uneven(), SEED)
    assert streets.land is not None and streets.swept.area > 100.0
    assert (streets.swept & streets.road).area < 0.01
    inner = shapely.get_coordinates(shapely.segmentize(streets.swept.buffer(-0.5).boundary, 1.0))
    rise = streets.land.height(inner) - streets.terrain.height(inner)
    np.testing.assert_allclose(np.median(rise), DROPPED_M, atol=0.02)


@pytest.mark.slow
def test_traffic_on_the_left_sweeps_the_mirrored_ground() -> None:
    streets = streets_of(uneven("four_way"), 1)
    lanes = tuple(replace(lane, line=lane.line * [1.0, -1.0]) for lane in streets.lanes)
    right, left = swept_axes(streets), swept_axes(replace(streets, lanes=lanes))
    assert len(right) == len(left) > 100
    there = shapely.get_coordinates(right) * [1.0, -1.0]
    np.testing.assert_allclose(shapely.get_coordinates(left), there, atol=1e-6)


def test_without_a_junction_nothing_is_swept() -> None:
    streets = streets_of(uneven("four_way"), 1)
    alone = replace(streets, lanes=tuple(lane for lane in streets.lanes if not lane.internal))
    assert len(swept_axes(alone)) == 0
    assert with_swept(alone, swept_axes(alone)).swept.is_empty


@pytest.mark.slow
def test_wide_junctions_have_islands_that_no_lane_leads_over_and_no_vehicle_stands_on(
    world: trimesh.Trimesh,
) -> None:
    streets = streets_of(uneven(), SEED)
    islands = streets.islands & shapely.box(*streets.area)
    assert len(shapely.get_parts(islands)) >= 5 and islands.area > 100.0
    assert (islands & streets.road).area < 0.01
    lanes = [lane for lane in streets.lanes if lane.kind in ("road", "bicycle", "crossing")]
    ways = [shapely.LineString(lane.line).buffer(0.5 * lane.width, cap_style="flat") for lane in lanes]
    assert (islands & shapely.union_all(ways)).area < 0.5
    assert streets.land is not None
    inner = np.array([part.representative_point().coords[0] for part in shapely.get_parts(islands)])
    rise = streets.height(inner) - streets.terrain.height(inner)
    np.testing.assert_allclose(np.median(rise), KERB_M, atol=0.05)
    # Something stands on most of those where nobody walks, more than a metre high.
    corners = np.asarray(world.vertices)
    low = corners[:, 2] - streets.terrain.height(corners[:, :2])
    tall = shapely.MultiPoint(corners[(low > 1.0) & (low < 5.0)][:, :2])
    shapely.prepare(tall)
    bare = [part for part in shapely.get_parts(islands) if not part.intersects(streets.on_foot)]
    assert np.mean([shapely.intersects(tall, part) for part in bare]) > 0.6
    for actors in driven(200):
        bodies = shapely.polygons(actors.boxes.bev_polygons()[actors.boxes.is_vehicle])
        assert shapely.area(shapely.intersection(bodies, islands)).max(initial=0.0) < 0.01


@pytest.mark.slow
def test_encounters_keep_their_junctions_free_of_islands() -> None:
    assert streets_of(uneven("braunschweig_lta_truck"), 1).islands.is_empty
