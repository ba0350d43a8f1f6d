"""Columns of an episode log: ticks to the arrays of its file, and back, each checked when it is read."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.types import Decision, EgoState, Percept, Tick, Tracks
from sim.boxes import CLASSES, Boxes
from sim.contact import Contact, Side
from sim.errors import DataError, complaint
from sim.packed import differences, packed, sums, unpacked
from sim.radio import Link, Obstruction
from sim.traffic.base import ANGLE_RAD, POSITION_M, TIME_S, VELOCITY_MPS, Actors, Limits, TrafficLight, from_steps
from sim.traffic.log import TrafficLog, check_log_columns

SCORE = 1e-4
"""Resolution of scores."""
FARTHEST = 1e9
"""Largest number that a log holds, in its unit."""

_BOX = dict.fromkeys(("x", "y", "z", "length", "width", "height"), POSITION_M) | {"yaw": ANGLE_RAD}
_MOVING = {**_BOX, "score": SCORE, "vx": VELOCITY_MPS, "vy": VELOCITY_MPS}
_TRACK = {**_MOVING, "yaw_rate": ANGLE_RAD, "position_sd": POSITION_M, "unseen_s": TIME_S}
_TWICE = ("x", "y", "yaw")  # differences of differences: objects keep their speed
_STATES = get_args(TrafficLight.__annotations__["state"])
_SIDES: tuple[Side, ...] = get_args(Side)


def rounded_tick(tick: Tick) -> Tick:
    """Return a step rounded to the resolution of the log; idempotent.

    Raises:
        ValueError: a number is not finite, or beyond `FARTHEST`; only velocities of percepts may be NaN.
    """
    percept, tracks = tick.percept, tick.tracks
    if percept is not None:
        percept = replace(
            percept,
            boxes=_rounded_boxes(percept.boxes),
            score=_snapped(percept.score, SCORE),
            velocity=_snapped(percept.velocity, VELOCITY_MPS),
        )
    tracks = replace(
        tracks,
        boxes=_rounded_boxes(tracks.boxes),
        velocity=_snapped(tracks.velocity, VELOCITY_MPS),
        yaw_rate=_snapped(tracks.yaw_rate, ANGLE_RAD),
        position_sd=_snapped(tracks.position_sd, POSITION_M),
        score=_snapped(tracks.score, SCORE),
        unseen_s=_snapped(tracks.unseen_s, TIME_S),
    )
    return replace(
        tick,
        actors=tick.actors.rounded(),
        ego=replace(tick.ego, route=_snapped(tick.ego.route, POSITION_M)),
        percept=percept,
        tracks=tracks,
        claims={name: actors.rounded() for name, actors in tick.claims.items()},
    )


def _rounded_boxes(boxes: Boxes) -> Boxes:
    return replace(
        boxes,
        center=_snapped(boxes.center, POSITION_M),
        size=_snapped(boxes.size, POSITION_M),
        yaw=_snapped(boxes.yaw, ANGLE_RAD),
    )


def _snapped(values: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Return values rounded to multiples of a step; NaN stays."""
    missing = np.isnan(values)
    return np.where(missing, np.nan, from_steps(_in_steps(np.where(missing, 0.0, values), step), step))


def _in_steps(values: NDArray[np.float64], step: float) -> NDArray[np.int64]:
    if not (np.abs(values) <= FARTHEST).all():
        raise ValueError(f"a value of the episode is not finite or beyond {FARTHEST:g}")
    return np.rint(np.asarray(values, np.float64) * round(1.0 / step)).astype(np.int64)


def tick_columns(ticks: Sequence[Tick], claims: Sequence[str], step_s: float) -> dict[str, NDArray]:
    """Return the arrays of steps by name, without their actors.

    Args:
        ticks: rounded steps.
        claims: names of the helpers that report false objects.
        step_s: time between two steps, s.
    """
    columns = {
        **_ego_columns([tick.ego for tick in ticks]),
        **_decision_columns([tick.decision for tick in ticks]),
        **_percept_columns([tick.percept for tick in ticks]),
        **_track_columns([tick.tracks for tick in ticks]),
        **_contact_columns([tick.contact for tick in ticks]),
    }
    for number, name in enumerate(claims):
        steps = [step for step, tick in enumerate(ticks) if name in tick.claims]
        claimed = TrafficLog(step_s)
        for step in steps:
            claimed.append(ticks[step].claims[name])
        columns |= below(f"claim{number}/", {"steps": np.array(steps, np.int64), **claimed.columns()})
    return columns


def below(prefix: str, columns: dict[str, NDArray]) -> dict[str, NDArray]:
    """Return columns with a prefix before their names."""
    return {f"{prefix}{name}": column for name, column in columns.items()}


def _ego_columns(egos: Sequence[EgoState]) -> dict[str, NDArray]:
    numbers = [
        (
            *(ego.time_s, ego.speed_mps, ego.acceleration_mps2, ego.progress_m),
            *(ego.limits.speed_mps, ego.limits.acceleration_mps2, ego.limits.deceleration_mps2),
            *ego.box.array[0],
        )
        for ego in egos
    ]
    lights = [light for ego in egos for light in ego.lights]
    lengths = np.array([len(ego.route) for ego in egos], np.int64)
    route = _in_steps(_joined([ego.route for ego in egos], (2,)), POSITION_M)
    runs = lengths[lengths > 0]
    return {
        "ego/numbers": np.array(numbers, np.float64).reshape(-1, 14),
        "ego/ids": np.array([(ego.box.label[0], ego.box.object_id[0]) for ego in egos], np.int64).reshape(-1, 2),
        "light/count": np.array([len(ego.lights) for ego in egos], np.int64),
        "light/state": np.array([_STATES.index(light.state) for light in lights], np.int64),
        "light/distance": np.array([light.distance_m for light in lights], np.float64),
        "route/count": lengths,
        **{f"route/{axis}": packed(_twice(values, runs)) for axis, values in zip("xy", route.T, strict=True)},
    }


def _decision_columns(decisions: Sequence[Decision]) -> dict[str, NDArray]:
    reasons = sorted({decision.reason for decision in decisions})
    return {
        "decision/acceleration": np.array([decision.acceleration_mps2 for decision in decisions], np.float64),
        "decision/track": np.array([decision.track for decision in decisions], np.int64),
        "decision/reason": np.array([reasons.index(decision.reason) for decision in decisions], np.int64),
        "decision/reasons": np.array(reasons, np.str_),
    }


def _percept_columns(percepts: Sequence[Percept | None]) -> dict[str, NDArray]:
    known = [percept for percept in percepts if percept is not None]
    boxes = [percept.boxes for percept in known]
    values = np.concatenate(
        [
            _joined([one.array for one in boxes], (7,)),
            _joined([percept.score[:, None] for percept in known], (1,)),
            _joined([percept.velocity for percept in known], (2,)),
        ],
        axis=1,
    )
    links = [link for percept in known for link in percept.links]
    arrived = np.concatenate([np.zeros(0, bool), *(link.arrived for link in links)])
    return {
        "percept/present": np.array([percept is not None for percept in percepts], bool),
        "percept/time": np.array([percept.time_s for percept in known], np.float64),
        **_table_columns("percept/", boxes, values, _MOVING),
        "link/count": np.array([len(percept.links) for percept in known], np.int64),
        "link/ids": np.array(
            [(one.sender, one.receiver, one.sent, one.bytes, len(one.arrived), one.sight) for one in links], np.int64
        ).reshape(-1, 6),
        "link/numbers": np.array(
            [(one.age_s, one.delay_s, one.distance_m, one.probability, one.load) for one in links], np.float64
        ).reshape(-1, 5),
        "link/arrived": np.packbits(arrived),
    }


def _track_columns(tracks: Sequence[Tracks]) -> dict[str, NDArray]:
    scalars = ("yaw_rate", "position_sd", "unseen_s")
    values = np.concatenate(
        [
            _joined([one.boxes.array for one in tracks], (7,)),
            _joined([one.score[:, None] for one in tracks], (1,)),
            _joined([one.velocity for one in tracks], (2,)),
            *(_joined([getattr(one, name)[:, None] for one in tracks], (1,)) for name in scalars),
        ],
        axis=1,
    )
    return {
        "track/time": np.array([one.time_s for one in tracks], np.float64),
        **_table_columns("track/", [one.boxes for one in tracks], values, _TRACK),
    }


def _contact_columns(contacts: Sequence[Contact | None]) -> dict[str, NDArray]:
    known = [(step, contact) for step, contact in enumerate(contacts) if contact is not None]
    return {
        "contact/ids": np.array(
            [(step, one.other_id, _SIDES.index(one.side), one.at_fault) for step, one in known], np.int64
        ).reshape(-1, 4),
        "contact/numbers": np.array(
            [(one.time_s, one.ego_speed_mps, one.closing_mps, one.delta_v_mps) for _, one in known], np.float64
        ).reshape(-1, 4),
        "contact/other": np.array([one.other for _, one in known], np.str_),
    }


def _table_columns(
    prefix: str, boxes: Sequence[Boxes], values: NDArray[np.float64], steps: dict[str, float]
) -> dict[str, NDArray]:
    """Columns of the rows of several instants, in the order of `steps`; differences of rows with the same object id."""
    ids = _joined([one.object_id for one in boxes], ()).astype(np.int64)
    order, runs = _runs(ids)
    missing = np.isnan(values)
    columns: dict[str, NDArray] = {
        "count": np.array([len(one) for one in boxes], np.int64),
        "id": packed(ids),
        "label": packed(_joined([one.label for one in boxes], ()).astype(np.int64)),
        "missing": np.packbits(missing.T.ravel()),
    }
    for name, column, unknown in zip(steps, values.T, missing.T, strict=True):
        whole = _in_steps(np.where(unknown, 0.0, column), steps[name])[order]
        columns[name] = packed(_twice(whole, runs) if name in _TWICE else differences(whole, runs, keep=True))
    return below(prefix, columns)


def _runs(ids: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the order of rows by object id, and the lengths of its runs; a row without an id is a run of its own."""
    order = np.argsort(ids, kind="stable")
    starts = np.flatnonzero((np.diff(ids[order], prepend=-2) != 0) | (ids[order] < 0))
    return order, np.diff(starts, append=len(ids))


def _twice(values: NDArray[np.int64], runs: NDArray[np.int64]) -> NDArray[np.int64]:
    return differences(differences(values, runs, keep=True), runs, keep=True)


def _joined(parts: Sequence[NDArray], shape: tuple[int, ...]) -> NDArray:
    return np.concatenate([np.zeros((0, *shape)), *parts])


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
        order, runs = _runs(ids)
        values = {}
        for (name, step), unknown in zip(steps.items(), missing, strict=True):
            changes = self.whole(f"{prefix}{name}", n)
            column = np.zeros(n, np.int64)
            column[order] = sums(sums(changes, runs) if name in _TWICE else changes, runs)
            values[name] = np.where(unknown, np.nan, from_steps(column, step))
        places = [values.pop(name) for name in _BOX]
        boxes = Boxes(np.stack(places[:3], axis=1), np.stack(places[3:6], axis=1), places[6], label, ids)
        return Table(boxes, values, self.ends(f"{prefix}count", instants, n))


def read_ticks(reader: ColumnReader, actors: TrafficLog, claims: Sequence[str]) -> list[Tick]:
    """Return the steps of a file.

    Args:
        reader: of its columns.
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
    named = [_STATES[row] for row in reader.index("light/state", len(_STATES), states)]
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
    return [
        Decision(acceleration, reasons[row], track)
        for acceleration, row, track in zip(
            reader.array("decision/acceleration", "f8", (count,)).tolist(),
            reader.index("decision/reason", len(reasons), reason),
            reader.array("decision/track", "i8", (count,)).tolist(),
            strict=True,
        )
    ]


def _percepts(reader: ColumnReader, count: int) -> list[Percept | None]:
    present = reader.array("percept/present", "b1", (count,))
    known = int(present.sum())
    times = reader.array("percept/time", "f8", (known,)).tolist()
    table = reader.table("percept/", known, _MOVING)
    links = _links(reader)
    linked = reader.ends("link/count", known, len(links))

    found: list[Percept | None] = [None] * count
    for instant, step in enumerate(np.flatnonzero(present).tolist()):
        rows = table.rows(instant)
        found[step] = Percept(
            time_s=times[instant],
            boxes=table.boxes[rows],
            score=table.values["score"][rows],
            velocity=table.velocity(rows),
            links=tuple(links[linked[instant] : linked[instant + 1]]),
        )
    return found


def _links(reader: ColumnReader) -> list[Link]:
    ids = reader.array("link/ids", "i8", (None, 6))
    numbers = reader.array("link/numbers", "f8", (len(ids), 5)).tolist()
    room = 8 * len(reader.array("link/arrived", "u1", (None,)))
    packets = ids[:, 4]
    if (len(ids) and not 0 <= packets.min() <= packets.max() <= room) or (total := int(packets.sum())) > room:
        raise reader.wrong("link/ids", f"at most {room} packets", "others")
    arrived = reader.bits("link/arrived", total)
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
        )
        for i, (row, number) in enumerate(zip(ids.tolist(), numbers, strict=True))
    ]


def _tracks(reader: ColumnReader, count: int) -> list[Tracks]:
    times = reader.array("track/time", "f8", (count,)).tolist()
    table = reader.table("track/", count, _TRACK)
    rows = [table.rows(instant) for instant in range(count)]
    return [
        Tracks(
            time_s=times[i],
            boxes=table.boxes[here],
            velocity=table.velocity(here),
            yaw_rate=table.values["yaw_rate"][here],
            position_sd=table.values["position_sd"][here],
            score=table.values["score"][here],
            unseen_s=table.values["unseen_s"][here],
        )
        for i, here in enumerate(rows)
    ]


def _contacts(reader: ColumnReader, count: int) -> dict[int, Contact]:
    ids = reader.array("contact/ids", "i8", (None, 4))
    numbers = reader.array("contact/numbers", "f8", (len(ids), 4)).tolist()
    names = reader.array("contact/other", "U", (len(ids),)).tolist()
    reader.index("contact/ids", count, ids[:, 0])
    reader.index("contact/ids", len(_SIDES), ids[:, 2])
    return {
        step: Contact(number[0], other_id, name, number[1], number[2], number[3], _SIDES[side], bool(fault))
        for (step, other_id, side, fault), number, name in zip(ids.tolist(), numbers, names, strict=True)
    }
