"""Tracks in a CSV: time, id, x, y, yaw, length, width and class of each sample, z and height if known."""

import csv
import math
from pathlib import Path

import numpy as np

from sim.errors import DataError, complaint
from sim.reading import parsing, read_text
from sim.traffic.tracks.base import Recording, Track, check_radians, class_of, make_track

NEEDED = ("time", "id", "x", "y", "yaw", "length", "width", "class")
NUMBERS = ("time", "x", "y", "yaw", "length", "width")
OPTIONAL = ("z", "height")


def read_table(path: Path) -> Recording:
    """Read a CSV with a header; s, m and rad, world frame, z and yaw of the box's centre, rows in any order.

    A road user has the median of its sizes. Without z it stands on the ground, without height it has that of its class.

    Raises:
        DataError: a column is missing or a value is wrong; names the line.
    """
    text = read_text(path, "CSV file").removeprefix("\ufeff")
    with parsing(path, "CSV file"):
        return _recording(path, text)


def _recording(path: Path, text: str) -> Recording:
    reader = csv.DictReader(text.splitlines())
    reader.fieldnames = [name.strip().lower() for name in reader.fieldnames or []]
    for name in NEEDED:
        if name not in reader.fieldnames:
            raise DataError(complaint(path, "columns", f"a column '{name}'", ", ".join(reader.fieldnames) or "none"))
    samples: dict[str, list[tuple[float, ...]]] = {}
    classes: dict[str, tuple[str, int]] = {}
    for row in reader:
        line, extra = reader.line_num, len(row.pop(None, ()))
        if found := extra - list(row.values()).count(None):
            width = len(row)
            raise DataError(complaint(path, f"line {line}", f"{width} values, as columns", str(width + found)))
        name = (row["id"] or "").strip()
        if not name:
            raise DataError(complaint(path, f"line {line}, id", "an id", "nothing"))
        values = [_number(path, line, column, row[column]) for column in NUMBERS]
        values += [_number(path, line, column, row.get(column) or "nan", missing=True) for column in OPTIONAL]
        samples.setdefault(name, []).append(tuple(values))
        given = (row["class"] or "").strip()
        known, first = classes.setdefault(name, (given, line))
        if given != known:
            expected = f"'{known}', the class of object '{name}' in line {first}"
            raise DataError(complaint(path, f"line {line}, class", expected, given))
    tracks: list[Track] = []
    for name, listed in samples.items():
        time_s, x, y, yaw, length, width, z, height = np.array(listed, np.float64).T
        size = [float(np.median(length)), float(np.median(width)), float(np.median(height))]
        check_radians(path, f"object '{name}': yaw", yaw)
        class_name = class_of(path, f"line {classes[name][1]}, class", classes[name][0], size[0])
        if class_name is not None:
            tracks.append(make_track(path, name, class_name, size, time_s, np.column_stack([x, y, z]), yaw))
    return Recording(tuple(tracks))


def _number(path: Path, line: int, column: str, text: str | None, missing: bool = False) -> float:
    try:
        value = float(text or "")
    except ValueError:
        value = math.inf
    if math.isinf(value) or (math.isnan(value) and not missing):
        raise DataError(complaint(path, f"line {line}, {column}", "a number", text or "nothing"))
    return value
