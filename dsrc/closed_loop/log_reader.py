"""Reader of the columns of an episode log, each checked when it is read."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.log_columns import BOX, MOVING, SIDES, STATES, TRACK, TWICE, runs_of
from dsrc.closed_loop.types import Decision, EgoState, Percept, Tick, Tracks
from dsrc.messages.message import Told
from sim.boxes import CLASSES, Boxes
from sim.contact import Contact
from sim.errors import DataError, complaint
from sim.packed import sums, unpacked
from sim.radio import Link, Obstruction
from sim.traffic.base import POSITION_M, Actors, Limits, TrafficLight, from_steps
from sim.traffic.log import TrafficLog, check_log_columns


class Table(NamedTuple):
    """Rows of several instants: boxes, further values by name, first row of each instant and behind the last."""

    boxes: Boxes
    values: dict[str, NDArray[np.float64]]
    ends: NDArray[np.int64]

    def rows(self, instant: int) -> slice:
        """Return the rows of an instant."""
        return slice(int(self.ends[instant]), int(self.ends[instant + 1]))

    def velocity(self, rows: slice) -> NDArray[np.float64]:
        """Return the (N, 2) velocities of rows."""
        return np.stack([self.values["vx"][rows], self.values["vy"][rows]], axis=1)


class ColumnReader:
    """Columns of a file, each checked when it is read; every DataError names file and column.

    Attributes:
        path: of the file, for messages.
        columns: its arrays by name.
    """

    def __init__(self, path: Path, columns: dict[str, NDArray]) -> None:
        self.path, self.columns = path, columns

    def wrong(self, name: str, expected: str, found: object) -> DataError:
        """Return the error of a column."""
        return DataError(complaint(self.path, name, expected, found))

    def array(self, name: str, kind: str, shape: tuple[int | None, ...]) -> NDArray:
        """Return a column of a kind of numbers and a shape; None is any length."""
        column = self.columns.get(name)
        if column is None or (column.dtype.str[1:] != kind and not (kind == "U" and column.dtype.kind == "U")):
            raise self.wrong(name, f"an array of {kind}", "nothing" if column is None else str(column.dtype))
        if len(column.shape) != len(shape) or any(
            wanted not in (None, found) for wanted, found in zip(shape, column.shape, strict=True)
        ):
            raise self.wrong(name, f"shape {shape}", column.shape)
        return column

    def index(self, name: str, count: int, values: NDArray[np.int64]) -> list[int]:
        """Return numbers below a count."""
        if len(values) and not 0 <= values.min() <= values.max() < count:
            raise self.wrong(name, f"numbers below {count}", "others")
        return values.tolist()

    def ends(self, name: str, instants: int | None, rows: int) -> NDArray[np.int64]:
        """Return 0 and the ends of instants in a table of so many rows."""
        count = self.array(name, "i8", (instants,))
        # Each is bounded before they are added, so that the sum cannot overflow.
        if (len(count) and not 0 <= count.min() <= count.max() <= rows) or int(count.sum()) != rows:
            raise self.wrong(name, f"counts of {rows} rows", "others")
        return np.concatenate([[0], np.cumsum(count)])

    def whole(self, name: str, rows: int | None) -> NDArray[np.int64]:
        """Return packed integers."""
        planes = self.array(name, "u1", (None, rows))
        if not 1 <= len(planes) <= 8:
            raise self.wrong(name, "1 to 8 byte planes", len(planes))
        return unpacked(planes)

    def bits(self, name: str, count: int) -> NDArray[np.bool_]:
        """Return so many bits."""
        return np.unpackbits(self.array(name, "u1", ((count + 7) // 8,)), count=count).astype(bool)

    def traffic(self, prefix: str) -> TrafficLog:
        """Return a traffic log of at least one step."""
        columns = {name.removeprefix(prefix): c for name, c in self.columns.items() if name.startswith(prefix)}
        check_log_columns(self.path, columns)
        log = TrafficLog.from_columns(columns)
        if not len(log):
            raise self.wrong(f"{prefix}step/time", "at least one step", "none")
        return log

    def table(self, prefix: str, instants: int | None, steps: dict[str, float]) -> Table:
        """Return the rows that `_table_columns` wrote."""
        ids = self.whole(f"{prefix}id", None)
        n = len(ids)
        label = self.whole(f"{prefix}label", n)
        self.index(f"{prefix}label", len(CLASSES), label)
        missing = self.bits(f"{prefix}missing", n * len(steps)).reshape(len(steps), n)
        order, runs = runs_of(ids)
        values = {}
        for (name, step), unknown in zip(steps.items(), missing, strict=True):
            changes = self.whole(f"{prefix}{name}", n)
            column = np.zeros(n, np.int64)
            column[order] = sums(sums(changes, runs) if name in TWICE else changes, runs)
            values[name] = np.where(unknown, np.nan, from_steps(column, step))
        places = [values.pop(name) for name in BOX]
        boxes = Boxes(np.stack(places[:3], axis=1), np.stack(places[3:6], axis=1), places[6], label, ids)
        return Table(boxes, values, self.ends(f"{prefix}count", instants, n))


def read_ticks(reader: ColumnReader, actors: TrafficLog, claims: Sequence[str]) -> list[Tick]:
    """Return the steps of a file.

    Args:
        actors: one step before the first tick, then tick by tick.
        claims: names of the helpers that report false objects.

    Raises:
        DataError: a column is missing or invalid.
    """
    count = len(actors) - 1
    egos, decisions, percepts = _egos(reader, count), _decisions(reader, count), _percepts(reader, count)
    tracks, contacts = _tracks(reader, count), _contacts(reader, count)
    claimed: list[dict[str, Actors]] = [{} for _ in range(count)]
    for number, name in enumerate(claims):
        log = reader.traffic(f"claim{number}/")
        steps = reader.array(f"claim{number}/steps", "i8", (len(log),))
        for row, step in enumerate(reader.index(f"claim{number}/steps", count, steps)):
            claimed[step][name] = log[row]
    return [
        Tick(actors[i + 1], egos[i], percepts[i], tracks[i], decisions[i], claimed[i], contacts.get(i))
        for i in range(count)
    ]


def _egos(reader: ColumnReader, count: int) -> list[EgoState]:
    numbers, ids = reader.array("ego/numbers", "f8", (count, 14)), reader.array("ego/ids", "i8", (count, 2))
    reader.index("ego/ids", len(CLASSES), ids[:, 0])
    states = reader.array("light/state", "i8", (None,))
    named = [STATES[row] for row in reader.index("light/state", len(STATES), states)]
    distance = reader.array("light/distance", "f8", (len(named),)).tolist()
    lights = [TrafficLight(state, away) for state, away in zip(named, distance, strict=True)]
    lit = reader.ends("light/count", count, len(lights))
    x = reader.whole("route/x", None)
    ends = reader.ends("route/count", count, len(x))
    runs = np.diff(ends)[np.diff(ends) > 0]
    whole = [sums(sums(values, runs), runs) for values in (x, reader.whole("route/y", len(x)))]
    route = from_steps(np.stack(whole, axis=1), POSITION_M)
    return [
        EgoState(
            time_s=row[0],
            box=Boxes.from_array(numbers[i : i + 1, 7:], ids[i : i + 1, 0], ids[i : i + 1, 1]),
            speed_mps=row[1],
            acceleration_mps2=row[2],
            route=route[ends[i] : ends[i + 1]],
            limits=Limits(*row[4:7]),
            lights=tuple(lights[lit[i] : lit[i + 1]]),
            progress_m=row[3],
        )
        for i, row in enumerate(numbers.tolist())
    ]


def _decisions(reader: ColumnReader, count: int) -> list[Decision]:
    reasons = reader.array("decision/reasons", "U", (None,)).tolist()
    reason = reader.array("decision/reason", "i8", (count,))
    steers = np.full(count, np.nan)
    if "decision/steering" in reader.columns:
        steers = reader.array("decision/steering", "f8", (count,))
    return [
        Decision(acceleration, reasons[row], track, None if math.isnan(steering) else steering)
        for acceleration, row, track, steering in zip(
            reader.array("decision/acceleration", "f8", (count,)).tolist(),
            reader.index("decision/reason", len(reasons), reason),
            reader.array("decision/track", "i8", (count,)).tolist(),
            steers.tolist(),
            strict=True,
        )
    ]


def _percepts(reader: ColumnReader, count: int) -> list[Percept | None]:
    present = reader.array("percept/present", "b1", (count,))
    known = int(present.sum())
    times = reader.array("percept/time", "f8", (known,)).tolist()
    table = reader.table("percept/", known, MOVING)
    links = _links(reader)
    linked = reader.ends("link/count", known, len(links))
    told = _told(reader, known)

    found: list[Percept | None] = [None] * count
    for instant, step in enumerate(np.flatnonzero(present).tolist()):
        rows = table.rows(instant)
        found[step] = Percept(
            time_s=times[instant],
            boxes=table.boxes[rows],
            score=table.values["score"][rows],
            velocity=table.velocity(rows),
            links=tuple(links[linked[instant] : linked[instant + 1]]),
            told=told[instant],
        )
    return found


def _told(reader: ColumnReader, known: int) -> list[tuple[Told, ...]]:
    """Return what became of the messages of each percept; nothing in episodes without attack and defence."""
    found: list[list[Told]] = [[] for _ in range(known)]
    if "told" in reader.columns:
        numbers = reader.array("told", "i8", (None, 7))
        reader.index("told", known, numbers[:, 0])
        for number, sender, objects, false, refused, false_refused, attacked in numbers.tolist():
            found[number].append(Told(sender, objects, false, refused, false_refused, bool(attacked)))
    return [tuple(one) for one in found]


def _links(reader: ColumnReader) -> list[Link]:
    ids = reader.array("link/ids", "i8", (None, 6))
    numbers = reader.array("link/numbers", "f8", (len(ids), 5)).tolist()
    room = 8 * len(reader.array("link/arrived", "u1", (None,)))
    packets = ids[:, 4]
    if (len(ids) and not 0 <= packets.min() <= packets.max() <= room) or (total := int(packets.sum())) > room:
        raise reader.wrong("link/ids", f"at most {room} packets", "others")
    arrived = reader.bits("link/arrived", total)
    # Logs of earlier versions do not tell who was held back, nor what it would have sent.
    held = reader.array("link/held", "b1", (len(ids),)) if "link/held" in reader.columns else np.zeros(len(ids), bool)
    offered = np.full(len(ids), -1)
    if "link/offered" in reader.columns:
        offered = reader.array("link/offered", "i8", (len(ids),))
    ends = np.concatenate([[0], np.cumsum(packets)])
    reader.index("link/ids", len(Obstruction), ids[:, 5])
    return [
        Link(
            sender=row[0],
            receiver=row[1],
            sent=row[2],
            age_s=number[0],
            delay_s=number[1],
            bytes=row[3],
            packets=row[4],
            arrived=arrived[ends[i] : ends[i + 1]],
            distance_m=number[2],
            sight=Obstruction(row[5]),
            probability=number[3],
            load=number[4],
            held=bool(held[i]),
            offered=None if offered[i] < 0 else int(offered[i]),
        )
        for i, (row, number) in enumerate(zip(ids.tolist(), numbers, strict=True))
    ]


def _tracks(reader: ColumnReader, count: int) -> list[Tracks]:
    times = reader.array("track/time", "f8", (count,)).tolist()
    table = reader.table("track/", count, TRACK)
    rows = [table.rows(instant) for instant in range(count)]
    return [
        Tracks(
            time_s=times[i],
            boxes=table.boxes[here],
            velocity=table.velocity(here),
            **{name: table.values[name][here] for name in ("yaw_rate", "position_sd", "score", "unseen_s")},
        )
        for i, here in enumerate(rows)
    ]


def _contacts(reader: ColumnReader, count: int) -> dict[int, Contact]:
    ids = reader.array("contact/ids", "i8", (None, 4))
    numbers = reader.array("contact/numbers", "f8", (len(ids), 4)).tolist()
    names = reader.array("contact/other", "U", (len(ids),)).tolist()
    reader.index("contact/ids", count, ids[:, 0])
    reader.index("contact/ids", len(SIDES), ids[:, 2])
    return {
        step: Contact(number[0], other_id, name, number[1], number[2], number[3], SIDES[side], bool(fault))
        for (step, other_id, side, fault), number, name in zip(ids.tolist(), numbers, names, strict=True)
    }
