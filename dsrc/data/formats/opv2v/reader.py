"""OPV2V tree: DRIVE/AGENT/000123.pcd + .yaml, loaded by OpenCOOD and read back exactly.

A folder of drives is a split, a drive holds one folder per agent (the object id of a vehicle, a negative number for
a roadside unit) and `data_protocol.yaml`. Trees of other tools are read too, with missing values filled in: all objects
are cars, and an agent has at least one point on each object that it has annotated.

A drive of which an agent lacks a file is refused, unless `data_protocol.yaml` says `missing: frame`, which leaves out
the frames of such files, or `missing: agent`, which leaves out the agents that lack one.

Points are written in the frame of their sweep (`Sweep.motion`), `lidar_pose` is that frame, and the record keeps it and
the sensor's path, so that a reader can choose another. Boxes are those of the frame's time, the middle of its sweeps.
"""

import hashlib
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.data.checksums import marks_of_change
from dsrc.data.formats.annotation import Annotation, with_own_bodies
from dsrc.data.formats.opv2v.compact import encode_compact, read_compact
from dsrc.data.formats.opv2v.record import Part, Record, encode_agent, read_agent, read_plan
from dsrc.data.formats.pcd import compensated, encode_pcd, read_pcd
from dsrc.data.formats.yaml import read_yaml
from dsrc.data.points_in_boxes import points_in_boxes
from dsrc.data.velocity_from_tracks import TimedBoxes, tracked_velocity
from sensors.deskew import check_motion, deskew_frame
from sensors.frame import AgentFrame, AgentKind, Frame, agent_order
from sensors.sweep import Motion, Sweep
from sim.boxes import concatenate
from sim.errors import DataError, complaint, did_you_mean, notice
from sim.files import Content, write_file

PROTOCOL = "data_protocol.yaml"
Clouds = Literal["pcd", "compact"]
"""Form of the point clouds, and ending of their files: OPV2V's, or a quarter of their bytes for our readers alone."""
CLOUDS: tuple[Clouds, ...] = get_args(Clouds)
_MISSING = "missing"
# Its loader (https://github.com/ucla-mobility/V2X-Real, basedataset.py and pcd_utils.py) has the folders and keys of
# OPV2V, clouds as x, y, z, intensity in float32, six numbers as pose and a class in `obj_type`.
_V2X_REAL = (
    "annotations with clouds in .bin, as V2X-Real has them, are not read: to which side their y axis points is not"
    " published; the clouds alone are read as folders of scans"
)
_AGENT = re.compile(r"-?\d+")
_STEM = re.compile(r"\d+")
# OpenCDA numbers its files by ticks of a simulation at 20 Hz; the default for trees of other tools.
_TICK_S = 0.05


def own_settings(protocol: dict) -> dict:
    """Return the table `testbed` of a protocol: our settings of a drive, empty for other tools' drives."""
    own = protocol.get("testbed")
    return own if isinstance(own, dict) else {}


def lists_connected_vehicles(protocol: dict) -> bool:
    """Return whether other agents' bodies are among an agent's vehicles in the files of a drive."""
    return bool(own_settings(protocol).get("connected_vehicles", True))


def clouds_of(drive: Path, protocol: dict) -> Clouds:
    """Return the form of a drive's clouds; DataError for an unknown one."""
    clouds = own_settings(protocol).get("clouds", "pcd")
    if clouds not in CLOUDS:
        raise DataError(complaint(drive / PROTOCOL, "testbed.clouds", " or ".join(CLOUDS), clouds))
    return clouds


def with_clouds(own: dict, clouds: Clouds) -> dict:
    """Return settings of a drive with another form of the clouds; PCD is what settings without one mean."""
    kept = {name: value for name, value in own.items() if name != "clouds"}
    return kept if clouds == "pcd" else {"clouds": clouds, **kept}


def agent_table(frame: Frame) -> dict[int, dict]:
    """Return the table `testbed.agents` of a protocol: kind and LiDAR by agent id."""
    return {
        int(agent.agent_id): {
            "kind": agent.kind,
            "lidar": None if agent.sweep.spec is None else msgspec.to_builtins(agent.sweep.spec),
        }
        for agent in frame.agents
    }


def frame_files(drive: Path, agent_ids: Sequence[int], index: int, clouds: Clouds = "pcd") -> list[Path]:
    """Return the files of one frame, points before annotations."""
    return [drive / str(agent) / f"{index:06d}.{ending}" for agent in agent_ids for ending in (clouds, "yaml")]


def write_frame(
    drive: Path,
    frame: Frame,
    connected_vehicles: bool = True,
    plans: dict[int, NDArray[np.float64]] | None = None,
    motion: Motion | None = None,
    clouds: Clouds = "pcd",
    write: Callable[[Path, Content], None] = write_file,
) -> None:
    """Write one frame of all agents, each file atomically.

    Args:
        drive: folder of the drive, made if it is missing.
        frame: the frame; its number becomes the file name.
        connected_vehicles: list other agents' bodies among an agent's vehicles, as any other vehicle.
        plans: per agent (K, 3) x, y in the world, m, and speed, m/s, of its coming path.
        motion: compensation of the sensors' motion in the files; None leaves the sweeps as they are.
        clouds: form of the point clouds; the protocol of the drive must say the same.
        write: writes a file atomically.

    Raises:
        DataError: a sweep cannot be compensated so: its path or its firing times are unknown.
    """
    frame = frame if motion is None else deskew_frame(frame, motion)
    plans = plans or {}
    texts = [
        encode_agent(frame, row, connected_vehicles, plans.get(agent.agent_id))
        for row, agent in enumerate(frame.agents)
    ]
    for agent, text in zip(frame.agents, texts, strict=True):
        points, notes = frame_files(drive, [agent.agent_id], frame.index, clouds)
        write(points, encode_compact(agent.sweep) if clouds == "compact" else encode_pcd(agent.sweep))
        write(notes, text.encode())


class DriveReader:
    """Random access to the frames of an OPV2V drive; see `dsrc.data.drives` for any format.

    Attributes:
        drive: its folder.
        motion: compensation of the sensors' motion in the frames; None for that of the files.
        agents: ids of the agents, in the order of their folders, roadside units last.
        frames: numbers of the frames, ascending.
        clouds: form of its point clouds.
    """

    format = "OPV2V"

    def __init__(self, drive: Path, motion: Motion | None = None) -> None:
        """List the folder; no frame is read yet.

        Raises:
            DataError: the folder holds no drive, or an agent's folder or a frame of an agent is missing.
            SettingsError: the motion is unknown.
        """
        if motion is not None:
            check_motion(motion)
        self.drive = Path(drive)
        self.motion = motion
        self.protocol = read_yaml(self.drive / PROTOCOL) if (self.drive / PROTOCOL).exists() else {}
        # Of this tree alone: one that is made of it lacks nothing.
        self._missing = self.protocol.pop(_MISSING, None)
        self.clouds = clouds_of(self.drive, self.protocol)
        self.agents = tuple(self._agents())
        self._stems = self._timestamps()
        self.frames = tuple(int(stem) for stem in self._stems)
        self._unlabelled = own_settings(self.protocol).get("unlabelled", [])
        if not isinstance(self._unlabelled, list):
            found = self._unlabelled
            raise DataError(complaint(self.drive / PROTOCOL, "testbed.unlabelled", "a list of frames", found))

    def __len__(self) -> int:
        return len(self.frames)

    def read(self, i: int) -> Frame:
        """Read the i-th frame (a position in `frames`, not the number in a file's name).

        Raises:
            DataError: a file is missing or broken, or lacks the path that another motion than its own needs: old files
                and those of other tools can only be read as they are.
        """
        stem = self._stems[i]
        notes = [read_agent(self.drive / str(agent) / f"{stem}.yaml") for agent in self.agents]
        records = [note for note in notes if isinstance(note, Record)]
        if not records:
            return self._foreign_frame(stem, [note for note in notes if isinstance(note, Annotation)])
        if len(records) < len(notes):
            row = next(i for i, note in enumerate(notes) if not isinstance(note, Record))
            path = self.drive / str(self.agents[row]) / f"{stem}.yaml"
            raise DataError(complaint(path, "testbed", "a record as in the other agents' files", "none"))
        return self._own_frame(stem, records)

    def plans(self, i: int) -> dict[int, NDArray[np.float64]]:
        """Return per agent (K, 3) x, y, m, and speed, m/s, of its path after the i-th frame."""
        return {agent: read_plan(self.drive / str(agent) / f"{self._stems[i]}.yaml") for agent in self.agents}

    def labelled(self, i: int) -> bool:
        """Return whether the i-th frame has ground truth: every one but those that a drive of ours says have none."""
        return self.frames[i] not in self._unlabelled

    def complete(self) -> bool:
        """Return whether labels are complete everywhere, in all frames that have them."""
        return own_settings(self.protocol).get("labels") != "part"

    def digest(self) -> str:
        """Return the SHA-256 of the annotations, of all files' names and sizes, and of marks of changed clouds.

        It is quick, see `dsrc.data.checksums.marks_of_change`.
        """
        digest = hashlib.sha256()
        files = sorted(p for p in self.drive.rglob("*") if p.suffix in (".yaml", f".{self.clouds}") and p.is_file())
        for path in files:
            name = f"{self.drive.name}/{path.relative_to(self.drive).as_posix()}"
            digest.update(f"{name}\0{path.stat().st_size}\0".encode())
            if path.suffix == ".yaml":
                digest.update(path.read_bytes())
        for path, mark in marks_of_change(self.drive, [path for path in files if path.suffix != ".yaml"]):
            digest.update(path.relative_to(self.drive).as_posix().encode() + b"\0" + mark)
        return digest.hexdigest()

    def _agents(self) -> list[int]:
        if not self.drive.is_dir():
            siblings = [p.name for p in self.drive.parent.iterdir()] if self.drive.parent.is_dir() else []
            raise DataError(f"{self.drive}: no such folder{did_you_mean(self.drive.name, siblings)}")
        names = sorted(p.name for p in self.drive.iterdir() if p.is_dir() and _AGENT.fullmatch(p.name))
        if odd := [name for name in names if str(int(name)) != name]:
            raise DataError(complaint(self.drive, "agent folders", "ids without leading zeros", odd[0]))
        found = list(map(int, names))
        promised = own_settings(self.protocol).get("agents", {})
        if not isinstance(promised, dict) or not all(_AGENT.fullmatch(str(agent)) for agent in promised):
            raise DataError(complaint(self.drive / PROTOCOL, "testbed.agents", "a mapping of agent ids", promised))
        absent = [int(agent) for agent in promised if int(agent) not in found]
        if absent and self._missing != "agent":
            raise DataError(f"{self.drive / str(absent[0])}: agent folder is missing; {PROTOCOL} names it")
        if not found:
            raise DataError(complaint(self.drive, "folder", "agent folders with whole numbers as names", "none"))
        return agent_order(found + absent)

    def _timestamps(self) -> list[str]:
        """Return the ego's timestamps, checked against the other agents and the protocol."""
        folders = {agent: self.drive / str(agent) for agent in self.agents}
        listing = {agent: {p.name for p in folder.glob("*")} for agent, folder in folders.items()}
        own = own_settings(self.protocol)
        # A file of the ego can be missing too, where the number of frames is promised or files may be missing.
        timed = self.agents if self._missing is not None or "frames" in own else self.agents[:1]
        names = {Path(name) for agent in timed for name in listing[agent] if name.endswith(".yaml")}
        stems = sorted({n.stem for n in names if _STEM.fullmatch(n.stem)}, key=lambda stem: (int(stem), stem))
        if not stems:
            ego = self.drive / str(self.agents[0])
            raise DataError(complaint(ego, "timestamps", "files such as 000000.yaml and 000000.pcd", "none"))
        files = [(agent, stem, ending) for agent in self.agents for stem in stems for ending in ("yaml", self.clouds)]
        if all(f"{stem}.pcd" not in listing[timed[0]] and f"{stem}.bin" in listing[timed[0]] for stem in stems):
            raise DataError(f"{self.drive}: {_V2X_REAL}")
        gaps = [file for file in files if f"{file[1]}.{file[2]}" not in listing[file[0]]]
        if gaps:
            stems = self._without(gaps, stems)
        promised = own.get("frames")
        if promised is not None and promised != len(stems):
            verb = "corrupt" if "corruptions" in own else "generate"
            hint = f"; run dsrc {verb} again"
            raise DataError(complaint(self.drive, "frames", f"{promised} as in {PROTOCOL}", len(stems), hint))
        return stems

    def _without(self, gaps: list[tuple[int, str, str]], stems: list[str]) -> list[str]:
        """Return the timestamps that stay, once the frames or agents with gaps are left out as the protocol says."""
        own, protocol = own_settings(self.protocol), self.drive / PROTOCOL
        if self._missing is None:
            agent, stem, ending = gaps[0]
            ways = f"`{_MISSING}: frame` leaves such frames out, `{_MISSING}: agent` such agents"
            raise DataError(f"{self.drive / str(agent) / stem}.{ending}: file is missing; in {protocol}, a line {ways}")
        if self._missing == "frame":
            without = {stem for _, stem, _ in gaps}
            if not (left := [stem for stem in stems if stem not in without]):
                raise DataError(complaint(self.drive, "frames", "one of which no agent lacks a file", "none"))
            if "frames" in own:
                own["frames"] = len(left)
            notice(f"{self.drive}: {len(without)} of {len(stems)} frames, of which a file is missing, are left out")
            return left
        if self._missing != "agent":
            raise DataError(complaint(protocol, _MISSING, "frame or agent", self._missing))
        lacking = {agent for agent, _, _ in gaps}
        if not (whole := tuple(agent for agent in self.agents if agent not in lacking)):
            raise DataError(complaint(self.drive, "agents", "one that lacks no file", "none"))
        if "agents" in own:
            own["agents"] = {agent: about for agent, about in own["agents"].items() if int(agent) in whole}
        names = ", ".join(str(agent) for agent in self.agents if agent in lacking)
        notice(f"{self.drive}: of {len(self.agents)} agents those that lack a file are left out: {names}")
        self.agents = whole
        return stems

    def _own_frame(self, stem: str, records: list[Record]) -> Frame:
        first = records[0]
        odd = set(self.agents) - set(first.agents) if self._missing == "agent" else set(self.agents) ^ set(first.agents)
        if odd:
            found = f"{sorted(odd)} missing or extra"
            raise DataError(complaint(self.drive, "agent folders", str(first.agents), found))
        agents = []
        for agent_id, record in zip(self.agents, records, strict=True):
            path = self.drive / str(agent_id) / f"{stem}.{self.clouds}"
            if record.index != first.index or record.object_id != first.object_id or record.box != first.box:
                raise DataError(f"{path.with_suffix('.yaml')}: testbed: differs from agent {self.agents[0]}'s truth")
            pose = np.array(record.world_from_lidar, np.float64)
            sweep = self._sweep(path, pose, record.sweep_time_s, spec=record.lidar)
            sweep = replace(sweep, path=record.lidar_path(), motion=record.motion, lost=record.lost)
            sweep = compensated(path, sweep, self.motion)
            body = np.array(record.world_from_body, np.float64)
            agents.append(AgentFrame(agent_id, record.kind, body, record.speed_mps, sweep))
        return Frame(
            index=first.index,
            time_s=first.time_s,
            agents=tuple(agents),
            truth=first.truth(),
            velocity=np.array([row or (np.nan, np.nan) for row in first.velocity], np.float64).reshape(-1, 2),
            points_on=np.array([r.points_on for r in records], np.int32).reshape(len(records), -1),
            acceleration=np.array([row or (np.nan, np.nan) for row in first.acceleration], np.float64).reshape(-1, 2),
            signals=np.array(first.signals, np.int32),
            lane=tuple(first.lane),
            visible_fraction=_fractions(records),
            region=first.part.region() if isinstance(first.part, Part) else None,
            sight=_sight(records, [first.agents.index(agent) for agent in self.agents]),
            tilt=np.array(first.tilt if isinstance(first.tilt, list) else [], np.float64).reshape(-1, 2),
        )

    def _foreign_frame(self, stem: str, notes: list[Annotation]) -> Frame:
        now, velocity = self._instant(stem, notes)
        truth = now.boxes
        if np.isnan(velocity).any():
            velocity = np.where(np.isnan(velocity), tracked_velocity(now, *self._neighbours(stem)), velocity)
        agents, points_on = [], np.zeros((len(notes), len(truth)), np.int32)
        for row, (agent_id, note) in enumerate(zip(self.agents, notes, strict=True)):
            path = self.drive / str(agent_id) / f"{stem}.{self.clouds}"
            sweep = self._sweep(path, note.world_from_lidar, now.time_s, mirrored=note.mirrored)
            sweep = compensated(path, sweep, self.motion)
            kind: AgentKind = "roadside" if agent_id < 0 else "vehicle"
            agents.append(AgentFrame(agent_id, kind, note.world_from_body, note.speed, sweep))
            listed = np.isin(truth.object_id, note.boxes.object_id)
            _, boxes = points_in_boxes(truth[listed], sweep.points, sweep.world_from_lidar)
            counts = np.bincount(boxes, minlength=np.count_nonzero(listed))
            # An annotation means that a ray has hit the object, even if no point of the file lies in its box.
            points_on[row, listed] = np.maximum(counts, 1)
        frame = Frame(int(stem), now.time_s, tuple(agents), truth, velocity, points_on)
        return frame if all(note.mirrored for note in notes) else with_own_bodies(frame)

    def _sweep(self, path: Path, pose: NDArray[np.float64], time_s: float, **more: Any) -> Sweep:
        """Read a cloud in the form of the drive; compact ones are never mirrored."""
        if self.clouds == "compact":
            return read_compact(path, pose, time_s, more.get("spec"))
        return read_pcd(path, pose, time_s, **more)

    def _instant(self, stem: str, notes: list[Annotation]) -> tuple[TimedBoxes, NDArray[np.float64]]:
        """Return the objects of a frame and their (N, 2) velocities."""
        world = self.protocol.get("world", {})
        tick = world.get("fixed_delta_seconds", _TICK_S) if isinstance(world, dict) else _TICK_S
        tick_s = float(tick) if isinstance(tick, int | float) and 0 < tick < math.inf else _TICK_S
        interval_s = tick_s if notes[0].interval_s is None else notes[0].interval_s
        boxes = concatenate([note.boxes for note in notes])
        velocity = np.concatenate([np.zeros((0, 2)), *(note.velocity for note in notes)])
        # Each object once, from the first agent that has annotated it, rows sorted by id.
        _, first = np.unique(boxes.object_id, return_index=True)
        return TimedBoxes(int(stem) * interval_s, boxes[first]), velocity[first]

    def _neighbours(self, stem: str) -> list[TimedBoxes | None]:
        """Return the objects a frame earlier and later."""
        i = self._stems.index(stem)
        return [self._objects(self._stems[j]) if 0 <= j < len(self._stems) else None for j in (i - 1, i + 1)]

    def _objects(self, stem: str) -> TimedBoxes | None:
        notes = [read_agent(self.drive / str(agent) / f"{stem}.yaml") for agent in self.agents]
        foreign = [note for note in notes if isinstance(note, Annotation)]
        return self._instant(stem, foreign)[0] if foreign else None


def _fractions(records: list[Record]) -> NDArray[np.float32]:
    """Return (A, N) visible fractions; empty where an agent's file lacks them."""
    if any(len(r.visible_fraction) < len(r.object_id) for r in records):
        return np.zeros((0, 0), np.float32)
    rows = [[np.nan if share is None else share for share in r.visible_fraction] for r in records]
    return np.array(rows, np.float32).reshape(len(records), -1)


def _sight(records: list[Record], columns: list[int]) -> NDArray[np.int8]:
    """Return (A, A) lines of sight, of each record those to some of its agents; empty where old files lack them."""
    if not all(record.sight for record in records):
        return np.zeros((0, 0), np.int8)
    return np.array([record.sight for record in records], np.int8)[:, columns]


def drives_below(root: Path) -> list[Path]:
    """Return the OPV2V drives at or below a folder (itself, its children, theirs), sorted by path."""
    return sorted(folder for folder in [root, *root.glob("*/"), *root.glob("*/*/")] if _is_drive(folder))


def _is_drive(folder: Path) -> bool:
    agents = (p for p in folder.iterdir() if _AGENT.fullmatch(p.name) and p.is_dir())
    # A drive may have a number for its name too, but its yaml is no frame.
    return any(_STEM.fullmatch(file.stem) for agent in agents for file in agent.glob("*.yaml"))
