"""Driver in a process of its own: a program that answers over its standard input and output, or on a local port.

`examples/13_driver_process.py` is the other end, to be copied into the environment of a policy. Messages are framed as
those of detectors, see `dsrc.detectors.message`. Each question gets one answer:

| question | answer |
|---|---|
| `{"type": "hello", "protocol": 1, "role": "driver"}` | `{"type": "hello", "protocol": 1, "role": "driver", \
"name": TEXT, "wants": [...]}` |
| `{"type": "reset"}`, before every episode | `{"type": "ready"}` |
| `{"type": "decide", "ego": {...}, "lights": [...], "classes": [N], ...}`, arrays below | `{"type": "decision"}`, \
array `decision` (1,) or (2,) f4 or f8: acceleration, m/s2, and steering, rad, of one that leaves its route |
| any | `{"type": "error", "message": TEXT}` |

An answer may have `reason`, a word, and `track`, the number of the decisive one. All is in the world frame (x east, y
north, yaw counter-clockwise from x), as `dsrc.closed_loop.types` has it:

* `ego`: `time_s`, `speed_mps`, `acceleration_mps2`, `progress_m`, and its limits `limit_mps`, `most_mps2`,
  `brakes_mps2`; arrays `ego_box` (7,) x, y, z of the centre, length, width, height, yaw, and `route` (K, 2) from there;
* `lights`: on the route, nearest first, each with `state` and `distance_m` to its stop line;
* N tracks: `classes`, arrays `track` (N,) i8 numbers, `boxes` (N, 7), `velocity` (N, 2), and `yaw_rate`,
  `position_sd`, `score`, `unseen_s` of shape (N,);
* where `wants` has `conflicts`: `conflicts`, the lanes that cross the route or merge into it, each with `meets`,
  `gives_way` and `signal`; array `conflict_k` (P, 4) x, y, heading and speed limit along lane k;
* where `wants` has `seen`, and new sweeps have arrived: `views` of the agents, the ego first, each with `agent_id`,
  `time_s`, `xy` and `yaw`; array `view_k` (A, R) u1, whether sector and ring of agent k are seen.

Arrays are f8 unless told otherwise. Fields that are not known are passed over.
"""

import threading
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from dsrc.closed_loop.driving.path import path_of
from dsrc.closed_loop.types import Decision, EgoState, LaneMap, Tracks
from dsrc.detectors.line import ProcessLine
from dsrc.detectors.message import PROTOCOL, Header
from dsrc.messages.seen_space import SeenSpace
from sim.boxes import CLASSES

START_S = 60.0
"""Longest time to the first answer, s."""


class _Hello(Header, frozen=True, kw_only=True):
    """What a driver says of itself.

    Attributes:
        protocol: of its messages.
        role: none of a detector.
        name: of driver and weights, part of the keys of its episodes: other weights need another name.
        wants: what it is told beside its own state, route and tracks.
    """

    SAID: ClassVar[str] = "hello"

    protocol: Literal[1]
    role: Literal["driver"]
    name: Annotated[str, Meta(min_length=1, max_length=200)]
    wants: Annotated[tuple[Literal["conflicts", "seen"], ...], Meta(max_length=2)] = ()


class _Ready(Header, frozen=True, kw_only=True):
    SAID: ClassVar[str] = "ready"


class _Decided(Header, frozen=True, kw_only=True):
    SAID: ClassVar[str] = "decision"

    reason: Annotated[str, Meta(min_length=1, max_length=40)] = "outside"
    track: Annotated[int, Meta(ge=-1, lt=1 << 62)] = -1


class ProcessDriver:
    """Driver that a process is; each process of ours opens its own.

    Args:
        text: `pipe:COMMAND ...`, without a shell, or `tcp://localhost:PORT`.
        answer_s: longest time to an answer, s; the first may take longer, see `START_S`.

    Attributes:
        name: as the process says.

    Raises:
        SettingsError: the text names no command or no local port.
        DataError: the process does not start, ends, hangs or answers something else.
    """

    def __init__(self, text: str, answer_s: float) -> None:
        self.text, self._answer_s = text, answer_s
        self._lock = threading.Lock()
        self._lanes: LaneMap | None = None
        self._seen: SeenSpace | None = None
        self.name = ""
        self._open()

    def _open(self) -> None:
        self._line = ProcessLine(self.text, "driver")
        question = {"type": "hello", "protocol": PROTOCOL, "role": "driver"}
        hello = self._line.ask(question, {}, _Hello, max(START_S, self._answer_s))[0]
        if self.name not in ("", hello.name):  # episodes are kept under the first name
            self._line.close()
            raise self._line.wrong("name", self.name, hello.name)
        self.name, self._wants = hello.name, hello.wants

    def reset(self, lanes: LaneMap | None) -> None:
        """Begin an episode; a process that has failed before is started anew.

        Raises:
            DataError: the process ends, hangs or answers something else.
        """
        with self._lock:
            if not self._line.usable:
                self._open()
            self._lanes, self._seen = lanes, None
            self._line.ask({"type": "reset"}, {}, _Ready, self._answer_s)

    def see(self, seen: SeenSpace) -> None:
        """Take the newest seen space, of which the process is told with the next question."""
        self._seen = seen

    def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
        """Return what the process decides.

        Raises:
            DataError: the process ends, hangs or answers something else.
        """
        question, arrays = _question(ego, tracks)
        if "conflicts" in self._wants:
            _add_conflicts(question, arrays, ego, self._lanes)
        if "seen" in self._wants:
            _add_seen(question, arrays, self._seen)
            self._seen = None
        with self._lock:
            header, answer = self._line.ask(question, arrays, _Decided, self._answer_s)
        values = answer.arrays.get("decision")
        if values is None or values.dtype.kind != "f" or values.shape not in ((1,), (2,)):
            found = "none" if values is None else f"{values.dtype} {values.shape}"
            raise self._line.wrong("decision", "floats of shape (1,) or (2,)", found)
        return Decision(float(values[0]), header.reason, header.track, *map(float, values[1:]))

    def close(self) -> None:
        """End the process, or the connection to it."""
        self._line.close()


def _question(ego: EgoState, tracks: Tracks) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    header = {
        "type": "decide",
        "ego": {
            "time_s": ego.time_s,
            "speed_mps": float(ego.speed_mps),
            "acceleration_mps2": float(ego.acceleration_mps2),
            "progress_m": float(ego.progress_m),
            "limit_mps": float(ego.limits.speed_mps),
            "most_mps2": float(ego.limits.acceleration_mps2),
            "brakes_mps2": float(ego.limits.deceleration_mps2),
        },
        "lights": [{"state": light.state, "distance_m": float(light.distance_m)} for light in ego.lights],
        "classes": [CLASSES[label] for label in tracks.boxes.label],
    }
    arrays: dict[str, NDArray[Any]] = {
        "ego_box": ego.box.array[0],
        "route": np.asarray(ego.route, np.float64),
        "track": np.asarray(tracks.boxes.object_id, np.int64),
        "boxes": tracks.boxes.array,
        **{name: getattr(tracks, name) for name in ("velocity", "yaw_rate", "position_sd", "score", "unseen_s")},
    }
    return header, arrays


def _add_conflicts(
    header: dict[str, Any], arrays: dict[str, NDArray[Any]], ego: EgoState, lanes: LaneMap | None
) -> None:
    path = path_of(ego.route, float(ego.box.yaw[0]), 1.0)
    found = lanes.conflicts(np.column_stack([path.xy, path.heading])) if lanes is not None else ()
    header["conflicts"] = [
        {"meets": int(lane.meets), "gives_way": bool(lane.gives_way), "signal": bool(lane.signal)} for lane in found
    ]
    arrays |= {f"conflict_{k}": np.column_stack([lane.line, lane.speed_mps]) for k, lane in enumerate(found)}


def _add_seen(header: dict[str, Any], arrays: dict[str, NDArray[Any]], seen: SeenSpace | None) -> None:
    views = () if seen is None else seen.views
    header["views"] = [
        {"agent_id": view.agent_id, "time_s": view.time_s, "xy": view.xy.tolist(), "yaw": view.yaw} for view in views
    ]
    arrays |= {f"view_{k}": view.seen.astype(np.uint8) for k, view in enumerate(views)}
