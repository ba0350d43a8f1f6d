"""Levelling: level sensor frames, in which a box has one angle, and degrees of occlusion for labels."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sensors.sweep import Sweep
from sim.geometry import invert, pose_angles, pose_matrix, transform_points

_LEVEL = 1e-9
_WHOLE, _HALF = 0.95, 0.5


def levelled(sweep: Sweep) -> Sweep:
    """Return a sweep in the level frame at its sensor with the same heading; a level sweep is returned unchanged."""
    yaw, pitch, roll = pose_angles(sweep.world_from_lidar)
    if max(abs(float(pitch)), abs(float(roll))) < _LEVEL:
        return sweep
    level = pose_matrix(sweep.world_from_lidar[:3, 3], yaw)
    points = transform_points(invert(level) @ sweep.world_from_lidar, sweep.points)
    return replace(sweep, points=points.astype(np.float32), world_from_lidar=level, path=None)


def occlusion(visible_fraction: NDArray[np.floating]) -> NDArray[np.int64]:
    """Return degrees of occlusion as KITTI and DAIR-V2X count: 0 visible, 1 partly hidden, 2 mostly hidden.

    Args:
        visible_fraction: see `sensors.frame.Frame`; NaN (not measured) counts as visible.
    """
    known = np.nan_to_num(np.asarray(visible_fraction, np.float64), nan=1.0)
    return np.select([known >= _WHOLE, known >= _HALF], [0, 1], 2)
