"""Tracks of the INTERACTION data set: a CSV of vehicles, and that of pedestrians and cyclists beside it.

Source: Zhan et al., INTERACTION dataset, arXiv:1910.03088, and the format of its versions 1.0 to 1.2: places are those
of the centres of boxes, m; times are milliseconds. The files of single scenes are `vehicle_tracks_000.csv` with
`pedestrian_tracks_000.csv`; those for prediction hold many cases, each with times and ids of its own.
"""

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.boxes import check_radians
from sim.errors import DataError, complaint
from sim.traffic.tracks.base import Recording, Track, class_of, heading_of_motion, make_track
from sim.traffic.tracks.columns import Columns, read_columns

SIGNATURE = frozenset({"track_id", "frame_id", "timestamp_ms", "agent_type"})
"""Columns by which the format is known."""
_NUMBERS = ("timestamp_ms", "x", "y", "psi_rad", "length", "width")
_OF_VEHICLES = ("psi_rad", "length", "width")
_CYCLIST_MPS = 3.5
"""Usual speed from which on one of `pedestrian/bicycle` rides: faster than a jog."""


def read_interaction(path: Path) -> tuple[Recording, ...]:
    """Read the recordings of a file, one for each `case_id`, or a single one.

    The heading of those without one is that of their motion. One of `pedestrian/bicycle` is a cyclist where its usual
    speed is above `_CYCLIST_MPS`.

    Raises:
        DataError: a column is missing or a value is wrong; names the line or the object.
    """
    files = [path]
    if path.name.startswith("vehicle_tracks"):
        walking = path.with_name(path.name.replace("vehicle", "pedestrian", 1))
        files += [walking] if walking.exists() else []
    tracks: dict[str, list[Track]] = {}
    for file in files:
        read = read_columns(file, _NUMBERS, ("track_id", "agent_type", "case_id"), optional=(*_OF_VEHICLES, "case_id"))
        for case, rows in read.groups("case_id").items():
            tracks.setdefault(case, []).extend(_tracks(file, read, rows))
    return tuple(Recording(tuple(listed), part=_part(case)) for case, listed in tracks.items())


def _part(case: str) -> str:
    """Return the name of a case: `case_7` for 7 and for 7.0."""
    return f"case_{case.removesuffix('.0')}" if case else ""


def _tracks(path: Path, read: Columns, rows: NDArray[np.int64]) -> list[Track]:
    by_name: dict[str, list[int]] = {}
    for row in rows.tolist():
        by_name.setdefault(read.texts["track_id"][row].removesuffix(".0"), []).append(row)
    return [_track(path, read, name, np.array(own)) for name, own in by_name.items()]


def _track(path: Path, read: Columns, name: str, rows: NDArray[np.int64]) -> Track:
    time_ms, x, y, yaw, length, width = (read.numbers[column][rows] for column in _NUMBERS)
    order = np.argsort(time_ms, kind="stable")
    time_s, xy = 1e-3 * time_ms[order], np.column_stack([x, y])[order]
    kind = read.texts["agent_type"][rows[0]].lower()
    walks = kind == "pedestrian/bicycle"
    if walks:
        speed = np.hypot(*np.diff(xy, axis=0).T) / np.maximum(np.diff(time_s), 1e-9)
        kind = "bicycle" if len(speed) and float(np.median(speed)) > _CYCLIST_MPS else "pedestrian"
    elif np.isnan(yaw).any() or np.isnan(length).any() or np.isnan(width).any():
        raise DataError(complaint(path, f"object '{name}'", "psi_rad, length and width of a vehicle", "none"))
    size = [float(np.median(length)), float(np.median(width)), math.nan]
    yaw = heading_of_motion(xy) if np.isnan(yaw).any() else yaw[order]
    check_radians(path, f"object '{name}': psi_rad", yaw)
    # Vehicles of all lengths are called cars.
    class_name = class_of(path, f"object '{name}': agent_type", "vehicle" if kind == "car" else kind, size[0])
    if class_name is None:
        raise DataError(complaint(path, f"object '{name}': agent_type", "a road user", kind))
    return make_track(path, name, class_name, size, time_s, np.column_stack([xy, np.full(len(xy), np.nan)]), yaw)
