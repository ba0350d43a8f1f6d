"""Tracks of drone recordings in the formats of levelXdata: highD, and inD with its like (rounD, exiD, uniD).

`NN_tracks.csv` needs `NN_tracksMeta.csv` and `NN_recordingMeta.csv` beside it.

Source: the formats of highD (Krajewski et al., ITSC 2018) and inD (Bock et al., IV 2020), levelxdata.com: frames are
counted, `frameRate` per second. highD: x and y are the upper left corner of the box in the picture, so y points down;
`width` is along the road, and vehicles of `drivingDirection` 1 drive to the left. inD: `xCenter` and `yCenter` of the
box, `heading` in degrees, counter-clockwise from +x; pedestrians and cyclists have no box, with sizes of 0.
"""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.errors import DataError, complaint
from sim.traffic.tracks.base import FARTHEST_M, Recording, Track, class_of, heading_of_motion, make_track
from sim.traffic.tracks.columns import Columns, read_columns, rows_by

IND = frozenset({"trackid", "frame", "xcenter", "ycenter", "heading"})
"""Columns by which inD is known."""
HIGHD = frozenset({"id", "frame", "x", "y", "width", "height", "laneid"})
"""Columns by which highD is known."""

_CLASSES = {"truck_bus": "truck"}


def read_ind(path: Path) -> tuple[Recording, ...]:
    """Read a recording of inD, rounD, exiD or uniD.

    Pedestrians and cyclists without a heading face where they move, and have the size of their class.

    Raises:
        DataError: a file or a column is missing, a value is wrong, or a heading is no degrees; names the object.
    """
    read = read_columns(path, ("frame", "xcenter", "ycenter", "heading"), ("trackid",))
    about = _Meta(path, "trackid")
    tracks: list[Track] = []
    for name, rows in read.groups("trackid").items():
        frame, x, y, heading = (read.numbers[column][rows] for column in ("frame", "xcenter", "ycenter", "heading"))
        if (np.abs(heading) > 360.0).any():
            raise DataError(complaint(path, f"object '{name}': heading", "degrees within 360", f"{heading.max():g}"))
        order = np.argsort(frame, kind="stable")
        xy = np.column_stack([x, y])[order]
        length, width = about.number(name, "length"), about.number(name, "width")
        class_name = about.class_of(name, length)
        if class_name is None:
            continue
        unknown = class_name in ("pedestrian", "bicycle") and not heading.any()
        yaw = heading_of_motion(xy) if unknown else np.radians(heading[order])
        size = [length or math.nan, width or math.nan, math.nan]
        center = np.column_stack([xy, np.full(len(xy), np.nan)])
        tracks.append(make_track(path, name, class_name, size, frame[order] / about.rate_hz, center, yaw))
    return (Recording(tuple(tracks)),)


def read_highd(path: Path) -> tuple[Recording, ...]:
    """Read a recording of highD; lanes are those between its markings.

    The picture's y is turned, so that vehicles keep to the right.

    Raises:
        DataError: a file or a column is missing or a value is wrong; names the object.
    """
    columns = ("frame", "x", "y", "width", "height")
    read = read_columns(path, columns, ("id",))
    about = _Meta(path, "id", ("drivingdirection",), ("upperlanemarkings", "lowerlanemarkings"))
    tracks: list[Track] = []
    for name, rows in read.groups("id").items():
        frame, x, y, along, across = (read.numbers[column][rows] for column in columns)
        direction = about.number(name, "drivingdirection")
        if direction not in (1.0, 2.0):
            expected = "1 (to the left) or 2 (to the right)"
            raise DataError(complaint(path, f"object '{name}': drivingDirection", expected, f"{direction:g}"))
        class_name = about.class_of(name, about.number(name, "width"))
        if class_name is None:
            continue
        center = np.column_stack([x + 0.5 * along, -(y + 0.5 * across), np.full(len(x), np.nan)])
        size = [float(np.median(along)), float(np.median(across)), math.nan]
        yaw = np.full(len(x), math.pi if direction == 1.0 else 0.0)
        tracks.append(make_track(path, name, class_name, size, frame / about.rate_hz, center, yaw))
    places = np.concatenate([np.zeros((0, 2)), *(one.center[:, :2] for one in tracks)])
    if not len(places):
        return (Recording(()),)
    start, end = float(places[:, 0].min()) - 20.0, float(places[:, 0].max()) + 20.0
    lanes = [
        np.array([[start, -low], [end, -low], [end, -high], [start, -high]])
        for markings in about.markings
        for low, high in pairwise(markings)
    ]
    return (Recording(tuple(tracks), tuple(lanes)),)


class _Meta:
    """What stands beside `NN_tracks.csv`: of the recording its rate, of each track its class and constants."""

    def __init__(self, path: Path, key: str, numbers: tuple[str, ...] = (), markings: tuple[str, ...] = ()) -> None:
        if not path.stem.endswith("tracks"):
            raise DataError(complaint(path, "name", "NN_tracks.csv, with NN_tracksMeta.csv beside it", path.name))
        self.path = path.with_name(f"{path.stem}Meta.csv")
        whole = path.with_name(f"{path.stem.removesuffix('tracks')}recordingMeta.csv")
        recording = read_columns(whole, ("framerate",), markings, optional=markings)
        rates = recording.numbers["framerate"]
        if len(rates) != 1 or not 0.1 <= rates[0] <= 1000.0:
            raise DataError(complaint(whole, "frameRate", "one rate in [0.1, 1000] Hz", rates[:3].tolist()))
        self.rate_hz = float(rates[0])
        self.markings = [_numbers(whole, name, recording.texts[name][0]) for name in markings]
        sizes = ("width", "height") if key == "id" else ("width", "length")
        self._read: Columns = read_columns(self.path, (*sizes, *numbers), (key, "class"))
        self._rows = {name: int(rows[0]) for name, rows in rows_by(self._read.texts[key]).items()}

    def number(self, name: str, column: str) -> float:
        """Return a constant of a track; DataError for one that the file lacks."""
        return float(self._read.numbers[column][self._row(name)])

    def class_of(self, name: str, length_m: float) -> str | None:
        """Return the class of a track, see `class_of`."""
        given = self._read.texts["class"][self._row(name)].lower()
        return class_of(self.path, f"object '{name}': class", _CLASSES.get(given, given), length_m)

    def _row(self, name: str) -> int:
        if name not in self._rows:
            raise DataError(complaint(self.path, "tracks", f"object '{name}' of the tracks", "none"))
        return self._rows[name]


def _numbers(path: Path, field: str, text: str) -> NDArray[np.float64]:
    try:
        values = np.array([float(word) for word in text.split(";") if word.strip()], np.float64)
    except ValueError:
        values = np.array([math.nan])
    if not (np.abs(values) <= FARTHEST_M).all():
        raise DataError(complaint(path, field, f"numbers within {FARTHEST_M:g} between semicolons", text))
    return np.sort(values)
