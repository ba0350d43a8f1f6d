"""DAIR-V2X-C reader: pairs of a vehicle's and an infrastructure's frame, a batch of pairs as a drive.

Frames, and their limits:

* The world is the dataset's. The vehicle's LiDAR stands at novatel_to_world * lidar_to_novatel, the infrastructure's at
  virtuallidar_to_world, moved by the pair's `system_error_offset`.
* The infrastructure's sweep keeps its own time, up to 0.2 s from the vehicle's, whose time is the frame's.
* Ground truth are the cooperative labels. They have no tracks in DAIR-V2X-C: ids then number the objects of each frame
  and velocities are NaN. Where labels have a `track_id`, as ours have, it is the id, and velocities are finite
  differences.
* The box around the vehicle's LiDAR is the vehicle itself and has its id.
* An object without a point in its box counts as one point of the LiDAR nearest to it: a label means that it was seen.

The path of a drive need not exist: TREE/BATCH, TREE/SPLIT/BATCH or TREE/original/BATCH, where SPLIT is a list of the
vehicle's frames (`TREE/val.json`, or "cooperative_split" of `cooperative-split-data.json`) and `original` names the
labels before the complemented ones.
"""

import hashlib
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dsrc.data.checksums import ends_of
from dsrc.data.formats.annotation import with_own_bodies
from dsrc.data.formats.dair.tree import (
    LABEL_FOLDERS,
    SIDES,
    TREE,
    BatchRecord,
    LabelSet,
    Pair,
    SideLabel,
    SideRecord,
    Tree,
    calib_file,
    cloud_file,
    is_tree,
    open_tree,
    read_labels,
    read_transform,
)
from dsrc.data.formats.pcd import SENSOR_FULL_SCALE, compensated, read_pcd
from dsrc.data.jsonio import read_json
from dsrc.data.velocity_from_tracks import LONGEST_GAP_S, TimedBoxes, tracked_velocity
from sensors.deskew import check_motion
from sensors.frame import AgentFrame, Frame, count_points
from sensors.sweep import Motion
from sim.boxes import CLASSES, Boxes
from sim.errors import DataError, complaint, did_you_mean

VEHICLE_ID, INFRASTRUCTURE_ID = 0, -1
"""Default ids of the agents; objects are numbered from 1."""


@dataclass(frozen=True, slots=True)
class TreePath:
    """Path of drives in a tree.

    Attributes:
        tree: its folder.
        batch: one batch, None for all.
        split: a list of frames, None for all.
        labels: complemented or original ones.
    """

    tree: Path
    batch: str | None
    split: str | None
    labels: LabelSet

    @property
    def folder(self) -> Path:
        """The path without the batch."""
        words = [word for word in (self.split, "original" if self.labels == "original" else None) if word is not None]
        return self.tree.joinpath(*words)


def locate(path: Path) -> TreePath | None:
    """Return the parts of a path in a DAIR-V2X-C tree; None for a path outside of any tree.

    Raises:
        DataError: the tree lacks the split or batch of the path.
    """
    path = Path(path)
    words: list[str] = []
    for folder in [path, *path.parents][:4]:
        for tree in (folder, folder / TREE):
            if is_tree(tree):
                return _parsed(tree, words[::-1])
        if folder.exists():
            return None
        words.append(folder.name)
    return None


def _parsed(tree: Path, words: list[str]) -> TreePath:
    labels: LabelSet = "complemented"
    batch = split = None
    batches, splits = open_tree(tree).batches, open_tree(tree).splits
    for word in words:
        if word == "original":
            if not (tree / "cooperative" / LABEL_FOLDERS["original"]).is_dir():
                raise DataError(complaint(tree / "cooperative", "original", "label_world_backup", "no such folder"))
            labels = "original"
        elif word in splits and split is None:
            split = word
        elif word in batches and batch is None:
            batch = word
        else:
            hint = did_you_mean(word, [*splits, *batches])
            raise DataError(complaint(tree, word, "a split or a batch of the tree", "none of this name", hint))
    return TreePath(tree, batch, split, labels)


def list_batches(place: TreePath) -> list[Path]:
    """Return the paths of the drives at a path, in the order of their numbers."""
    tree = open_tree(place.tree)
    kept = None if place.split is None else tree.splits[place.split]
    names = [place.batch] if place.batch is not None else list(tree.batches)
    found = [name for name in names if kept is None or any(pair.stems[0] in kept for pair in tree.batches[name])]
    if not found:
        raise DataError(complaint(place.folder, "drives", "a batch with frames of this split", "none"))
    return [place.folder / name for name in found]


class DairReader:
    """Random access to the frames of a batch, a `dsrc.data.drives.Drive`.

    Attributes:
        drive: its path, see above.
        motion: compensation of the sensors' motion in the frames; None for that of the files.
        agents: ids of the vehicle and of the infrastructure.
        frames: numbers of the vehicle's frames, ascending.
        protocol: empty; the tree has no such file.
    """

    format = "DAIR-V2X-C"

    def __init__(self, drive: Path, motion: Motion | None = None) -> None:
        """Read the indices; no cloud is read yet.

        Raises:
            DataError: the batch is missing, or an index of the tree is wrong.
            SettingsError: the motion is unknown.
        """
        if motion is not None:
            check_motion(motion)
        place = locate(Path(drive))
        if place is None or place.batch is None:
            raise DataError(complaint(drive, "folder", "a batch of a DAIR-V2X-C tree", "none"))
        self.drive, self.motion = Path(drive), motion
        self.protocol: dict = {}
        self._place = place
        self._tree: Tree = open_tree(place.tree)
        kept = None if place.split is None else self._tree.splits[place.split]
        pairs = self._tree.batches[place.batch]
        self._pairs = tuple(pair for pair in pairs if kept is None or pair.stems[0] in kept)
        if not self._pairs:
            raise DataError(complaint(drive, "frames", f"some of split {place.split}", "none"))
        own = self._tree.sidecar.batches.get(place.batch) if self._tree.sidecar is not None else None
        self._own = own is not None
        self._record = own or BatchRecord(
            place.batch, SideRecord(VEHICLE_ID, "vehicle"), SideRecord(INFRASTRUCTURE_ID, "roadside")
        )
        self.agents: tuple[int, ...] = (self._record.vehicle.agent_id, self._record.infrastructure.agent_id)
        self.frames = tuple(int(pair.stems[0]) for pair in self._pairs)
        self._labels = lru_cache(maxsize=8)(self._read_labels)

    def __len__(self) -> int:
        return len(self.frames)

    def __reduce__(self) -> tuple[type["DairReader"], tuple[Path, Motion | None]]:
        return DairReader, (self.drive, self.motion)

    def read(self, i: int) -> Frame:
        """Read the i-th frame (a position in `frames`).

        Raises:
            DataError: a file is missing or broken, or the clouds cannot be compensated as `motion`.
        """
        pair = self._pairs[i]
        time_s = self._time_s("vehicle-side", pair.stems[0])
        now, tracked = self._labels(i)
        truth = now.boxes
        known = [self._labels(j) if tracked and 0 <= j < len(self) else (now, False) for j in (i - 1, i + 1)]
        vehicle = self._agent("vehicle-side", pair, self._record.vehicle, self._speed(i))
        infrastructure = self._agent("infrastructure-side", pair, self._record.infrastructure, 0.0)
        agents = (vehicle, infrastructure)
        frame = Frame(
            index=self.frames[i],
            time_s=time_s,
            agents=agents,
            truth=truth,
            velocity=tracked_velocity(now, *(other if of_tracks else None for other, of_tracks in known)),
            points_on=self._points_on(pair, agents, truth),
        )
        return frame if self._own else with_own_bodies(frame)

    def plans(self, i: int) -> dict[int, NDArray[np.float64]]:
        """Return an empty dict: the dataset has no plans."""
        return {}

    def labelled(self, i: int) -> bool:
        """Return True: every frame has ground truth."""
        return True

    def complete(self) -> bool:
        """Return True: labels are complete everywhere."""
        return True

    def digest(self) -> str:
        """Return the SHA-256 of the labels, the poses and the names, sizes, starts and ends of the clouds."""
        digest = hashlib.sha256()
        for pair in self._pairs:
            files = [self._label_file(pair)]
            for side, stem in zip(("vehicle-side", "infrastructure-side"), pair.stems, strict=True):
                files += [file for _, file in self._calib(side, stem)]
                cloud = cloud_file(self._tree.root, side, stem)
                digest.update(f"{side}/{cloud.name}\0{cloud.stat().st_size}\0".encode() + ends_of(cloud))
            if self._own:
                files += [self._side_labels(side, pair) for side in SIDES]
            digest.update(f"{pair.offset.tolist()}\0".encode())
            for file in files:
                digest.update(file.read_bytes())
        return digest.hexdigest()

    def _time_s(self, side: str, stem: str) -> float:
        """Return the time of a frame since the start of the batch, s."""
        info = (self._tree.vehicle if side == "vehicle-side" else self._tree.infrastructure)[stem]
        return (info.pointcloud_timestamp - self._tree.start_us(str(self._place.batch))) / 1e6

    def _calib(self, side: str, stem: str) -> list[tuple[str, Path]]:
        """Return the calibration files from the LiDAR to the world, by name."""
        index = self._tree.vehicle if side == "vehicle-side" else self._tree.infrastructure
        names = ("lidar_to_novatel", "novatel_to_world") if side == "vehicle-side" else ("virtuallidar_to_world",)
        return [(name, calib_file(self._tree.root, side, index[stem], name)) for name in names]

    def _agent(self, side: str, pair: Pair, record: SideRecord, speed: float) -> AgentFrame:
        stem = pair.stems[0 if side == "vehicle-side" else 1]
        chain = [read_transform(file) for _, file in self._calib(side, stem)]
        if side == "vehicle-side":
            world_from_body, world_from_lidar = chain[1], chain[1] @ chain[0]
        else:
            world_from_lidar = chain[0]
            world_from_lidar[:2, 3] += pair.offset
            world_from_body = world_from_lidar
            if record.lidar_from_body is not None:
                world_from_body = world_from_lidar @ np.array(record.lidar_from_body, np.float64)
        path = cloud_file(self._tree.root, side, stem)
        time_s = self._time_s(side, stem)
        sweep = read_pcd(path, world_from_lidar, time_s, record.lidar, mirrored=False, full_scale=SENSOR_FULL_SCALE)
        sweep = compensated(path, replace(sweep, motion=record.motion), self.motion)
        return AgentFrame(record.agent_id, record.kind, world_from_body, speed, sweep)

    def _label_file(self, pair: Pair) -> Path:
        return self._tree.root / "cooperative" / LABEL_FOLDERS[self._place.labels] / f"{pair.stems[0]}.json"

    def _read_labels(self, i: int) -> tuple[TimedBoxes, bool]:
        """Return time and boxes of a frame, rows sorted by id, and whether ids are tracks."""
        pair = self._pairs[i]
        boxes, names, tracks = read_labels(self._label_file(pair))
        ids = np.arange(1, len(boxes) + 1, dtype=np.int64)
        numbers = all(len(track) < 20 and track.isdecimal() and int(track) < 2**31 - 1 for track in tracks)
        tracked = numbers and len(set(map(int, tracks))) == len(tracks)
        if tracked:
            # Ids from 1 on leave 0 to the vehicle; in our trees they are those of the simulation.
            ids = np.array([int(track) for track in tracks], np.int64) + (0 if self._own else 1)
        label = np.array([CLASSES.index(name) for name in names], np.int64)
        boxes = replace(boxes, label=label, object_id=ids)
        instant = TimedBoxes(self._time_s("vehicle-side", pair.stems[0]), boxes[np.argsort(ids, kind="stable")])
        return instant, tracked

    def _speed(self, i: int) -> float:
        """Return the vehicle's speed, m/s, from its positions a frame earlier and later; 0 without neighbours."""
        near = [j for j in (i - 1, i, i + 1) if 0 <= j < len(self._pairs)]
        times = [self._time_s("vehicle-side", self._pairs[j].stems[0]) for j in near]
        gap = times[-1] - times[0]
        if not 0.0 < gap <= 2.0 * LONGEST_GAP_S:
            return 0.0
        ends = [read_transform(self._calib("vehicle-side", self._pairs[j].stems[0])[1][1]) for j in (near[0], near[-1])]
        return float(np.linalg.norm(ends[1][:3, 3] - ends[0][:3, 3]) / gap)

    def _points_on(self, pair: Pair, agents: tuple[AgentFrame, ...], truth: Boxes) -> NDArray[np.int32]:
        if self._own:
            known = [count_points(agent.sweep, truth.object_id) for agent in agents]
            # Sweeps may have been thinned, or tell no objects; trees of earlier versions list these without a number.
            listed = [read_json(self._side_labels(side, pair), list[SideLabel]) for side in SIDES]
            counts = [{label.track_id: label.points_on for label in labels} for labels in listed]
            recorded = [[of.get(one, 0) for one in truth.object_id.tolist()] for of in counts]
            return np.maximum(known, np.array(recorded, np.int32))
        inside = np.stack([truth.contains(agent.sweep.world_points).sum(axis=1) for agent in agents]).astype(np.int32)
        place = np.stack([agent.sweep.world_from_lidar[:2, 3] for agent in agents])
        nearest = np.linalg.norm(truth.center[None, :, :2] - place[:, None], axis=2).argmin(axis=0)
        unseen = np.flatnonzero(inside.sum(axis=0) == 0)
        inside[nearest[unseen], unseen] = 1
        return inside

    def _side_labels(self, side: str, pair: Pair) -> Path:
        stem = pair.stems[SIDES.index(side)]
        return self._tree.root / side / ("label/lidar" if side == SIDES[0] else "label/virtuallidar") / f"{stem}.json"
