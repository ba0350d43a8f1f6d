"""The traffic log: all actors of a run in one file, from which the same run can be played back without SUMO."""

import os
import zipfile
import zlib
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from sim.boxes import CLASSES, Boxes
from sim.errors import DataError, complaint
from sim.traffic.base import Actors, Traffic

VERSION = 2

# Columns of the file: per step, per object (in order of id), per actor and step (steps after one another), per lane (in
# order of name). Files of version 1 knew neither lanes nor accelerations: such a drive is generated anew.
_STEPS = {"time_s": "f8", "count": "i8"}
_OBJECTS = {"id": "i8", "label": "i8", "size": "f8", "name": "U", "model": "U"}
_ROWS = {
    "object": "i8",
    "center": "f8",
    "yaw": "f8",
    "pitch": "f8",
    "velocity": "f8",
    "acceleration": "f8",
    "signals": "i4",
    "lane": "i8",
}
_LANES = {"name": "U"}
_KEYS = {"step": "time_s", "object": "id", "lane": "name"}
_WIDTHS = {"size": (3,), "center": (3,), "velocity": (2,), "acceleration": (2,)}


class TrafficLog:
    """The actors of consecutive steps, to append to and to write, or read from a file.

    Args:
        step_s: time between two entries, s.
    """

    def __init__(self, step_s: float) -> None:
        self.step_s = float(step_s)
        self._entries: list[Actors] = []
        self._objects: dict[int, tuple] = {}

    def __len__(self) -> int:
        return len(self._entries)

    def __getitem__(self, index: int) -> Actors:
        return self._entries[index]

    def append(self, actors: Actors) -> None:
        """Add the actors of the next step; what an object is must not change."""
        boxes = actors.boxes
        for row, object_id in enumerate(boxes.object_id.tolist()):
            looks = (int(boxes.label[row]), tuple(boxes.size[row].tolist()), actors.name[row], actors.model[row])
            if self._objects.setdefault(object_id, looks) != looks:
                raise ValueError(f"object {object_id} changed from {self._objects[object_id]} to {looks}")
        self._entries.append(actors)

    def save(self, path: Path | str) -> Path:
        """Write the log as a .npz in one piece; equal logs give equal bytes."""
        path = Path(path)
        partial = path.with_name(path.name + ".part")
        with partial.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **self._columns())
        os.replace(partial, path)
        return path

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read a log.

        Raises:
            DataError: the file is missing, damaged or no traffic log.
        """
        columns = _read_columns(Path(path))
        log = cls(float(columns["step_s"]))
        ends = np.cumsum(columns["step/count"])
        for step, (start, end) in enumerate(zip(ends - columns["step/count"], ends, strict=True)):
            log.append(_actors(columns, float(columns["step/time_s"][step]), slice(int(start), int(end))))
        return log

    def _columns(self) -> dict[str, NDArray]:
        ids = np.array(sorted(self._objects), dtype=np.int64)
        looks = [self._objects[i] for i in ids.tolist()]
        entries = self._entries
        object_id = _stack([a.boxes.object_id for a in entries], (), np.int64)
        lanes = sorted({lane for a in entries for lane in a.lane})
        row_of_lane = {lane: row for row, lane in enumerate(lanes)}
        return {
            "version": np.array(VERSION),
            "step_s": np.array(self.step_s),
            "step/time_s": np.array([a.time_s for a in entries], np.float64),
            "step/count": np.array([len(a) for a in entries], np.int64),
            "object/id": ids,
            "object/label": np.array([look[0] for look in looks], np.int64),
            "object/size": np.array([look[1] for look in looks], np.float64).reshape(-1, 3),
            "object/name": np.array([look[2] for look in looks], dtype=np.str_),
            "object/model": np.array([look[3] for look in looks], dtype=np.str_),
            "row/object": np.searchsorted(ids, object_id).astype(np.int64),
            "row/center": _stack([a.boxes.center for a in entries], (3,), np.float64),
            "row/yaw": _stack([a.boxes.yaw for a in entries], (), np.float64),
            "row/pitch": _stack([a.pitch for a in entries], (), np.float64),
            "row/velocity": _stack([a.velocity for a in entries], (2,), np.float64),
            "row/acceleration": _stack([a.acceleration for a in entries], (2,), np.float64),
            "row/signals": _stack([a.signals for a in entries], (), np.int32),
            "row/lane": np.array([row_of_lane[lane] for a in entries for lane in a.lane], np.int64),
            "lane/name": np.array(lanes, dtype=np.str_),
        }


class RecordingTraffic:
    """Traffic that keeps a log of what passes through it and writes it when it is closed.

    Args:
        inner: the traffic to record; this object closes it.
        path: the .npz to write.
    """

    def __init__(self, inner: Traffic, path: Path | str) -> None:
        self.inner = inner
        self.path = Path(path)
        self.log = TrafficLog(inner.step_s)
        self.log.append(inner.actors)
        self._open = True

    @property
    def step_s(self) -> float:
        """Time between two steps, s."""
        return self.inner.step_s

    @property
    def actors(self) -> Actors:
        """The actors at the current time."""
        return self.inner.actors

    def step(self) -> Actors:
        """Advance the inner traffic and record its actors."""
        actors = self.inner.step()
        self.log.append(actors)
        return actors

    def close(self) -> None:
        """Close the inner traffic and write the log."""
        if not self._open:
            return
        self._open = False
        self.inner.close()
        self.log.save(self.path)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def _stack(parts: list[NDArray], shape: tuple[int, ...], dtype: type) -> NDArray:
    return np.concatenate([np.zeros((0, *shape), dtype), *parts]).astype(dtype)


def _read_columns(path: Path) -> dict[str, NDArray]:
    if not path.is_file():
        raise DataError(complaint(path, "traffic log", "an existing file", "no such file"))
    try:
        # Opened here, because numpy leaves a damaged archive open.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            columns = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, KeyError, AttributeError, zipfile.BadZipFile, zlib.error) as error:
        raise DataError(f"{path}: not a readable traffic log: {' '.join(str(error).split())}") from None
    if int(columns.get("version", np.array(-1))) != VERSION:
        found = columns.get("version", "none")
        hint = "; generate the drive again"
        raise DataError(complaint(path, "version", f"a traffic log of version {VERSION}", str(found), hint))
    _check(path, columns)
    return columns


def _check(path: Path, columns: dict[str, NDArray]) -> None:
    """Refuse a file whose columns do not fit together."""
    tables = {"step": _STEPS, "object": _OBJECTS, "row": _ROWS, "lane": _LANES}
    expected = {f"{table}/{name}": kind for table, names in tables.items() for name, kind in names.items()}
    for name, kind in {"step_s": "f8", **expected}.items():
        if name not in columns or not columns[name].dtype.str[1:].startswith(kind):
            found = columns[name].dtype if name in columns else "nothing"
            raise DataError(complaint(path, name, f"an array of {kind}", str(found)))
    count = {table: len(columns[f"{table}/{key}"]) for table, key in _KEYS.items()}
    count["row"] = int(columns["step/count"].sum())
    for name in expected:
        rows, width = count[name.split("/")[0]], _WIDTHS
        shape = (rows, *width.get(name.split("/")[1], ()))
        if columns[name].shape != shape:
            raise DataError(complaint(path, name, f"shape {shape}", str(columns[name].shape)))
    numbers = [columns[name] for name, kind in expected.items() if kind == "f8"]
    if not all(np.isfinite(values).all() for values in numbers) or not 0.0 < float(columns["step_s"]) < np.inf:
        raise DataError(complaint(path, "traffic log", "finite numbers and a positive step_s", "others"))
    if count["step"] and columns["step/count"].min() < 0:
        raise DataError(complaint(path, "step/count", "at least 0", int(columns["step/count"].min())))
    if (np.diff(columns["object/id"]) <= 0).any():
        raise DataError(complaint(path, "object/id", "ascending ids", "others"))
    for table in ("object", "lane"):
        which = columns[f"row/{table}"]
        if count["row"] and not 0 <= which.min() <= which.max() < count[table]:
            raise DataError(complaint(path, f"row/{table}", f"rows of {count[table]} {table}s", "others"))
    if count["object"] and not 0 <= columns["object/label"].min() <= columns["object/label"].max() < len(CLASSES):
        raise DataError(complaint(path, "object/label", f"indices of {len(CLASSES)} classes", "others"))


def _actors(columns: dict[str, NDArray], time_s: float, rows: slice) -> Actors:
    which = columns["row/object"][rows]
    return Actors(
        time_s=time_s,
        boxes=Boxes(
            center=columns["row/center"][rows],
            size=columns["object/size"][which],
            yaw=columns["row/yaw"][rows],
            label=columns["object/label"][which],
            object_id=columns["object/id"][which],
        ),
        pitch=columns["row/pitch"][rows],
        velocity=columns["row/velocity"][rows],
        acceleration=columns["row/acceleration"][rows],
        model=tuple(columns["object/model"][which].tolist()),
        name=tuple(columns["object/name"][which].tolist()),
        signals=columns["row/signals"][rows],
        lane=tuple(columns["lane/name"][columns["row/lane"][rows]].tolist()),
    )
