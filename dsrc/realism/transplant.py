"""Road users cut out of sweeps and pasted into others: whether a detector fails for the vehicle or for its place.

A vehicle goes with its points, turned about the sensor: it keeps its range and shows the sensor the same side. It comes
to stand on the ground there, where nothing else stands. What lies behind it in the same beams vanishes, and so do its
own points behind something nearer. If vehicles of one drive are found in the places of another, and the others' are not
found in theirs, the places are what is hard.

Source: cut and paste as an augmentation is of Y. Yan et al., SECOND, Sensors 18 (2018); occlusion by the sensor's rays
as in J. Fang et al., LiDAR-Aug, CVPR 2021.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Delaunay, QhullError, cKDTree
from scipy.stats import binomtest

from dsrc.data.points_in_boxes import points_in_boxes
from dsrc.ops.detections import Detections
from dsrc.ops.ground import Ground, fit_ground
from dsrc.ops.iou import bev_iou
from dsrc.tables.table import Column, Stat, Table, TableRow
from sensors.sweep import POINT_FIELDS, Sweep
from sim.boxes import Boxes, concatenate
from sim.geometry import wrap_angle

FEWEST_POINTS = 5
"""Fewest points of a vehicle that is cut out, and of one that is left where it is pasted."""
REACH_M = (50.0, 25.0)
"""Greatest |x| and |y| of vehicles that are cut out and of places."""
SCORE, IOU = 0.2, 0.5
"""Confidence and bird's-eye overlap with which a vehicle is found."""

_MARGIN_M = 0.1
_CLEAR_M = 0.3
"""Margin of the boxes whose points are a vehicle's, and of a place that has to be free; least height of what stands."""
_BEAM_DEG = (0.2, 0.4)
"""Azimuth and elevation from beam to beam of an unknown sensor."""
_BEFORE_M = 0.5
"""What is this much nearer than a point of a pasted vehicle hides it."""
_TURNS = 72
_LEVEL = 0.95

Scene = tuple[Sweep, Boxes]
"""Sweep of a vehicle and the boxes of all others in the sensor's frame, as `dsrc.realism.figures.sweeps_of` gives."""


@dataclass(frozen=True, slots=True, eq=False)
class Cutting:
    """A vehicle cut out of a sweep.

    Attributes:
        box: one row, in the sensor's frame.
        points: its returns.
        above_m: height of the box's bottom above the ground below it.
    """

    box: Boxes
    points: Sweep
    above_m: float


def cut(sweep: Sweep, boxes: Boxes) -> list[Cutting]:
    """Return the near vehicles of a sweep that have a few points, without the ground that lies in their boxes.

    Args:
        boxes: road users in the sensor's frame.
    """
    ground = fit_ground(sweep.points)
    rows, owners = points_in_boxes(boxes, sweep.points, margin=_MARGIN_M)
    cuttings = []
    for row in np.flatnonzero(boxes.is_vehicle & _near(boxes)):
        own, box = sweep[rows[owners == row]], boxes[row : row + 1]
        bottom = box.center[:, 2] - 0.5 * box.size[:, 2]
        own = own[own.points[:, 2] > bottom + _MARGIN_M]
        if len(own) >= FEWEST_POINTS:
            cuttings.append(Cutting(box, own, float((bottom - ground.at(box.center))[0])))
    return cuttings


def without(sweep: Sweep, cutting: Cutting) -> Sweep:
    """Return the sweep without the points of a vehicle that was cut out of it."""
    rows, _ = points_in_boxes(cutting.box, sweep.points, margin=_MARGIN_M)
    kept = np.ones(len(sweep), bool)
    kept[rows] = sweep.points[rows, 2] <= cutting.box.center[0, 2] - 0.5 * cutting.box.size[0, 2] + _MARGIN_M
    return sweep[kept]


def paste(sweep: Sweep, cutting: Cutting, turn_rad: float, ground: Ground) -> tuple[Sweep, Boxes]:
    """Paste a vehicle into a sweep.

    Args:
        turn_rad: by which it is turned about the sensor, counter-clockwise.
        ground: below the sweep.

    Returns:
        The sweep, its own points first, and the vehicle's box.
    """
    box, points = _turned(cutting, turn_rad, ground)
    hidden = _behind(sweep, points)
    seen = ~_covered(points, sweep[~hidden])
    moved = replace(cutting.points, points=points.astype(np.float32))[seen]
    rest = sweep[~hidden]
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(rest, name), getattr(moved, name)]) for name in POINT_FIELDS
    }
    return replace(rest, **columns), box


def place(
    sweep: Sweep, boxes: Boxes, cuttings: Sequence[Cutting], rng: np.random.Generator
) -> tuple[Sweep, Boxes, list[int]]:
    """Paste vehicles where the ground is free and they are seen, one after the other.

    Args:
        boxes: road users of the sweep, in the sensor's frame.
        rng: draws where the search for a place begins.

    Returns:
        The sweep, the boxes of the pasted vehicles and their rows in `cuttings`; those without a place are left out.
    """
    ground = fit_ground(sweep.points)
    placed, rows = Boxes.zeros(), []
    for row, cutting in enumerate(cuttings):
        start = int(rng.integers(_TURNS))
        for k in range(_TURNS):
            turn = 2.0 * math.pi * ((start + k) % _TURNS) / _TURNS
            box, points = _turned(cutting, turn, ground)
            if not _free(sweep, concatenate([boxes, placed]), box, ground):
                continue
            if (~_covered(points, sweep)).sum() < max(FEWEST_POINTS, 0.5 * len(points)):
                continue
            after, box = paste(sweep, cutting, turn, ground)
            # What was pasted before stays seen.
            if all((_in(after, one) >= FEWEST_POINTS).all() for one in (placed, box)):
                sweep, placed = after, concatenate([placed, box])
                rows.append(row)
                break
    return sweep, placed, rows


@dataclass(frozen=True, slots=True)
class PlaceRow:
    """Vehicles of one source in the places of another.

    Attributes:
        vehicles, places: names of the sources.
        count: vehicles.
        found: those that were found.
        moved: they are elsewhere than where they were.
    """

    vehicles: str
    places: str
    count: int
    found: int
    moved: bool = True

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's interval of the recall; NaN without vehicles."""
        if self.count == 0:
            return math.nan, math.nan
        found = binomtest(self.found, self.count).proportion_ci(_LEVEL, "wilson")
        return float(found.low), float(found.high)


def recall_by_place(
    sources: Mapping[str, Sequence[Scene]], detect: Callable[[Sweep], Detections], seed: int = 0
) -> list[PlaceRow]:
    """Return how many vehicles are found where they were, elsewhere in their sweeps, and in those of other sources.

    Args:
        sources: scenes by name; the i-th scene's vehicles go into the i-th of each source, which begins anew at its
            end.
        detect: a detector, boxes in the sensor's frame.
        seed: of the places.
    """
    cuttings = {name: [cut(*scene) for scene in scenes] for name, scenes in sources.items()}
    rows = []
    for vehicles, own in cuttings.items():
        boxes = [concatenate([one.box for one in some]) if some else Boxes.zeros() for some in own]
        hits = [
            _found(detect(sweep), box) for (sweep, _), box in zip(sources[vehicles], boxes, strict=True) if len(box)
        ]
        rows.append(PlaceRow(vehicles, vehicles, sum(map(len, boxes)), sum(hits), moved=False))
        for places, scenes in sources.items():
            if not scenes:
                continue
            count = found = 0
            for index, some in enumerate(own):
                scene, there = scenes[index % len(scenes)]
                sweep, placed, _ = place(scene, there, some, np.random.default_rng([seed, index]))
                if len(placed):
                    count += len(placed)
                    found += _found(detect(sweep), placed)
            rows.append(PlaceRow(vehicles, places, count, found))
    return rows


def place_table(rows: Sequence[PlaceRow]) -> Table:
    """Table of recall by vehicles and places, %, with its 95 % interval."""
    columns = (
        *(Column("places", align="left"), Column("vehicles"), Column("found")),
        *(Column(name, ("",), scale=100.0, digits=0) for name in ("recall", "from", "to")),
    )
    lines = []
    for row in rows:
        recall = row.found / row.count if row.count else math.nan
        numbers = tuple((Stat(value),) for value in (recall, *row.interval))
        where = row.places if row.places != row.vehicles else "elsewhere there" if row.moved else "where they were"
        lines.append(TableRow(row.vehicles, (where, row.count, row.found, *numbers)))
    caption = (
        f"Vehicles with {FEWEST_POINTS} points, found with a score of {SCORE} at IoU {IOU}; Wilson's 95 % interval."
    )
    return Table("places", "The vehicle or its place", "vehicles of", columns, tuple(lines), caption)


def _turned(cutting: Cutting, turn_rad: float, ground: Ground) -> tuple[Boxes, NDArray[np.float64]]:
    """Return box and points turned about the sensor and put on the ground there."""
    cosine, sine = math.cos(turn_rad), math.sin(turn_rad)
    rotation = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    center = cutting.box.center @ rotation.T
    lift = ground.at(center)[0] + cutting.above_m + 0.5 * cutting.box.size[0, 2] - center[0, 2]
    up = np.array([0.0, 0.0, lift])
    box = replace(cutting.box, center=center + up, yaw=wrap_angle(cutting.box.yaw + turn_rad))
    return box, cutting.points.points.astype(np.float64) @ rotation.T + up


def _free(sweep: Sweep, boxes: Boxes, box: Boxes, ground: Ground) -> bool:
    """Return whether the ground of a place is known and nothing stands or drives in it."""
    room = replace(box, size=box.size + np.array([2.0 * _CLEAR_M, 2.0 * _CLEAR_M, 2.0]))
    if not _near(box).all():
        return False
    if not ground.knows(box.center)[0] or np.hypot(*box.center[0, :2]) < 0.5 * room.size[0, 0] + 1.0:
        return False
    if len(boxes) and bev_iou(room.array, boxes.array).any():
        return False
    rows, _ = points_in_boxes(room, sweep.points)
    inside = sweep.points[rows]
    return not (inside[:, 2] - ground.at(inside) > _CLEAR_M).any()


def _near(boxes: Boxes) -> NDArray[np.bool_]:
    """Return (N,) boxes that detectors of any range should find."""
    return np.asarray((np.abs(boxes.center[:, :2]) < REACH_M).all(axis=1))


def _in(sweep: Sweep, boxes: Boxes) -> NDArray[np.intp]:
    """Return (N,) points in boxes."""
    return np.bincount(points_in_boxes(boxes, sweep.points, margin=_MARGIN_M)[1], minlength=len(boxes))


def _angles(points: NDArray[np.floating], azimuth_rad: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (P, 2) azimuth from a given one and elevation, deg, and (P,) range, m."""
    xyz = points.astype(np.float64)
    away = np.hypot(xyz[:, 0], xyz[:, 1])
    azimuth = wrap_angle(np.arctan2(xyz[:, 1], xyz[:, 0]) - azimuth_rad)
    return np.degrees(np.stack([azimuth, np.arctan2(xyz[:, 2], away)], axis=1)), np.hypot(away, xyz[:, 2])


def _middle(points: NDArray[np.floating]) -> float:
    return float(np.arctan2(points[:, 1].mean(), points[:, 0].mean()))


def _behind(sweep: Sweep, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (P,) points of a sweep in the beams of a vehicle's hull and farther than it."""
    hidden = np.zeros(len(sweep), bool)
    about = _middle(points)
    own, own_range = _angles(points, about)
    angles, away = _angles(sweep.points, about)
    near = np.flatnonzero((angles >= own.min(axis=0)).all(axis=1) & (angles <= own.max(axis=0)).all(axis=1))
    try:
        outline = own[ConvexHull(own).vertices]
    except QhullError:  # points in a line hide nothing
        return hidden
    near = near[Delaunay(outline).find_simplex(angles[near]) >= 0]
    if len(near):
        nearest = cKDTree(own).query(angles[near])[1]
        hidden[near] = away[near] > own_range[nearest]
    return hidden


def _covered(points: NDArray[np.float64], sweep: Sweep) -> NDArray[np.bool_]:
    """Return (P,) points of a vehicle that something nearer in the sweep hides."""
    about = _middle(points)
    own, own_range = _angles(points, about)
    angles, away = _angles(sweep.points, about)
    beam = _beam_deg(sweep)
    low, high = own.min(axis=0) - beam, own.max(axis=0) + beam
    near = np.flatnonzero((angles >= low).all(axis=1) & (angles <= high).all(axis=1) & (away < own_range.max()))
    if not len(near):
        return np.zeros(len(points), bool)
    around = cKDTree(angles[near] / beam).query_ball_point(own / beam, 0.75, p=np.inf)
    return np.array(
        [
            bool((away[near[rows]] < distance - _BEFORE_M).any())
            for rows, distance in zip(around, own_range, strict=True)
        ]
    )


def _beam_deg(sweep: Sweep) -> NDArray[np.float64]:
    """Return azimuth and elevation from beam to beam, deg."""
    spec = sweep.spec
    if spec is None or spec.prisms or spec.rings < 2:
        return np.array(_BEAM_DEG)
    width = (spec.azimuth_end_deg - spec.azimuth_start_deg) / spec.columns
    return np.array([width, max(float(np.median(-np.diff(spec.elevation_deg))), 0.05)])


def _found(detections: Detections, boxes: Boxes) -> int:
    """Return how many boxes are found, each by the best of the detections that no other has."""
    sure = detections[detections.score >= SCORE]
    if not len(sure) or not len(boxes):
        return 0
    overlap, free = bev_iou(sure.boxes.array, boxes.array), np.ones(len(boxes), bool)
    for row in np.argsort(-sure.score, kind="stable"):
        best = int(np.where(free, overlap[row], -1.0).argmax())
        free[best] &= overlap[row, best] < IOU
    return int((~free).sum())
