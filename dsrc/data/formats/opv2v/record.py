"""Yaml of one agent for one frame: the keys of OPV2V and our exact record beside them.

OPV2V's world is CARLA's: left-handed, y to the right, degrees, half extents, km/h. The key `testbed` holds one
line of JSON with all values that OPV2V lacks (classes, velocities, unseen actors, exact matrices); other tools ignore
it. Its checksum covers the rest of the file, so that an edited file is detected.

Source of the keys: OPV2V, ICRA 2022, and the documents of OpenCOOD (data_intro.md).
"""

import math
import zlib
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.data.formats import v2v4real
from dsrc.data.formats.annotation import FARTHEST_M, Annotation, annotation, check_box
from dsrc.data.formats.yaml import emit, parse_yaml
from sensors.frame import AgentKind, Frame, Region
from sensors.motion import Path as LidarPath
from sensors.spec import LidarSpec
from sensors.sweep import Motion
from sim.boxes import CLASSES, Boxes
from sim.errors import DataError, SettingsError, complaint, one_line
from sim.geometry import carla_from_matrix
from sim.reading import parsing, read_text

VERSION = 1
_PREFIX = "testbed: '"
_ID_LIMIT = 2**31
_Id = Annotated[int, msgspec.Meta(gt=-_ID_LIMIT, lt=_ID_LIMIT)]


class Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`sensors.frame.Region` in the world, its boxes as those of a `Record`."""

    projection: list[tuple[float, float, float, float]] | None
    image_size: tuple[int, int]
    ignored_px: list[tuple[float, float, float, float]]
    ignored: list[tuple[float, float, float, float, float, float, float]]

    @classmethod
    def of(cls, region: Region) -> "Part":
        """Return what a file keeps of a region."""
        projection = None if region.projection is None else [(a, b, c, d) for a, b, c, d in region.projection.tolist()]
        return cls(projection, region.image_size, region.ignored_px.tolist(), region.ignored.array.tolist())

    def region(self) -> Region:
        """Return the region exactly as it was written."""
        projection = None if self.projection is None else np.array(self.projection, np.float64)
        ignored = Boxes.from_array(np.array(self.ignored, np.float64).reshape(-1, 7))
        return Region(projection, self.image_size, np.array(self.ignored_px, np.float64).reshape(-1, 4), ignored)


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """JSON under `testbed`: N objects, in the order of `Frame.truth`.

    Old trees lack the last fields: their points are those of the middle of the sweep, and accelerations, signals, lanes
    and visible fractions are missing.

    Attributes:
        motion: compensation of the points beside this record, see `sensors.sweep.Motion`.
        path: true path of the LiDAR in our world through the sweep: time, s, x, y, z, m, yaw, pitch, roll, rad, without
            jumps of a full turn; empty for an unknown one.
        lost: see `Sweep.lost`.
        acceleration, signals, lane, visible_fraction: as in `Frame`, the agent's own row of the last; null for NaN,
            in `velocity` too.
        sight: line of sight from the agent to each of `agents`, see `Frame.sight`; empty for unknown ones.
        part: see `Frame.region`; left out for everywhere.
        tilt: as in `Frame`; left out where no body tilts.
    """

    version: int
    check: int
    index: int
    time_s: float
    agents: list[int]
    kind: AgentKind
    speed_mps: float
    world_from_body: list[list[float]]
    world_from_lidar: list[list[float]]
    sweep_time_s: float
    lidar: LidarSpec | None
    object_id: list[_Id]
    label: list[str]
    box: list[tuple[float, float, float, float, float, float, float]]
    velocity: list[tuple[float, float] | None]
    points_on: list[Annotated[int, msgspec.Meta(ge=0, lt=2**31)]]
    motion: Motion = "middle"
    path: list[tuple[float, float, float, float, float, float, float]] = []
    lost: Annotated[int, msgspec.Meta(ge=0)] = 0
    acceleration: list[tuple[float, float] | None] = []
    signals: list[Annotated[int, msgspec.Meta(ge=0, lt=2**31)]] = []
    lane: list[str] = []
    visible_fraction: list[Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] | None] = []
    sight: list[Annotated[int, msgspec.Meta(ge=-1, le=2)]] = []
    part: Part | msgspec.UnsetType = msgspec.UNSET
    tilt: list[tuple[float, float]] | msgspec.UnsetType = msgspec.UNSET

    def lidar_path(self) -> LidarPath | None:
        """Return the path of the LiDAR exactly as it was written."""
        if not self.path:
            return None
        knots = np.array(self.path, np.float64)
        return LidarPath(knots[:, 0].copy(), knots[:, 1:4].copy(), knots[:, 4:].copy())

    def truth(self) -> Boxes:
        """Return the boxes exactly as they were written."""
        array = np.array(self.box, np.float64).reshape(-1, 7)
        label = np.array([CLASSES.index(name) for name in self.label], np.int64)
        return Boxes(
            array[:, :3].copy(), array[:, 3:6].copy(), array[:, 6].copy(), label, np.array(self.object_id, np.int64)
        )


def encode_agent(frame: Frame, row: int, connected_vehicles: bool, plan: NDArray[np.float64] | None = None) -> str:
    """Return the yaml text of one agent of a frame.

    Args:
        row: the agent's row in it.
        connected_vehicles: list the other agents' own bodies among the vehicles too.
        plan: (K, 3) x, y in the world, m, and speed, m/s, of the agent's coming path.
    """
    agent = frame.agents[row]
    numbers = (frame.truth.array, agent.world_from_body, agent.sweep.world_from_lidar, _knots(agent.sweep.path))
    finite = all(np.isfinite(n).all() for n in (*numbers, frame.tilt))
    if not finite or np.isinf(frame.velocity).any() or np.isinf(frame.acceleration).any():
        raise ValueError(f"frame {frame.index}: a box, velocity or pose is not finite")
    body = carla_from_matrix(agent.world_from_body).tolist()
    plan = np.zeros((0, 3)) if plan is None else plan
    rest = emit(
        {
            "lidar_pose": carla_from_matrix(agent.sweep.world_from_lidar).tolist(),
            "true_ego_pos": body,
            "predicted_ego_pos": body,
            "ego_speed": float(agent.speed) * 3.6,
            "plan_trajectory": (plan * [1.0, -1.0, 3.6]).tolist(),
        }
    ) + _vehicles(frame, row, connected_vehicles)
    record = msgspec.json.encode(_record(frame, row, zlib.crc32(rest.encode()))).decode()
    # In single quotes the JSON is one scalar for every YAML reader; its own single quotes are escaped.
    return f"{_PREFIX}{record.replace(chr(39), chr(92) + 'u0027')}'\n{rest}"


def _record(frame: Frame, row: int, check: int) -> Record:
    agent, truth = frame.agents[row], frame.truth
    return Record(
        version=VERSION,
        check=check,
        index=int(frame.index),
        time_s=float(frame.time_s),
        agents=[a.agent_id for a in frame.agents],
        kind=agent.kind,
        speed_mps=float(agent.speed),
        world_from_body=agent.world_from_body.tolist(),
        world_from_lidar=agent.sweep.world_from_lidar.tolist(),
        sweep_time_s=float(agent.sweep.time_s),
        lidar=agent.sweep.spec,
        object_id=truth.object_id.tolist(),
        label=[CLASSES[i] for i in truth.label.tolist()],
        box=truth.array.tolist(),
        velocity=_known(frame.velocity),
        points_on=frame.points_on[row].tolist(),
        motion=agent.sweep.motion,
        path=_knots(agent.sweep.path).tolist(),
        lost=int(agent.sweep.lost),
        acceleration=_known(frame.acceleration),
        signals=frame.signals.tolist(),
        lane=list(frame.lane),
        # The shortest decimals that read back as the same float32.
        visible_fraction=[None if text == "nan" else float(text) for text in map(str, frame.visible_fraction[row])],
        sight=frame.sight[row].tolist(),
        part=msgspec.UNSET if frame.region is None else Part.of(frame.region),
        tilt=[(pitch, roll) for pitch, roll in frame.tilt.tolist()] if frame.tilt.any() else msgspec.UNSET,
    )


def _known(vectors: NDArray[np.float64]) -> list[tuple[float, float] | None]:
    """Return rows of (N, 2), None for unknown ones."""
    return [None if math.isnan(x) or math.isnan(y) else (x, y) for x, y in vectors.tolist()]


def _knots(path: LidarPath | None) -> NDArray[np.float64]:
    """Return (K, 7) rows of `Record.path`."""
    if path is None:
        return np.zeros((0, 7))
    return np.concatenate([path.time_s[:, None], path.xyz, path.angles], axis=1)


def _vehicles(frame: Frame, row: int, connected_vehicles: bool) -> str:
    """Return OPV2V's table of the vehicles with a point of the agent, without the agent itself, as YAML."""
    truth = frame.truth
    listed = truth.is_vehicle & (frame.points_on[row] >= 1) & (truth.object_id != frame.agents[row].agent_id)
    if not connected_vehicles:
        listed &= ~np.isin(truth.object_id, [a.agent_id for a in frame.agents])
    speed = np.hypot(frame.velocity[:, 0], frame.velocity[:, 1])
    numbers = np.column_stack([truth.array, speed, frame.tilt])[listed]
    entries = [_vehicle(i, one.tobytes()) for i, one in zip(truth.object_id[listed].tolist(), numbers, strict=True)]
    return "vehicles:\n" + "".join(entries) if entries else "vehicles: {}\n"


@lru_cache(maxsize=1024)
def _vehicle(object_id: int, numbers: bytes) -> str:
    """Return the entry of a vehicle, the same for all agents, by the bits of box, speed (NaN for none) and tilt."""
    x, y, z, length, width, height, yaw, speed, pitch, roll = np.frombuffer(numbers, np.float64).tolist()
    entry: dict[str, Any] = {
        # CARLA's roll, yaw and pitch; a level body keeps the zeros without a sign.
        "angle": [math.degrees(roll), -math.degrees(yaw), 0.0 if pitch == 0.0 else -math.degrees(pitch)],
        "center": [0.0, 0.0, 0.5 * height],
        "extent": [0.5 * length, 0.5 * width, 0.5 * height],
        "location": [x, -y, z - 0.5 * height],
    }
    if not math.isnan(speed):
        entry["speed"] = speed * 3.6
    return emit({object_id: entry}, indent=2)


def read_agent(path: Path) -> Record | Annotation:
    """Read one yaml: our record, else the annotation of OPV2V's keys.

    Raises:
        DataError: the file cannot be read, a value is missing or wrong, or the file was edited after its record.
    """
    text = read_text(path, "YAML file")
    if not text.startswith(_PREFIX):
        return _annotation(path, parse_yaml(path, text))
    line, _, rest = text.partition("\n")
    with parsing(path, "record of the key testbed"):
        try:
            record = msgspec.json.decode(line[len(_PREFIX) : -1], type=Record)
        except (msgspec.MsgspecError, SettingsError) as error:  # the latter of the LiDAR in it
            raise DataError(f"{path}: testbed: damaged record: {one_line(error, 200)}") from None
    if record.version != VERSION:
        raise DataError(complaint(path, "testbed.version", str(VERSION), record.version))
    if record.check != zlib.crc32(rest.encode()):
        _annotation(path, parse_yaml(path, rest))  # names a wrong value
        raise DataError(
            f"{path}: testbed.check: the file was edited or cut after it was written; to read it as plain OPV2V "
            "remove the line `testbed` from every yaml of the drive"
        )
    return _checked(path, record)


def read_plan(path: Path) -> NDArray[np.float64]:
    """Return (K, 3) x, y in our world, m, and speed, m/s, of an agent's coming path; empty where the file has none."""
    text = read_text(path, "YAML file")
    content = parse_yaml(path, text.partition("\n")[2] if text.startswith(_PREFIX) else text)
    rows = content.get("plan_trajectory")
    try:
        plan = np.array(rows, np.float64).reshape(-1, 3)
    except (TypeError, ValueError, OverflowError):
        return np.zeros((0, 3))
    return plan / [1.0, -1.0, 3.6] if np.isfinite(plan).all() else np.zeros((0, 3))


def _checked(path: Path, record: Record) -> Record:
    n = len(record.object_id)
    for name in ("label", "box", "velocity", "points_on"):
        if len(getattr(record, name)) != n:
            raise DataError(complaint(path, f"testbed.{name}", f"{n} rows", len(getattr(record, name))))
    for name in ("acceleration", "signals", "lane", "visible_fraction"):
        if len(getattr(record, name)) not in (0, n):
            raise DataError(complaint(path, f"testbed.{name}", f"{n} rows or none", len(getattr(record, name))))
    if isinstance(record.tilt, list) and len(record.tilt) != n:
        raise DataError(complaint(path, "testbed.tilt", f"{n} rows or none", len(record.tilt)))
    if len(record.sight) not in (0, len(record.agents)):
        raise DataError(complaint(path, "testbed.sight", f"{len(record.agents)} agents or none", len(record.sight)))
    for name in ("world_from_body", "world_from_lidar"):
        if [len(r) for r in getattr(record, name)] != [4, 4, 4, 4]:
            raise DataError(complaint(path, f"testbed.{name}", "4 rows of 4 numbers", getattr(record, name)))
    times = [knot[0] for knot in record.path]
    if len(times) == 1 or any(b <= a for a, b in pairwise(times)):
        raise DataError(complaint(path, "testbed.path", "none or at least two poses, times ascending", times))
    for object_id, box in zip(record.object_id, record.box, strict=True):
        check_box(path, f"testbed.box of object {object_id}", box[:3], box[3:6], box[6])
    if isinstance(record.part, Part):
        if record.part.projection is not None and len(record.part.projection) != 3:
            raise DataError(complaint(path, "testbed.part.projection", "3 rows", len(record.part.projection)))
        for box in record.part.ignored:
            check_box(path, "testbed.part.ignored", box[:3], box[3:6], box[6])
    for name in ("object_id", "agents"):
        if len(set(getattr(record, name))) < len(getattr(record, name)):
            raise DataError(complaint(path, f"testbed.{name}", "each id once", "one twice"))
    for name in ("world_from_body", "world_from_lidar"):
        if max(abs(value) for row in getattr(record, name) for value in row) > FARTHEST_M:
            raise DataError(complaint(path, f"testbed.{name}", f"places within {FARTHEST_M:g} m", "one beyond"))
    unknown = set(record.label) - set(CLASSES)
    if unknown:
        raise DataError(complaint(path, "testbed.label", f"one of {', '.join(CLASSES)}", min(unknown)))
    return record


def _annotation(path: Path, content: dict) -> Annotation:
    """Return the annotation of another tool's file."""
    return v2v4real.annotation(path, content) if v2v4real.is_v2v4real(content) else annotation(path, content)
