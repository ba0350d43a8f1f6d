"""Tracks of road users at irregular times, and the traffic log that they become."""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim.bodies.choice import choose_model
from sim.boxes import CLASSES, Boxes
from sim.errors import DataError, complaint, did_you_mean
from sim.geometry import wrap_angle
from sim.traffic.base import Actors
from sim.traffic.log import TrafficLog

STEP_S = 0.1
"""Step of the traffic log, s."""
GAP_S = 1.0
"""Time between two samples of a track from which on the road user is away in between, s."""
FASTEST_MPS = 150.0
"""Speed above which two samples of a track are those of two places, and the road user is away in between."""
LONGEST_S = 3600.0
LONGEST_M = 100.0
FARTHEST_M = 1e7
FIRST_ID = 1000

_ASKEW_RAD = math.radians(30.0)
"""Angle between the axis and the way of a vehicle that no slip explains: in tight bends it is up to 20 degrees."""
_STEP_M = 0.2
"""Way over which the heading of one who walks is taken, m."""
_STRIDE_M = 1.0
"""Way over which the direction of a motion is taken, m."""
_JUMP_M = 5.0
"""Way below which a step is no jump, however short it took: places are noisy."""

_SIZE_M = {
    "car": (4.5, 1.8, 1.5),
    "van": (5.2, 2.0, 2.1),
    "truck": (8.6, 2.5, 3.4),
    "bus": (12.0, 2.55, 3.2),
    "motorcycle": (2.2, 0.85, 1.5),
    "bicycle": (1.75, 0.65, 1.7),
    "pedestrian": (0.6, 0.6, 1.75),
}
"""Length, width and height of the box of each class where a file has none, m."""
_LONG_M = 6.5
"""Length from which on a vehicle without a closer class is a truck, m."""
_NAMES = {
    "vehicle": "car",
    "taxi": "car",
    "priorityvehicle": "car",
    "parkedvehicle": "car",
    "cyclist": "bicycle",
    "bike": "bicycle",
    "motorcyclist": "motorcycle",
    "motorbike": "motorcycle",
    "person": "pedestrian",
    "trailer": "truck",
    "lorry": "truck",
}
_NO_ROAD_USERS = frozenset(
    "unknown unset train roadboundary building pillar median_strip constructionzone construction_zone generic_object "
    "traffic_cone traffic_barrier traffic_object barrier czone_sign traffic_light other".split()
)

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Road user over time, world frame.

    Attributes:
        name: id in its file.
        class_name: one of `sim.boxes.CLASSES`.
        size: (3,) length, width and height, m.
        time_s: (T,) ascending, s.
        center: (T, 3) centre of the box, m; z is NaN for one that stands on the ground at 0.
        yaw: (T,) rad.
    """

    name: str
    class_name: str
    size: NDArray[np.float64]
    time_s: NDArray[np.float64]
    center: NDArray[np.float64]
    yaw: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Content of a track file.

    Attributes:
        tracks: of road users.
        lanes: (K, 2) outlines of the lanes, m; none where the file has no map.
        part: name of this recording in a file that holds several, each with times and ids of its own.
    """

    tracks: tuple[Track, ...]
    lanes: tuple[NDArray[np.float64], ...] = ()
    part: str = ""

    @property
    def ground_m(self) -> float:
        """Height of the ground: the median of where the road users stand, m."""
        bottoms = [one.center[:, 2] - 0.5 * one.size[2] for one in self.tracks]
        known = np.concatenate([np.zeros(0), *bottoms])
        known = known[np.isfinite(known)]
        return float(np.round(np.median(known), 3)) if len(known) else 0.0


def class_of(path: Path, field: str, text: str, length_m: float) -> str | None:
    """Return the class of a road user by its name in a file; None for what is no road user, such as a cone.

    Args:
        path: of the file, for the message.
        text: name of ours, of CommonRoad, ScenarioNet or nuPlan, in any case.
        length_m: a vehicle that is no more closely named is a truck from `_LONG_M` on.

    Raises:
        DataError: the name is unknown.
    """
    name = text.strip().lower()
    if name in _NO_ROAD_USERS:
        return None
    if name == "vehicle" and length_m >= _LONG_M:
        return "truck"
    name = _NAMES.get(name, name)
    if name not in CLASSES:
        raise DataError(complaint(path, field, "a class of road user", text, did_you_mean(name, [*CLASSES, *_NAMES])))
    return name


def heading_of_motion(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (T,) headings in which places in order of time, (T, 2) m, are left; those of one that stands are kept.

    One that never moves by `_STEP_M` faces +x.
    """
    marks = [0]
    for row in range(1, len(xy)):
        if np.hypot(*(xy[row] - xy[marks[-1]])) >= _STEP_M:
            marks.append(row)
    if len(marks) == 1:
        return np.zeros(len(xy))
    way = np.diff(xy[marks], axis=0)
    return np.arctan2(way[:, 1], way[:, 0])[np.searchsorted(marks[1:-1], np.arange(len(xy)), side="right")]


def check_tracks(path: Path, recording: Recording) -> None:
    """Check the tracks of a file together; headings that disagree with the motion are logged as a warning.

    Raises:
        DataError: a name is there twice, or the places are no metres.
    """
    names = [one.name for one in recording.tracks]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise DataError(complaint(path, "id", "ids that differ", twice))
    _check_metres(path, recording.tracks)
    turns = [(one.name, turn) for one in recording.tracks if (turn := _askew_rad(one)) is not None]
    askew = [(name, turn) for name, turn in turns if turn > _ASKEW_RAD]
    if askew:
        name, turn = askew[0]
        _log.warning(
            "%s: the headings of %d of %d moving vehicles disagree with their motion, such as object '%s' by %.0f "
            "degrees: expected radians, counter-clockwise from +x",
            path,
            len(askew),
            len(turns),
            name,
            math.degrees(turn),
        )


def _check_metres(path: Path, tracks: Sequence[Track]) -> None:
    """Check that a file with two vehicles at a time reaches over half the width of one: in degrees it does not."""
    vehicles = sorted((one for one in tracks if one.class_name != "pedestrian"), key=lambda one: one.time_s[0])
    if not any(one.time_s[0] <= before.time_s[-1] for before, one in pairwise(vehicles)):
        return
    extent = float(np.ptp(np.concatenate([one.center[:, :2] for one in tracks]), axis=0).max())
    if 0.0 < extent < 0.5 * min(one.size[1] for one in vehicles):
        found = f"{len(vehicles)} vehicles within {extent:.2g}"
        raise DataError(complaint(path, "x, y", "metres", found, "; are they in degrees?"))


def _askew_rad(one: Track) -> float | None:
    """Return the median angle between the axis of a vehicle and its way; None for one that hardly moves, or walks."""
    if one.class_name == "pedestrian" or len(one.time_s) < 2:
        return None
    way_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(one.center[:, :2], axis=0).T))])
    marks = np.flatnonzero(np.diff(np.floor(way_m / _STRIDE_M), prepend=-1.0))
    strides = np.diff(one.center[marks, :2], axis=0)
    went = np.hypot(*strides.T) > 0.5 * _STRIDE_M  # jitter of one that stands goes nowhere
    if went.sum() < 2:
        return None
    middle = (marks[:-1] + marks[1:]) // 2
    turn = np.arctan2(strides[:, 1], strides[:, 0]) - one.yaw[middle]
    # Of the axis: backwards is a motion too.
    return float(np.median(np.abs(np.arctan(np.tan(turn[went])))))


def make_track(
    path: Path,
    name: str,
    class_name: str,
    size: Sequence[float],
    time_s: NDArray[np.float64],
    center: NDArray[np.float64],
    yaw: NDArray[np.float64],
) -> Track:
    """Return a checked track in order of time; a size of NaN is that of its class.

    Raises:
        DataError: a value is not finite or out of its range, or a time is there twice; names the object.
    """
    field = f"object '{name}'"
    known = zip(map(float, size), _SIZE_M[class_name], strict=True)
    length, width, height = (usual if math.isnan(value) else value for value, usual in known)
    if not all(0.0 < value < LONGEST_M for value in (length, width, height)):
        found = f"{length:g} x {width:g} x {height:g}"
        raise DataError(complaint(path, f"{field}: size", f"three lengths in (0, {LONGEST_M:g}) m", found))
    order = np.argsort(time_s, kind="stable")
    time_s, center, yaw = time_s[order], center[order], yaw[order]
    for what, values in (("time", time_s), ("x, y", center[:, :2]), ("yaw", yaw)):
        if not np.isfinite(values).all():
            raise DataError(complaint(path, f"{field}: {what}", "finite numbers", "NaN or infinity"))
    if (np.abs(center) > FARTHEST_M).any():
        raise DataError(complaint(path, f"{field}: x, y, z", f"places within {FARTHEST_M:g} m", "one beyond"))
    twice = np.flatnonzero(np.diff(time_s) <= 0.0)
    if len(twice):
        raise DataError(complaint(path, f"{field}: time", "each time once", f"{time_s[twice[0]]:g} s twice"))
    return Track(name, class_name, np.array([length, width, height]), time_s, center, yaw)


def to_log(path: Path, recording: Recording, about: dict | None = None) -> TrafficLog:
    """Return the traffic log of tracks, every `STEP_S` from the first sample on.

    Between two samples the place is interpolated, the heading by the shortest arc. A road user is away before its first
    sample, after its last and in gaps of more than `GAP_S`; between samples that it could join only faster than
    `FASTEST_MPS` it is away too, and its motion is cut. Gaps and jumps are logged as warnings. Ids are `FIRST_ID` and
    on, in the order of the file; names are those of the file.

    Args:
        path: of the file, for messages.

    Raises:
        DataError: there is no track, they last longer than `LONGEST_S`, or most samples are more than `GAP_S` apart.
    """
    if not recording.tracks:
        raise DataError(complaint(path, "tracks", "at least one road user", "none"))
    first = min(float(one.time_s[0]) for one in recording.tracks)
    last = max(float(one.time_s[-1]) for one in recording.tracks)
    apart = np.concatenate([np.diff(one.time_s) for one in recording.tracks])
    usual = float(np.median(apart)) if len(apart) else 0.0
    hint = "; is it in milliseconds, or a frame's number?" if usual > GAP_S + 1e-6 else ""
    if last - first > LONGEST_S:
        expected = f"seconds, at most {LONGEST_S:g} from first to last"
        raise DataError(complaint(path, "time", expected, f"{last - first:g}", hint))
    if hint:
        raise DataError(
            complaint(path, "time", f"seconds, most samples at most {GAP_S:g} s apart", f"{usual:g} s", hint)
        )
    steps = math.floor((last - first) / STEP_S + 1e-6) + 1
    times = np.asarray(first + STEP_S * np.arange(steps), np.float64)
    sampled = [_sampled(path, one, times) for one in recording.tracks]
    present: list[list[int]] = [[] for _ in times]
    for row, track in enumerate(sampled):
        for i in (track.first + np.flatnonzero(track.there)).tolist():
            present[i].append(row)
    ground = recording.ground_m
    models = [choose_model(one.class_name, one.name, 0) for one in recording.tracks]
    log = TrafficLog(STEP_S, about)
    for step, time_s in enumerate(times):
        rows = present[step]
        at = [(sampled[row], step - sampled[row].first) for row in rows]
        center = np.array([one.center[i] for one, i in at]).reshape(-1, 3)
        size = np.array([recording.tracks[row].size for row in rows]).reshape(-1, 3)
        center[:, 2] = np.where(np.isnan(center[:, 2]), ground + 0.5 * size[:, 2], center[:, 2])
        velocity = np.array([one.motion[i] for one, i in at]).reshape(-1, 2, 2)
        n = len(rows)
        log.append(
            Actors(
                time_s=float(time_s - first),
                boxes=Boxes(
                    center=center,
                    size=size,
                    yaw=np.array([one.yaw[i] for one, i in at], np.float64),
                    label=np.array([CLASSES.index(recording.tracks[row].class_name) for row in rows], np.int64),
                    object_id=FIRST_ID + np.array(rows, np.int64),
                ),
                pitch=np.zeros(n),
                velocity=velocity[:, 0],
                acceleration=velocity[:, 1],
                model=tuple(models[row] for row in rows),
                name=tuple(recording.tracks[row].name for row in rows),
                signals=np.zeros(n, np.int32),
                lane=("",) * n,
            )
        )
    return log


class _Sampled(NamedTuple):
    """Track at S steps from the first: (S,) there, (S, 3) centres, (S,) yaw, (S, 2, 2) velocity and acceleration."""

    first: int
    there: NDArray[np.bool_]
    center: NDArray[np.float64]
    yaw: NDArray[np.float64]
    motion: NDArray[np.float64]


def _sampled(path: Path, one: Track, times: NDArray[np.float64]) -> _Sampled:
    """Return a track at the steps between its ends: most tracks are far shorter than their recording."""
    first = int(np.searchsorted(times, one.time_s[0] - 1e-6))
    times = times[first : int(np.searchsorted(times, one.time_s[-1] + 1e-6, side="right"))]
    there = (times >= one.time_s[0] - 1e-6) & (times <= one.time_s[-1] + 1e-6)
    took_s, way_m = np.diff(one.time_s), np.hypot(*np.diff(one.center[:, :2], axis=0).T)
    jumps = (way_m > _JUMP_M) & (way_m > FASTEST_MPS * took_s)
    if jumps.any():
        first_jump = int(np.argmax(jumps))
        said = "%s: object '%s': jumps, %d in all, the first of %.0f m from %.2f s to %.2f s: its motion is cut there"
        between = one.time_s[first_jump], one.time_s[first_jump + 1]
        _log.warning(said, path, one.name, int(jumps.sum()), way_m[first_jump], *between)
    cuts = np.flatnonzero((took_s > GAP_S + 1e-6) | jumps)
    for cut in cuts:
        start, end = one.time_s[cut : cut + 2]
        if not jumps[cut]:
            _log.warning("%s: object '%s': no samples from %.2f s to %.2f s: it is away", path, one.name, start, end)
        there &= (times <= start + 1e-6) | (times >= end - 1e-6)
        # A step at a sample has its place, not one a rounding error of the time beyond it, on the way to the next.
        for sample in (start, end):
            times = np.where(np.abs(times - sample) <= 1e-6, sample, times)
    if not there.any():
        _log.warning("%s: object '%s': between two steps of %g s: it is left out", path, one.name, STEP_S)
    center = np.column_stack([np.interp(times, one.time_s, one.center[:, axis]) for axis in range(3)])
    yaw = np.asarray(wrap_angle(np.interp(times, one.time_s, np.unwrap(one.yaw))), np.float64)
    motion = np.zeros((len(times), 2, 2))
    known = np.flatnonzero(there)
    part = np.searchsorted(one.time_s[cuts], times[known])
    for run in np.split(known, np.flatnonzero((np.diff(known) > 1) | (np.diff(part) > 0)) + 1):
        if len(run) > 1:
            motion[run, 0] = np.gradient(center[run, :2], STEP_S, axis=0)
            motion[run[1:], 1] = np.diff(motion[run, 0], axis=0) / STEP_S
    return _Sampled(first, there, center, yaw, motion)
