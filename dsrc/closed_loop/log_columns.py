"""Columns of an episode log: ticks, rounded, to the arrays of its file; `dsrc.closed_loop.log_reader` reads them."""

from collections.abc import Sequence
from dataclasses import astuple, replace
from typing import Any, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.types import Decision, EgoState, Percept, Tick, Tracks
from sim.boxes import Boxes
from sim.contact import Contact, Side
from sim.packed import differences, packed
from sim.rows import stacked
from sim.traffic.base import ANGLE_RAD, POSITION_M, TIME_S, VELOCITY_MPS, TrafficLight, from_steps
from sim.traffic.log import TrafficLog

T = TypeVar("T", Boxes, Percept, Tracks)

SCORE = 1e-4
"""Resolution of scores."""
FARTHEST = 1e9
"""Largest number that a log holds, in its unit."""
BOX = dict.fromkeys(("x", "y", "z", "length", "width", "height"), POSITION_M) | {"yaw": ANGLE_RAD}
MOVING = {**BOX, "score": SCORE, "vx": VELOCITY_MPS, "vy": VELOCITY_MPS}
TRACK = {**MOVING, "yaw_rate": ANGLE_RAD, "position_sd": POSITION_M, "unseen_s": TIME_S}
_STEPS = {"center": POSITION_M, "size": POSITION_M, "yaw": ANGLE_RAD, "velocity": VELOCITY_MPS, "score": SCORE}
_STEPS |= {name: TRACK[name] for name in ("yaw_rate", "position_sd", "unseen_s")}
TWICE = ("x", "y", "yaw")  # differences of differences: objects keep their speed
_NO_TRACKS = Tracks(0.0, Boxes.zeros(), np.zeros((0, 2)), *[np.zeros(0)] * 4)
STATES = get_args(TrafficLight.__annotations__["state"])
SIDES: tuple[Side, ...] = get_args(Side)


def rounded_tick(tick: Tick) -> Tick:
    """Return a step rounded to the resolution of the log; idempotent.

    Raises:
        ValueError: a number is not finite, or beyond `FARTHEST`; only velocities of percepts may be NaN.
    """
    return replace(
        tick,
        actors=tick.actors.rounded(),
        ego=replace(tick.ego, route=_snapped(tick.ego.route, POSITION_M)),
        percept=None if tick.percept is None else _rounded(tick.percept),
        tracks=_rounded(tick.tracks),
        claims={name: actors.rounded() for name, actors in tick.claims.items()},
    )


def _rounded(table: T) -> T:
    """Return boxes, or a table with boxes, with the columns of `_STEPS` rounded."""
    changed: dict[str, Any] = {}
    for name in ("boxes", *_STEPS):
        if (column := getattr(table, name, None)) is not None:
            changed[name] = _rounded(column) if name == "boxes" else _snapped(column, _STEPS[name])
    return replace(table, **changed)


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
        "light/state": np.array([STATES.index(light.state) for light in lights], np.int64),
        "light/distance": np.array([light.distance_m for light in lights], np.float64),
        "route/count": lengths,
        **{f"route/{axis}": packed(_twice(values, runs)) for axis, values in zip("xy", route.T, strict=True)},
    }


def _decision_columns(decisions: Sequence[Decision]) -> dict[str, NDArray]:
    reasons = sorted({decision.reason for decision in decisions})
    steers = [np.nan if decision.steering_rad is None else decision.steering_rad for decision in decisions]
    return {
        "decision/acceleration": np.array([decision.acceleration_mps2 for decision in decisions], np.float64),
        "decision/track": np.array([decision.track for decision in decisions], np.int64),
        "decision/reason": np.array([reasons.index(decision.reason) for decision in decisions], np.int64),
        "decision/reasons": np.array(reasons, np.str_),
        **({} if np.isnan(steers).all() else {"decision/steering": np.array(steers, np.float64)}),
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
    told = [(one, number) for number, percept in enumerate(known) for one in percept.told]
    arrived = np.concatenate([np.zeros(0, bool), *(link.arrived for link in links)])
    return {
        "percept/present": np.array([percept is not None for percept in percepts], bool),
        "percept/time": np.array([percept.time_s for percept in known], np.float64),
        **_table_columns("percept/", boxes, values, MOVING),
        "link/count": np.array([len(percept.links) for percept in known], np.int64),
        "link/ids": np.array(
            [(one.sender, one.receiver, one.sent, one.bytes, len(one.arrived), one.sight) for one in links], np.int64
        ).reshape(-1, 6),
        "link/numbers": np.array(
            [(one.age_s, one.delay_s, one.distance_m, one.probability, one.load) for one in links], np.float64
        ).reshape(-1, 5),
        "link/arrived": np.packbits(arrived),
        "link/held": np.array([one.held for one in links], bool),
        "link/offered": np.array([-1 if one.offered is None else one.offered for one in links], np.int64),
        **({"told": np.array([(number, *astuple(one)) for one, number in told], np.int64)} if told else {}),
    }


def _track_columns(tracks: Sequence[Tracks]) -> dict[str, NDArray]:
    every = stacked(_NO_TRACKS, *tracks)
    scalars = (every.yaw_rate, every.position_sd, every.unseen_s)
    values = np.column_stack([every.boxes.array, every.score, every.velocity, *scalars])
    return {
        "track/time": np.array([one.time_s for one in tracks], np.float64),
        **_table_columns("track/", [one.boxes for one in tracks], values, TRACK),
    }


def _contact_columns(contacts: Sequence[Contact | None]) -> dict[str, NDArray]:
    known = [(step, contact) for step, contact in enumerate(contacts) if contact is not None]
    return {
        "contact/ids": np.array(
            [(step, one.other_id, SIDES.index(one.side), one.at_fault) for step, one in known], np.int64
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
    order, runs = runs_of(ids)
    missing = np.isnan(values)
    columns: dict[str, NDArray] = {
        "count": np.array([len(one) for one in boxes], np.int64),
        "id": packed(ids),
        "label": packed(_joined([one.label for one in boxes], ()).astype(np.int64)),
        "missing": np.packbits(missing.T.ravel()),
    }
    for name, column, unknown in zip(steps, values.T, missing.T, strict=True):
        whole = _in_steps(np.where(unknown, 0.0, column), steps[name])[order]
        columns[name] = packed(_twice(whole, runs) if name in TWICE else differences(whole, runs, keep=True))
    return below(prefix, columns)


def runs_of(ids: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the order of rows by object id, and the lengths of its runs; a row without an id is a run of its own."""
    order = np.argsort(ids, kind="stable")
    starts = np.flatnonzero((np.diff(ids[order], prepend=-2) != 0) | (ids[order] < 0))
    return order, np.diff(starts, append=len(ids))


def _twice(values: NDArray[np.int64], runs: NDArray[np.int64]) -> NDArray[np.int64]:
    return differences(differences(values, runs, keep=True), runs, keep=True)


def _joined(parts: Sequence[NDArray], shape: tuple[int, ...]) -> NDArray:
    return np.concatenate([np.zeros((0, *shape)), *parts])
