"""Traffic log: the actors of a run in one file, replayed without SUMO.

The file holds whole numbers (`Actors.rounded`), object by object in order of time, as residuals of a prediction: a
position at constant speed, a velocity from the positions, an acceleration from the velocities. The residuals are small
and compress to a few bytes per actor and step.
"""

from pathlib import Path
from typing import Self

import msgspec
import numpy as np
from numpy.typing import NDArray

from sim.boxes import CLASSES, Boxes
from sim.errors import DataError, complaint
from sim.packed import differences, packed, read_arrays, sums, unpacked, write_arrays
from sim.reading import parsing
from sim.scenario import Area
from sim.traffic.base import (
    ACCELERATION_MPS2,
    ANGLE_RAD,
    POSITION_M,
    TIME_S,
    VELOCITY_MPS,
    Actors,
    from_steps,
    in_steps,
)

VERSION = 3
LARGEST_M = 1e4
"""Largest edge of an object, m."""

# Columns of the file: per object (in order of id), per lane (in order of name), per run of consecutive steps of one
# object (in order of object, then step), and per actor and step (run after run), packed. Files of version 2 held
# floating-point numbers step by step: such a drive has to be generated again.
_OBJECTS = {"id": "i8", "label": "i8", "size": "i8", "name": "U", "model": "U"}
_RUNS = {"object": "i8", "start": "i8", "length": "i8"}
_ROWS = ("x", "y", "z", "yaw", "pitch", "vx", "vy", "ax", "ay", "signals", "lane")
_ROLL = "row/roll"
"""Column that only a log of bodies that roll has."""


class TrafficLog:
    """Rounded actors of consecutive steps, appended or read from a file.

    Args:
        step_s: time between two entries, s.
        about: metadata of the simulation, stored in the file.
    """

    def __init__(self, step_s: float, about: dict | None = None) -> None:
        self.step_s = float(step_s)
        self.about = {} if about is None else about
        self._entries: list[Actors] = []
        self._objects: dict[int, tuple] = {}

    def __len__(self) -> int:
        return len(self._entries)

    def __getitem__(self, index: int) -> Actors:
        return self._entries[index]

    def append(self, actors: Actors) -> None:
        """Add the actors of the next step; class, size, name and model of an object must not change."""
        actors = actors.rounded()
        boxes = actors.boxes
        for row, object_id in enumerate(boxes.object_id.tolist()):
            looks = (int(boxes.label[row]), tuple(boxes.size[row].tolist()), actors.name[row], actors.model[row])
            if self._objects.setdefault(object_id, looks) != looks:
                raise ValueError(f"object {object_id} changed from {self._objects[object_id]} to {looks}")
        self._entries.append(actors)

    def within(self, area: Area) -> Self:
        """Return the log of the objects that enter (x_min, y_min, x_max, y_max), m, at least once."""
        low, high = np.array(area[:2]), np.array(area[2:])
        inside = [
            a.boxes.object_id[((a.boxes.center[:, :2] >= low) & (a.boxes.center[:, :2] <= high)).all(axis=1)]
            for a in self._entries
        ]
        kept = np.unique(np.concatenate([np.zeros(0, np.int64), *inside]))
        log = type(self)(self.step_s, self.about)
        for actors in self._entries:
            log.append(actors[np.isin(actors.boxes.object_id, kept)])
        return log

    def save(self, path: Path | str) -> Path:
        """Write the log as a .npz, atomically; equal logs give equal bytes."""
        path = Path(path)
        write_arrays(path, self.columns())
        return path

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read a log from a .npz.

        Raises:
            DataError: the file is missing, damaged or no traffic log.
        """
        columns = read_log_columns(Path(path))
        with parsing(path, "traffic log"):
            return cls.from_columns(columns)

    @classmethod
    def from_columns(cls, columns: dict[str, NDArray]) -> Self:
        """Return the log of columns that `check_log_columns` found valid."""
        log = cls(float(columns["step_s"]), msgspec.json.decode(str(columns["about"])))
        rows = _unfolded(columns)
        order = np.argsort(rows["step"], kind="stable")
        counts = np.bincount(rows["step"], minlength=len(columns["step/time"]))
        ends = np.cumsum(counts)
        times = from_steps(columns["step/time"], TIME_S).tolist()
        names = {key: columns[key].tolist() for key in ("object/name", "object/model", "lane/name")}
        for time_s, start, end in zip(times, (ends - counts).tolist(), ends.tolist(), strict=True):
            log.append(_actors(columns, names, {key: v[order[start:end]] for key, v in rows.items()}, time_s))
        return log

    def columns(self) -> dict[str, NDArray]:
        """Return the arrays of the file by name."""
        ids = np.array(sorted(self._objects), dtype=np.int64)
        looks = [self._objects[i] for i in ids.tolist()]
        entries = self._entries
        lanes = sorted({lane for a in entries for lane in a.lane})
        row_of_lane = {lane: row for row, lane in enumerate(lanes)}
        which = np.searchsorted(ids, _stack([a.boxes.object_id for a in entries], ()))
        step = np.repeat(np.arange(len(entries)), [len(a) for a in entries])
        order = np.lexsort((step, which))
        starts = np.flatnonzero((np.diff(which[order], prepend=-1) != 0) | (np.diff(step[order], prepend=-2) != 1))
        length = np.diff(starts, append=len(order))
        center = in_steps(_stack([a.boxes.center for a in entries], (3,))[order], POSITION_M)
        velocity = in_steps(_stack([a.velocity for a in entries], (2,))[order], VELOCITY_MPS)
        acceleration = in_steps(_stack([a.acceleration for a in entries], (2,))[order], ACCELERATION_MPS2)
        rows = {
            **dict(zip(("x", "y", "z"), center.T, strict=True)),
            "yaw": in_steps(_stack([a.boxes.yaw for a in entries], ())[order], ANGLE_RAD),
            "pitch": in_steps(_stack([a.pitch for a in entries], ())[order], ANGLE_RAD),
            "roll": in_steps(_stack([a.roll for a in entries], ())[order], ANGLE_RAD),
            **dict(zip(("vx", "vy"), velocity.T, strict=True)),
            **dict(zip(("ax", "ay"), acceleration.T, strict=True)),
            "signals": _stack([a.signals for a in entries], ())[order].astype(np.int64),
            "lane": np.array([row_of_lane[lane] for a in entries for lane in a.lane], np.int64)[order],
        }
        size = np.array([look[1] for look in looks], np.float64).reshape(-1, 3)
        return {
            "version": np.array(VERSION),
            "step_s": np.array(self.step_s),
            "about": np.array(msgspec.json.encode(self.about, order="sorted").decode()),
            "step/time": in_steps(np.array([a.time_s for a in entries], np.float64), TIME_S),
            "object/id": ids,
            "object/label": np.array([look[0] for look in looks], np.int64),
            "object/size": in_steps(size, POSITION_M),
            "object/name": np.array([look[2] for look in looks], dtype=np.str_),
            "object/model": np.array([look[3] for look in looks], dtype=np.str_),
            "lane/name": np.array(lanes, dtype=np.str_),
            "run/object": which[order][starts].astype(np.int64),
            "run/start": step[order][starts].astype(np.int64),
            "run/length": length.astype(np.int64),
            **_folded(rows, length, self.step_s),
        }


def _stack(parts: list[NDArray], shape: tuple[int, ...]) -> NDArray:
    return np.concatenate([np.zeros((0, *shape), parts[0].dtype if parts else np.int64), *parts])


def _folded(rows: dict[str, NDArray[np.int64]], length: NDArray[np.int64], step_s: float) -> dict[str, NDArray]:
    """Return the packed columns: residuals of the rows after prediction."""
    moved = {axis: differences(rows[axis], length) for axis in "xy"}
    turned = {axis: differences(rows[f"v{axis}"], length) for axis in "xy"}
    left = {
        **{
            name: differences(differences(rows[name], length, keep=True), length, keep=True)
            for name in ("x", "y", "yaw")
        },
        **{name: differences(rows[name], length, keep=True) for name in ("z", "pitch", "roll", "signals", "lane")},
        **{f"v{axis}": rows[f"v{axis}"] - _speed(moved[axis], step_s) for axis in "xy"},
        **{f"a{axis}": rows[f"a{axis}"] - _gain(turned[axis], step_s) for axis in "xy"},
    }
    written = (*_ROWS, "roll") if rows["roll"].any() else _ROWS
    return {f"row/{name}": packed(left[name]) for name in written}


def _unfolded(columns: dict[str, NDArray]) -> dict[str, NDArray[np.int64]]:
    """Return the rows of packed columns, with the object and step of each."""
    length, step_s = columns["run/length"], float(columns["step_s"])
    rows = {name: unpacked(columns[f"row/{name}"]) for name in _ROWS}
    rows["roll"] = unpacked(columns[_ROLL]) if _ROLL in columns else np.zeros_like(rows["pitch"])
    for name in ("x", "y", "yaw"):
        rows[name] = sums(sums(rows[name], length), length)
    for name in ("z", "pitch", "roll", "signals", "lane"):
        rows[name] = sums(rows[name], length)
    for axis in "xy":
        rows[f"v{axis}"] = rows[f"v{axis}"] + _speed(differences(rows[axis], length), step_s)
    for axis in "xy":
        rows[f"a{axis}"] = rows[f"a{axis}"] + _gain(differences(rows[f"v{axis}"], length), step_s)
    within = np.arange(int(length.sum())) - np.repeat(np.cumsum(length) - length, length)
    rows["object"] = np.repeat(columns["run/object"], length)
    rows["step"] = np.repeat(columns["run/start"], length) + within
    return rows


def _speed(moved: NDArray[np.int64], step_s: float) -> NDArray[np.int64]:
    """Return velocities of position changes, both in steps."""
    return np.rint(moved * (POSITION_M / VELOCITY_MPS / step_s)).astype(np.int64)


def _gain(turned: NDArray[np.int64], step_s: float) -> NDArray[np.int64]:
    """Return accelerations of velocity changes, both in steps."""
    return np.rint(turned * (VELOCITY_MPS / ACCELERATION_MPS2 / step_s)).astype(np.int64)


def read_log_columns(path: Path) -> dict[str, NDArray]:
    """Read and check the arrays of a log, see `TrafficLog.load`."""
    columns = read_arrays(path, "traffic log")
    check_log_columns(path, columns)
    return columns


def check_log_columns(path: Path, columns: dict[str, NDArray]) -> None:
    """Raise DataError, which names `path`, unless the columns are those of a log."""
    with parsing(path, "traffic log"):
        _check_columns(path, columns)


def _check_columns(path: Path, columns: dict[str, NDArray]) -> None:
    version = columns.get("version", np.array(-1))
    if version.shape != () or version.dtype.kind not in "iu" or int(version) != VERSION:
        hint = "; generate the drive again"
        written = str(columns.get("version", "none"))
        raise DataError(complaint(path, "version", f"a traffic log of version {VERSION}", written, hint))
    tables = {"object": _OBJECTS, "run": _RUNS, "lane": {"name": "U"}, "step": {"time": "i8"}}
    expected = {f"{table}/{name}": kind for table, names in tables.items() for name, kind in names.items()}
    rows = {**{f"row/{name}": "u1" for name in _ROWS}, **({_ROLL: "u1"} if _ROLL in columns else {})}
    for name, kind in {"step_s": "f8", "about": "U", **expected, **rows}.items():
        if name not in columns or not columns[name].dtype.str[1:].startswith(kind):
            found = columns[name].dtype if name in columns else "nothing"
            raise DataError(complaint(path, name, f"an array of {kind}", str(found)))
    keys = {"object": "object/id", "run": "run/object", "lane": "lane/name", "step": "step/time"}
    shapes = {
        name: (*columns[keys[name.split("/")[0]]].shape[:1], *((3,) if name == "object/size" else ()))
        for name in expected
    }
    count = int(columns["run/length"].sum())
    shapes |= {name: (len(columns[name]), count) for name in rows}
    for name, shape in shapes.items():
        if columns[name].shape != shape:
            raise DataError(complaint(path, name, f"shape {shape}", str(columns[name].shape)))
    if columns["step_s"].shape != () or not 0.0 < float(columns["step_s"]) < np.inf:
        raise DataError(complaint(path, "step_s", "a positive number", str(columns["step_s"])))
    try:
        about = msgspec.json.decode(str(columns["about"]))
    except msgspec.DecodeError:
        about = None
    if not isinstance(about, dict):
        raise DataError(complaint(path, "about", "a JSON object", str(columns["about"])))
    objects, lanes, steps = (len(columns[keys[table]]) for table in ("object", "lane", "step"))
    if (np.diff(columns["object/id"]) <= 0).any():
        raise DataError(complaint(path, "object/id", "ascending ids", "others"))
    start, end = columns["run/start"], columns["run/start"] + columns["run/length"]
    if len(start) and (start.min() < 0 or end.max() > steps or columns["run/length"].min() < 1):
        raise DataError(complaint(path, "run/start", f"runs within {steps} steps", "others"))
    if _outside(columns["run/object"], objects):
        raise DataError(complaint(path, "run/object", f"rows of {objects} objects", "others"))
    same = np.diff(columns["run/object"]) == 0
    if (np.diff(columns["run/object"]) < 0).any() or (start[1:] <= end[:-1])[same].any():
        raise DataError(complaint(path, "run/object", "runs in order of object and step", "others"))
    size = columns["object/size"]
    if len(size) and (size.min() <= 0 or size.max() > LARGEST_M / POSITION_M):
        raise DataError(complaint(path, "object/size", f"positive sizes up to {LARGEST_M:g} m", "others"))
    if _outside(columns["object/label"], len(CLASSES)):
        raise DataError(complaint(path, "object/label", f"indices of {len(CLASSES)} classes", "others"))
    if len(start) and _outside(sums(unpacked(columns["row/lane"]), columns["run/length"]), lanes):
        raise DataError(complaint(path, "row/lane", f"rows of {lanes} lanes", "others"))


def _outside(rows: NDArray[np.int64], count: int) -> bool:
    return len(rows) > 0 and not 0 <= rows.min() <= rows.max() < count


def _actors(
    columns: dict[str, NDArray], names: dict[str, list[str]], rows: dict[str, NDArray[np.int64]], time_s: float
) -> Actors:
    which = rows["object"]
    return Actors(
        time_s=time_s,
        boxes=Boxes(
            center=from_steps(np.stack([rows["x"], rows["y"], rows["z"]], axis=1), POSITION_M),
            size=from_steps(columns["object/size"][which], POSITION_M),
            yaw=from_steps(rows["yaw"], ANGLE_RAD),
            label=columns["object/label"][which],
            object_id=columns["object/id"][which],
        ),
        pitch=from_steps(rows["pitch"], ANGLE_RAD),
        velocity=from_steps(np.stack([rows["vx"], rows["vy"]], axis=1), VELOCITY_MPS),
        acceleration=from_steps(np.stack([rows["ax"], rows["ay"]], axis=1), ACCELERATION_MPS2),
        model=tuple(names["object/model"][row] for row in which),
        name=tuple(names["object/name"][row] for row in which),
        signals=rows["signals"].astype(np.int32),
        lane=tuple(names["lane/name"][row] for row in rows["lane"]),
        roll=from_steps(rows["roll"], ANGLE_RAD),
    )
