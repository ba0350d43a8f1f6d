"""Vehicles put a second time, right beside what stands: in the scenes of training they seldom are, on roads often.

In a sample of one agent, a vehicle is copied with its points and turned about the sensor: the copy has the same range
and shows the same side. Of the places where nothing is in its way, it takes the one with most beside it that is as tall
as a vehicle: hedges, walls, crowns of trees, other vehicles. What lies behind it in the same beams vanishes, and so do
its own points behind something nearer.

`dsrc.realism.transplant` does the same in sweeps, by the hull of a vehicle and the sensor's own beams, for figures that
are published. Here it is compiled loops over cells of directions, some milliseconds a vehicle: a training pastes often.

Source: cut and paste as an augmentation is of Y. Yan et al., SECOND, Sensors 18 (2018).
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dsrc.data.points_in_boxes import points_in_boxes
from dsrc.data.sample import Sample
from dsrc.ops.ground import LIDAR_M
from sensors.compiled import compiled
from sim.boxes import Boxes, concatenate
from sim.geometry import wrap_angle

_FEWEST = 20
"""Fewest points of a vehicle that is put somewhere else, and that it leaves what it hides in part: boxes without points
teach a network to guess."""
_KEPT = 0.5
"""Least share of its points that are seen there."""
_TURNS = 90
"""Number of the turns that are tried, evenly spread."""
_MOST = 6
"""Most vehicles that one sample gets."""
_CELL_M, _REACH_M = 0.4, 60.0
_EGO_M = (2.8, 1.2)
"""Half sides of the ego around its sensor, m; its own points are no part of its cloud."""
_CLEAR_M = 0.35
"""Height above the ground of what is in the way."""
_TALL_M = (0.8, 3.0)
"""Heights above the ground of what makes a place crowded."""
_FEWEST_TALL = 12
"""Fewest points beside a place that makes it crowded."""
_BESIDE_M = 1.4
"""Distance from the box within which these count."""
_SKIN_M = 0.1
_BEAM_RAD = math.radians(0.4)
_LOWEST_RAD, _ROWS = math.radians(-40.0), 160
"""Lowest elevation and number of the cells of directions, squares of one beam."""
_BEFORE_M = 0.5
"""What is this much nearer than a point hides it."""


def crowded(sample: Sample, share: float, rng: np.random.Generator) -> Sample:
    """Return a sample of one agent with some of its vehicles put a second time right beside what stands.

    Args:
        sample: on level ground `LIDAR_M` below its origin, with the sensor at the origin; one of several agents, or of
            a corrupted sensor, stays.
        share: probability that a vehicle is put somewhere else too.
    """
    if share == 0 or len(sample.clouds) != 1 or sample.corrupted:
        return sample
    cloud, boxes = sample.clouds[0], sample.boxes
    start, chosen = int(rng.integers(_TURNS)), rng.random(len(boxes)) < share
    rows, owners = points_in_boxes(boxes, cloud, margin=_SKIN_M)
    on_ground = cloud[rows, 2] <= (boxes.center[:, 2] - 0.5 * boxes.size[:, 2] + _SKIN_M)[owners]
    rows, owners = rows[~on_ground], owners[~on_ground]
    owner = np.full(len(cloud), -1)
    owner[rows] = owners
    fewest = np.minimum(np.bincount(owner[owner >= 0], minlength=len(boxes)), _FEWEST)
    standing = _counts(cloud, _CLEAR_M, _TALL_M[1])
    _stand_ego(standing)
    tall = _counts(cloud, *_TALL_M)
    placed: list[Boxes] = []
    following = int(boxes.object_id.max(initial=0)) + 1
    cells = _directions(cloud)
    for row in np.flatnonzero(chosen & boxes.is_vehicle):
        own, box = sample.clouds[0][rows[owners == row]], boxes[row : row + 1]
        if len(own) < _FEWEST or len(placed) == _MOST:
            continue
        taken = concatenate([boxes, *placed])
        turn = _place(box.array[0], taken.array, standing, tall, start)
        if not np.isfinite(turn):
            continue
        points = _turned(own, turn)
        own_cells = _directions(points)
        seen = ~_hidden(points, own_cells, cloud, cells)
        if seen.sum() < max(_FEWEST, _KEPT * len(own)):
            continue
        rest = ~_behind(cloud, cells, points, own_cells)
        left = np.bincount(owner[rest & (owner >= 0)], minlength=len(fewest))
        if (left < fewest).any():
            continue
        cloud = np.concatenate([cloud.compress(rest, axis=0), points[seen]])
        cells = np.concatenate([cells.compress(rest, axis=0), own_cells[seen]])
        owner = np.concatenate([owner[rest], np.full(seen.sum(), len(taken))])
        fewest = np.append(fewest, _FEWEST)
        center = _turned(box.center.astype(np.float32), turn).astype(np.float64)
        new = replace(
            box,
            center=center,
            yaw=wrap_angle(box.yaw + turn),
            object_id=np.array([following + len(placed)]),
        )
        placed.append(new)
    if not placed:
        return sample
    return replace(
        sample,
        clouds=(cloud,),
        boxes=concatenate([boxes, *placed]),
        agent_boxes=(concatenate([sample.agent_boxes[0], *placed]),),
    )


def _turned(points: NDArray[np.float32], turn_rad: float) -> NDArray[np.float32]:
    """Turn (P, 3 or more) points about the vertical axis."""
    moved, (c, s) = points.copy(), (np.float32(math.cos(turn_rad)), np.float32(math.sin(turn_rad)))
    moved[:, 0] = c * points[:, 0] - s * points[:, 1]
    moved[:, 1] = s * points[:, 0] + c * points[:, 1]
    return moved


@compiled()
def _counts(cloud: NDArray[np.float32], low_m: float, high_m: float) -> NDArray[np.int32]:
    """Count the points between two heights above the ground in square cells around the origin."""
    side = int(2.0 * _REACH_M / _CELL_M)
    found = np.zeros((side, side), np.int32)
    for k in range(len(cloud)):
        above = cloud[k, 2] + LIDAR_M
        if above > low_m and above < high_m:
            i, j = int((cloud[k, 0] + _REACH_M) / _CELL_M), int((cloud[k, 1] + _REACH_M) / _CELL_M)
            if i >= 0 and i < side and j >= 0 and j < side:
                found[i, j] += 1
    return found


def _stand_ego(standing: NDArray[np.int32]) -> None:
    """Let the ego stand in the middle of the cells, in place."""
    ahead, aside = (math.ceil(half / _CELL_M) for half in _EGO_M)
    middle = len(standing) // 2
    standing[middle - ahead : middle + ahead, middle - aside : middle + aside] += 1


@compiled()
def _place(
    box: NDArray[np.float64],
    taken: NDArray[np.float64],
    standing: NDArray[np.int32],
    tall: NDArray[np.int32],
    start: int,
) -> float:
    """Return the turn, rad, to the most crowded place that is free for a box; NaN where none is.

    Args:
        box: (7,) x, y, z, l, w, h, yaw.
        taken: (N, 7) boxes that it must not touch.
        standing: counts of what is in the way.
        tall: counts of what makes a place crowded.
        start: number of the first turn; of equal ones the first is taken.
    """
    best, most = np.nan, _FEWEST_TALL - 1
    away = np.hypot(box[0], box[1])
    if away < 0.5 * box[3] + 1.0 or away > _REACH_M - 8.0:
        return best
    reach = np.hypot(box[3], box[4]) * 0.5
    for k in range(1, _TURNS):
        turn = 2.0 * np.pi * ((start + k) % _TURNS) / _TURNS
        c, s = np.cos(turn), np.sin(turn)
        x, y = c * box[0] - s * box[1], s * box[0] + c * box[1]
        free = True
        for n in range(len(taken)):
            if np.hypot(taken[n, 0] - x, taken[n, 1] - y) < reach + 0.5 * np.hypot(taken[n, 3], taken[n, 4]):
                free = False
                break
        if not free:
            continue
        found = _crowd(x, y, box[3], box[4], box[6] + turn, standing, tall)
        if found > most:
            best, most = turn, found
    return best


@compiled()
def _crowd(
    x: float,
    y: float,
    length: float,
    width: float,
    yaw: float,
    standing: NDArray[np.int32],
    tall: NDArray[np.int32],
) -> int:
    """Return the tall points beside a footprint; -1 if something stands in it."""
    c, s = np.cos(yaw), np.sin(yaw)
    ahead, aside = 0.5 * length, 0.5 * width
    # A point of a cell lies at most half its diagonal from its middle.
    skin = _CELL_M / np.sqrt(2.0)
    around = np.hypot(ahead, aside) + np.sqrt(2.0) * _BESIDE_M
    first_i, first_j = int((x - around + _REACH_M) / _CELL_M), int((y - around + _REACH_M) / _CELL_M)
    more = int(2.0 * around / _CELL_M) + 2
    found = 0
    for i in range(max(first_i, 0), min(first_i + more, len(standing))):
        for j in range(max(first_j, 0), min(first_j + more, len(standing))):
            dx, dy = (i + 0.5) * _CELL_M - _REACH_M - x, (j + 0.5) * _CELL_M - _REACH_M - y
            along, across = abs(c * dx + s * dy), abs(c * dy - s * dx)
            if along <= ahead + skin and across <= aside + skin:
                if standing[i, j] > 0:
                    return -1
            elif along <= ahead + _BESIDE_M and across <= aside + _BESIDE_M:
                found += tall[i, j]
    return found


@compiled(inline="always")
def _direction(x: float, y: float, z: float) -> tuple[int, int]:
    columns = int(2.0 * np.pi / _BEAM_RAD)
    column = int((np.arctan2(y, x) + np.pi) / (2.0 * np.pi) * columns) % columns
    row = int((np.arctan2(z, np.hypot(x, y)) - _LOWEST_RAD) / _BEAM_RAD)
    return column, min(max(row, 0), _ROWS - 1)


@compiled()
def _directions(points: NDArray[np.float32]) -> NDArray[np.int32]:
    """Return (P, 2) cells of directions of points, azimuth and elevation."""
    cells = np.zeros((len(points), 2), np.int32)
    for k in range(len(points)):
        cells[k, 0], cells[k, 1] = _direction(points[k, 0], points[k, 1], points[k, 2])
    return cells


@compiled()
def _hidden(
    points: NDArray[np.float32], own: NDArray[np.int32], cloud: NDArray[np.float32], cells: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Return which points of a vehicle something that stands nearer in the cloud hides."""
    columns = int(2.0 * np.pi / _BEAM_RAD)
    nearest = np.full((columns, _ROWS), np.inf, np.float32)
    for k in range(len(cloud)):
        if cloud[k, 2] + LIDAR_M > _CLEAR_M:
            i, j = cells[k]
            nearest[i, j] = min(nearest[i, j], np.hypot(cloud[k, 0], cloud[k, 1]))
    hidden = np.zeros(len(points), np.bool_)
    for k in range(len(points)):
        limit = np.hypot(points[k, 0], points[k, 1]) - _BEFORE_M
        for i in range(own[k, 0] - 1, own[k, 0] + 2):
            if nearest[i % columns, own[k, 1]] < limit:
                hidden[k] = True
    return hidden


@compiled()
def _behind(
    cloud: NDArray[np.float32], cells: NDArray[np.int32], points: NDArray[np.float32], own: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Return which points of a cloud lie behind a vehicle, between its lowest and highest beam in their column."""
    columns = int(2.0 * np.pi / _BEAM_RAD)
    nearest = np.full(columns, np.inf, np.float32)
    low, high = np.full(columns, _ROWS, np.int32), np.full(columns, -1, np.int32)
    for k in range(len(points)):
        away = np.hypot(points[k, 0], points[k, 1])
        for i in range(own[k, 0] - 1, own[k, 0] + 2):
            column = i % columns
            nearest[column] = min(nearest[column], away)
            low[column], high[column] = min(low[column], own[k, 1]), max(high[column], own[k, 1])
    behind = np.zeros(len(cloud), np.bool_)
    for k in range(len(cloud)):
        i, j = cells[k]
        behind[k] = j >= low[i] and j <= high[i] and np.hypot(cloud[k, 0], cloud[k, 1]) > nearest[i]
    return behind
