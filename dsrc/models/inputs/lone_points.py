"""Lone points: those with few neighbours for their range, as of flakes, drops and dust in the air.

A surface is met by several beams, a flake by one. The room between the points of a surface grows with range, so the
radius within which neighbours count does too.

Source: N. Charron, S. Phillips, S. Waslander: De-noising of LiDAR Point Clouds Corrupted by Snowfall, CRV 2018 (dynamic
radius outlier removal); steps, least radius and number of neighbours are theirs.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dsrc.data.sample import Sample
from sensors.compiled import compiled

STEP_RAD = np.radians(0.35)
"""Angle between neighbouring beams of a slow spinning sensor; finer sensors have more points within the radius."""
STEPS, LEAST_M, NEIGHBOURS = 3.0, 0.04, 3

_CELL_M, _CELLS = 0.5, 512
"""Side of a cell, m, and cells along each axis before they repeat."""
_NEXT = 8
"""Points before and after one in the cloud that are tried first: mostly its neighbours along a ring."""


def lone_points(cloud: NDArray[np.float32], origin: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (P,) whether a point has fewer than `NEIGHBOURS` others within `STEPS` steps, at least `LEAST_M`.

    Args:
        cloud: (P, 3 or more) x, y, z, m.
        origin: (3,) place of the sensor in the cloud's frame, m.
    """
    place = cloud[:, :3].astype(np.float64)
    radius = np.maximum(LEAST_M, STEPS * STEP_RAD * np.linalg.norm(place - origin, axis=1))
    column, row = np.floor(place[:, :2] / _CELL_M).astype(np.int64).T % _CELLS
    cell = row * _CELLS + column
    ends = np.bincount(cell, minlength=_CELLS**2).cumsum()
    return _lone(place, radius, np.argsort(cell, kind="stable"), ends, NEIGHBOURS)


def without_lone_points(sample: Sample) -> Sample:
    """Return a sample whose agents have dropped the lone points of their clouds, each by its own sensor's place."""
    clouds = zip(sample.clouds, sample.ego_from_agent, strict=True)
    return replace(sample, clouds=tuple(cloud[~lone_points(cloud, pose[:3, 3])] for cloud, pose in clouds))


@compiled(forceinline=True)
def _apart(place: NDArray[np.float64], i: int, j: int) -> float:
    """Return the squared distance of two points."""
    x, y, z = place[i, 0] - place[j, 0], place[i, 1] - place[j, 1], place[i, 2] - place[j, 2]
    return x * x + y * y + z * z


@compiled()
def _lone(
    place: NDArray[np.float64],
    radius: NDArray[np.float64],
    order: NDArray[np.int64],
    ends: NDArray[np.int64],
    least: int,
) -> NDArray[np.bool_]:
    """Return (P,) whether a point has fewer than `least` others within its radius.

    Args:
        place: (P, 3), m.
        radius: (P,), m.
        order: (P,) points cell by cell.
        ends: (cells,) place in the order after the last point of each cell.
    """
    lone = np.zeros(len(place), np.bool_)
    for i in range(len(place)):
        near, reach = -1, radius[i] ** 2  # itself does not count
        for j in range(max(i - _NEXT, 0), min(i + _NEXT + 1, len(place))):
            near += _apart(place, i, j) <= reach
        if near >= least:
            continue
        near = -1
        left, right = np.floor((place[i, 0] - radius[i]) / _CELL_M), np.floor((place[i, 0] + radius[i]) / _CELL_M)
        low, high = np.floor((place[i, 1] - radius[i]) / _CELL_M), np.floor((place[i, 1] + radius[i]) / _CELL_M)
        for row in range(int(low), int(high) + 1):
            for column in range(int(left), int(right) + 1):
                cell = row % _CELLS * _CELLS + column % _CELLS
                for k in range(ends[cell - 1] if cell else 0, ends[cell]):
                    near += _apart(place, i, order[k]) <= reach
        lone[i] = near < least
    return lone
