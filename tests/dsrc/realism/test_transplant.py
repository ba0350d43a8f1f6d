"""Cut and paste: vehicles keep their range and side, hide what is behind them and stand free on the ground."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from dsrc.ops.detections import Detections
from dsrc.ops.ground import fit_ground
from dsrc.ops.iou import bev_iou
from dsrc.realism.transplant import (
    FEWEST_POINTS,
    Cutting,
    PlaceRow,
    Scene,
    cut,
    paste,
    place,
    place_table,
    recall_by_place,
    without,
)
from sensors.scan.lidar import scan
from sensors.scan.scene import RayScene
from sensors.sweep import STATIC, Sweep, make_sweep
from sim.boxes import Boxes, concatenate
from sim.geometry import invert, pose_matrix
from tests.sensors.fakes import box, box_body, cars, ground, ideal

SENSOR = pose_matrix([0.0, 0.0, 1.9])
FAR_WALL = box((0.5, 60.0, 6.0), (25.0, 0.0, 3.0))


@lru_cache(maxsize=4)
def scene(
    walled: bool = False, rows: tuple[tuple[float, float, float], ...] = ((12.0, 4.0, 0.4), (-10.0, 3.0, 0.0))
) -> Scene:
    """A sweep between cars on a plane, and their boxes in the sensor's frame."""
    static = ground() + FAR_WALL if walled else ground()
    static.face_attributes["material"] = np.zeros(len(static.faces), np.uint8)
    actors = cars(rows)
    made = RayScene(static, body_mesh=box_body).with_bodies(actors)
    sweep = scan(made, ideal(columns=1800), SENSOR, SENSOR, 0.0, np.random.default_rng(0))
    return sweep, actors.boxes.transform(invert(SENSOR))


def test_a_vehicle_is_cut_with_its_points_and_without_the_ground() -> None:
    sweep, boxes = scene()
    cuttings = cut(sweep, boxes)
    assert len(cuttings) == 2
    for cutting, object_id in zip(cuttings, boxes.object_id, strict=True):
        assert (cutting.points.object_id == object_id).all()
        assert len(cutting.points) > 0.8 * (sweep.object_id == object_id).sum()
        assert cutting.above_m == pytest.approx(0.0, abs=0.05)


def test_a_vehicle_pasted_where_it_was_is_as_before() -> None:
    sweep, boxes = scene()
    cutting = cut(sweep, boxes)[0]
    bare = without(sweep, cutting)
    again, there = paste(bare, cutting, 0.0, fit_ground(sweep.points))
    assert len(bare) == len(sweep) - len(cutting.points)
    assert sorted_rows(again) == pytest.approx(sorted_rows(sweep), abs=0.05)
    np.testing.assert_allclose(there.array, cutting.box.array, atol=0.05)


def test_it_keeps_its_range_and_its_side_and_stands_on_the_ground() -> None:
    sweep, boxes = scene()
    cutting, turn = cut(sweep, boxes)[0], np.pi / 2
    _, there = paste(sweep, cutting, turn, fit_ground(sweep.points))
    x, y = cutting.box.center[0, :2]
    np.testing.assert_allclose(there.center[0, :2], [-y, x], atol=1e-9)
    assert there.yaw[0] == pytest.approx(cutting.box.yaw[0] + turn)
    assert there.center[0, 2] - 0.5 * there.size[0, 2] == pytest.approx(-SENSOR[2, 3], abs=0.05)


def test_what_is_behind_vanishes_and_nothing_else() -> None:
    bare, there = scene(walled=True, rows=((-10.0, 3.0, 0.0),))
    cutting = cut(*scene())[0]
    after, placed = paste(bare, cutting, 0.0, fit_ground(bare.points))
    # The scene with the car in it is what the sensor sees; the pasted one has the same shadow up to a beam.
    true, _ = scene(walled=True)
    gone = ~np.isin(keys(bare), keys(after[: -len(cutting.points)]))
    shadow = ~np.isin(keys(bare), keys(true[true.object_id == STATIC])) & (bare.object_id == STATIC)
    assert gone.sum() > 100 and len(there) == 1 and len(placed) == 1
    assert (gone & ~shadow).sum() <= 0.02 * shadow.sum()
    assert (gone & shadow).sum() >= 0.8 * shadow.sum()
    wall = gone & (bare.points[:, 0] > 20.0)
    assert wall.sum() > 20


def test_its_points_behind_something_nearer_vanish() -> None:
    cutting = cut(*scene())[0]
    sweep, _ = scene(rows=((6.0, 2.0, 0.4), (-10.0, 3.0, 0.0)))
    after, _ = paste(sweep, cutting, 0.0, fit_ground(sweep.points))
    left = len(after) - np.isin(keys(sweep), keys(after)).sum()
    assert left < 0.3 * len(cutting.points)
    aside, _ = paste(sweep, cutting, np.pi / 2, fit_ground(sweep.points))
    assert len(aside) - np.isin(keys(sweep), keys(aside)).sum() == len(cutting.points)


def test_places_are_free_seen_and_apart() -> None:
    sweep, boxes = scene(walled=True)
    cuttings = cut(sweep, boxes) * 3
    after, placed, rows = place(sweep, boxes, cuttings, np.random.default_rng(1))
    assert rows == list(range(len(cuttings))) and len(placed) == len(cuttings)
    overlap = bev_iou(concatenate([boxes, placed]).array, concatenate([boxes, placed]).array)
    assert not (overlap - np.diag(np.diag(overlap))).any()
    assert (placed.contains(after.points.astype(np.float64)).sum(axis=1) >= FEWEST_POINTS).all()
    # None stands in the wall.
    assert (placed.center[:, 0] < 25.0 - 1.5).all()
    np.testing.assert_allclose(
        np.hypot(*placed.center[:, :2].T), [np.hypot(*one.box.center[0, :2]) for one in cuttings], rtol=1e-9
    )


def test_where_everything_stands_full_nothing_is_pasted() -> None:
    cutting = cut(*scene())[0]
    rng = np.random.default_rng(0)
    xy = rng.uniform(-30, 30, (60000, 2))
    full = make_sweep(np.column_stack([xy, rng.uniform(-1.9, 1.0, len(xy))]))
    after, placed, rows = place(full, Boxes.zeros(), [cutting], rng)
    assert len(placed) == 0 and rows == [] and len(after) == len(full)


def test_a_detector_that_knows_one_corner_finds_what_is_put_there() -> None:
    here, there = scene(), scene(walled=True)

    def only_ahead(sweep: Sweep) -> Detections:
        """Find what stands on the plane where there is no wall."""
        walls = (sweep.points[:, 0] > 24.0) & (sweep.points[:, 2] > 0.5)
        found = Boxes.zeros() if walls.sum() > 100 else here[1]
        return Detections(found, np.full(len(found), 0.9, np.float32))

    rows = recall_by_place({"open": [here], "walled": [there]}, only_ahead)
    known = {(row.vehicles, row.places): row for row in rows if row.moved or row.places != row.vehicles}
    assert set(known) == {("open", "open"), ("open", "walled"), ("walled", "walled"), ("walled", "open")}
    assert known["open", "open"].found == 0 < known["open", "open"].count, "elsewhere the detector knows none"
    known |= {(row.vehicles, row.places): row for row in rows if not row.moved}
    assert known["open", "open"].found == known["open", "open"].count == 2
    assert known["open", "walled"].found == 0 == known["walled", "walled"].found
    text = place_table(rows).markdown()
    assert "where they were" in text and "elsewhere there" in text and "walled" in text


def test_an_interval_holds_the_recall_and_shrinks_with_the_count() -> None:
    few, many = PlaceRow("a", "b", 10, 8), PlaceRow("a", "b", 1000, 800)
    for row in (few, many):
        low, high = row.interval
        assert 0.0 <= low < 0.8 < high <= 1.0
    assert np.diff(many.interval)[0] < np.diff(few.interval)[0]
    assert np.isnan(PlaceRow("a", "b", 0, 0).interval).all()


def test_a_line_of_points_hides_nothing() -> None:
    sweep, boxes = scene()
    cutting = cut(sweep, boxes)[0]
    thin = Cutting(
        cutting.box, replace(cutting.points, points=np.repeat(cutting.points.points[:1], len(cutting.points), 0)), 0.0
    )
    after, _ = paste(sweep, thin, np.pi / 2, fit_ground(sweep.points))
    assert len(after) == len(sweep) + len(thin.points)


def keys(sweep: Sweep) -> np.ndarray:
    return np.ascontiguousarray(sweep.points.round(4)).view("V12").ravel()


def sorted_rows(sweep: Sweep) -> np.ndarray:
    points = sweep.points.round(2)
    return points[np.lexsort(points.T)]
