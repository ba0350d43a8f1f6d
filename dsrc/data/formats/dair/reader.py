"""Read DAIR-V2X-C: pairs of a vehicle's and an infrastructure's frame, a batch of them as a drive.

What the frames say, and what they cannot:

* The world is the dataset's. The vehicle's LiDAR stands at novatel_to_world * lidar_to_novatel, the infrastructure's at
  virtuallidar_to_world, moved by the pair's `system_error_offset`.
* The infrastructure's sweep keeps its own time, up to 0.2 s from the vehicle's, whose time is the frame's.
* Ground truth are the cooperative labels. They have no tracks in DAIR-V2X-C: ids then number the objects of each frame
  and velocities are NaN. Where labels have a `track_id`, as ours have, it is the id, and velocities are finite
  differences.
* The box in which the vehicle's LiDAR stands is the vehicle itself and has its id.
* Somebody saw what is labelled: an object without a point in its box counts as one point of the LiDAR nearest to it.

A drive goes by a path that need not exist: TREE/BATCH, TREE/SPLIT/BATCH or TREE/original/BATCH, where SPLIT is a list
of the vehicle's frames (`TREE/val.json`, or "cooperative_split" of `cooperative-split-data.json`) and `original` takes
the labels that were there before the complemented ones.
"""

import hashlib
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dsrc.data.formats.annotation import with_own_bodies
from dsrc.data.formats.dair.tree import (
    LABEL_FOLDERS,
    TREE,
    BatchRecord,
    Labels,
    Pair,
    SideRecord,
    Tree,
    calib_file,
    cloud_file,
    is_tree,
    open_tree,
    read_labels,
    read_transform,
)
from dsrc.data.formats.pcd import SENSOR_FULL_SCALE, read_pcd
from dsrc.data.velocity_from_tracks import LONGEST_GAP_S, Instant, tracked_velocity
from sensors.deskew import check_motion, deskew
from sensors.frame import AgentFrame, Frame, count_points
from sensors.sweep import Motion, Sweep
from sim.boxes import CLASSES, Boxes
from sim.errors import DataError, complaint, did_you_mean

VEHICLE_ID, INFRASTRUCTURE_ID = 0, -1
"""Ids of the agents of trees that do not say; objects are numbered from 1."""


@dataclass(frozen=True, slots=True)
class Address:
    """What a path asks of a tree.

    Attributes:
        tree: its folder.
        batch: one batch, None for all.
        split: a list of frames, None for all.
        labels: which of them.
    """

    tree: Path
    batch: str | None
    split: str | None
    labels: Labels

    @property
    def folder(self) -> Path:
        """The path without the batch."""
        words = [word for word in (self.split, "original" if self.labels == "original" else None) if word is not None]
        return self.tree.joinpath(*words)


def locate(path: Path) -> Address | None:
    """Return what a path asks of a DAIR-V2X-C tree at it or above it; None when there is none.

    Raises:
        DataError: there is a tree, but not the split or batch that the path asks for.
    """
    path = Path(path)
    words: list[str] = []
    for folder in [path, *path.parents][:4]:
        for tree in (folder, folder / TREE):
            if is_tree(tree):
                return _address(tree, words[::-1])
        if folder.exists():
            return None
        words.append(folder.name)
    return None


def _address(tree: Path, words: list[str]) -> Address:
    labels: Labels = "complemented"
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
    return Address(tree, batch, split, labels)


def list_batches(address: Address) -> list[Path]:
    """Return the paths of the drives of an address, in the order of their numbers."""
    tree = open_tree(address.tree)
    kept = None if address.split is None else tree.splits[address.split]
    names = [address.batch] if address.batch is not None else list(tree.batches)
    found = [name for name in names if kept is None or any(pair.stems[0] in kept for pair in tree.batches[name])]
    if not found:
        raise DataError(complaint(address.folder, "drives", "a batch with frames of this split", "none"))
    return [address.folder / name for name in found]


class DairReader:
    """Random access to the frames of a batch, as `dsrc.data.formats.opv2v.reader.DriveReader` gives it.

    Attributes:
        drive: its path, see above.
        motion: how the sensors' motion is compensated in the frames; None as in the files.
        agents: ids of the vehicle and of the infrastructure.
        frames: numbers of the vehicle's frames, ascending.
        protocol: empty; the tree has no such file.
    """

    format = "DAIR-V2X-C"

    def __init__(self, drive: Path, motion: Motion | None = None) -> None:
        """Look at the indices; no cloud is read yet.

        Raises:
            DataError: there is no such batch, or an index of the tree is wrong.
            SettingsError: there is no such motion.
        """
        if motion is not None:
            check_motion(motion)
        address = locate(Path(drive))
        if address is None or address.batch is None:
            raise DataError(complaint(drive, "folder", "a batch of a DAIR-V2X-C tree", "none"))
        self.drive, self.motion = Path(drive), motion
        self.protocol: dict = {}
        self._address = address
        self._tree: Tree = open_tree(address.tree)
        kept = None if address.split is None else self._tree.splits[address.split]
        pairs = self._tree.batches[address.batch]
        self._pairs = tuple(pair for pair in pairs if kept is None or pair.stems[0] in kept)
        if not self._pairs:
            raise DataError(complaint(drive, "frames", f"some of split {address.split}", "none"))
        own = self._tree.sidecar.batches.get(address.batch) if self._tree.sidecar is not None else None
        self._own = own is not None
        self._record = own or BatchRecord(
            address.batch, SideRecord(VEHICLE_ID, "vehicle"), SideRecord(INFRASTRUCTURE_ID, "roadside")
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
            DataError: a file is missing or broken, or the clouds cannot be given in the motion that is asked for.
        """
        pair = self._pairs[i]
        time_s = self._time_s("vehicle-side", pair.stems[0])
        now, tracked = self._labels(i)
        truth = now.boxes
        vehicle = self._agent("vehicle-side", pair, self._record.vehicle, self._speed(i))
        infrastructure = self._agent("infrastructure-side", pair, self._record.infrastructure, 0.0)
        agents = (vehicle, infrastructure)
        frame = Frame(
            index=self.frames[i],
            time_s=time_s,
            agents=agents,
            truth=truth,
            velocity=tracked_velocity(now, *(self._neighbour(i + step) if tracked else None for step in (-1, 1))),
            points_on=self._points_on(agents, truth),
        )
        return frame if self._own else with_own_bodies(frame)

    def plans(self, i: int) -> dict[int, NDArray[np.float64]]:
        """Return no plans: the dataset has none."""
        return {}

    def digest(self) -> str:
        """Return a SHA-256 of the labels, the poses and the names and sizes of the clouds."""
        digest = hashlib.sha256()
        for pair in self._pairs:
            files = [self._label_file(pair)]
            for side, stem in zip(("vehicle-side", "infrastructure-side"), pair.stems, strict=True):
                files += [file for _, file in self._calib(side, stem)]
                cloud = cloud_file(self._tree.root, side, stem)
                digest.update(f"{side}/{cloud.name}\0{cloud.stat().st_size}\0".encode())
            digest.update(f"{pair.offset.tolist()}\0".encode())
            for file in files:
                digest.update(file.read_bytes())
        return digest.hexdigest()

    def _time_s(self, side: str, stem: str) -> float:
        """Return the time of a frame since the start of the batch, s."""
        info = (self._tree.vehicle if side == "vehicle-side" else self._tree.infrastructure)[stem]
        return (info.pointcloud_timestamp - self._tree.start_us(str(self._address.batch))) / 1e6

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
        sweep = self._compensated(path, replace(sweep, motion=record.motion))
        return AgentFrame(record.agent_id, record.kind, world_from_body, speed, sweep)

    def _compensated(self, path: Path, sweep: Sweep) -> Sweep:
        if self.motion is None:
            return sweep
        try:
            return deskew(sweep, self.motion)
        except DataError as error:
            raise DataError(f"{path}: cannot be read as '{self.motion}': {error}") from None

    def _label_file(self, pair: Pair) -> Path:
        return self._tree.root / "cooperative" / LABEL_FOLDERS[self._address.labels] / f"{pair.stems[0]}.json"

    def _read_labels(self, i: int) -> tuple[Instant, bool]:
        """Return time and boxes of a frame, rows sorted by id, and whether ids are the same in other frames."""
        pair = self._pairs[i]
        boxes, names, tracks = read_labels(self._label_file(pair))
        ids = np.arange(1, len(boxes) + 1, dtype=np.int64)
        tracked = all(track.isdigit() and int(track) < 2**31 - 1 for track in tracks) and len(set(tracks)) == len(
            tracks
        )
        if tracked:
            # Numbers from 1 on leave 0 to the vehicle; our own are those of the simulation.
            ids = np.array([int(track) for track in tracks], np.int64) + (0 if self._own else 1)
        label = np.array([CLASSES.index(name) for name in names], np.int64)
        boxes = replace(boxes, label=label, object_id=ids)
        instant = Instant(self._time_s("vehicle-side", pair.stems[0]), boxes[np.argsort(ids, kind="stable")])
        return instant, tracked

    def _neighbour(self, i: int) -> Instant | None:
        if not 0 <= i < len(self._pairs):
            return None
        instant, tracked = self._labels(i)
        return instant if tracked else None

    def _speed(self, i: int) -> float:
        """Return the vehicle's speed, m/s, by its places a frame earlier and later; 0 where there are none."""
        near = [j for j in (i - 1, i, i + 1) if 0 <= j < len(self._pairs)]
        times = [self._time_s("vehicle-side", self._pairs[j].stems[0]) for j in near]
        gap = times[-1] - times[0]
        if not 0.0 < gap <= 2.0 * LONGEST_GAP_S:
            return 0.0
        ends = [read_transform(self._calib("vehicle-side", self._pairs[j].stems[0])[1][1]) for j in (near[0], near[-1])]
        return float(np.linalg.norm(ends[1][:3, 3] - ends[0][:3, 3]) / gap)

    def _points_on(self, agents: tuple[AgentFrame, ...], truth: Boxes) -> NDArray[np.int32]:
        if self._own:
            return np.stack([count_points(agent.sweep, truth.object_id) for agent in agents])
        counts = np.stack([truth.contains(agent.sweep.world_points).sum(axis=1) for agent in agents]).astype(np.int32)
        place = np.stack([agent.sweep.world_from_lidar[:2, 3] for agent in agents])
        nearest = np.linalg.norm(truth.center[None, :, :2] - place[:, None], axis=2).argmin(axis=0)
        unseen = np.flatnonzero(counts.sum(axis=0) == 0)
        counts[nearest[unseen], unseen] = 1
        return counts
