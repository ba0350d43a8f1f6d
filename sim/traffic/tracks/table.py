"""Tracks in a CSV: time, id, x, y, yaw, length, width and class of each sample, z and height if known."""

from pathlib import Path

import numpy as np

from sim.boxes import check_radians
from sim.errors import DataError, complaint
from sim.traffic.tracks.base import Recording, Track, class_of, make_track
from sim.traffic.tracks.columns import read_columns

NUMBERS = ("time", "x", "y", "yaw", "length", "width", "z", "height")
OPTIONAL = ("z", "height")


def read_table(path: Path) -> tuple[Recording, ...]:
    """Read a CSV with a header; s, m and rad, world frame, z and yaw of the box's centre, rows in any order.

    A road user has the median of its sizes. Without z it stands on the ground, without height it has that of its class.

    Raises:
        DataError: a column is missing or a value is wrong; names the line.
    """
    read = read_columns(path, NUMBERS, ("id", "class"), OPTIONAL)
    tracks: list[Track] = []
    for name, rows in read.groups("id").items():
        given = [read.texts["class"][row] for row in rows]
        first = read.line[rows[0]]
        for row, text in zip(rows, given, strict=True):
            if text != given[0]:
                expected = f"'{given[0]}', the class of object '{name}' in line {first}"
                raise DataError(complaint(path, f"line {read.line[row]}, class", expected, text))
        time_s, x, y, yaw, length, width, z, height = (read.numbers[column][rows] for column in NUMBERS)
        size = [float(np.median(length)), float(np.median(width)), float(np.median(height))]
        check_radians(path, f"object '{name}': yaw", yaw)
        class_name = class_of(path, f"line {first}, class", given[0], size[0])
        if class_name is not None:
            tracks.append(make_track(path, name, class_name, size, time_s, np.column_stack([x, y, z]), yaw))
    return (Recording(tuple(tracks)),)
