"""Drives of sweeps of one or several sensors, in the layouts of other data sets; ground truth is optional.

The world of a drive is the data set's; without poses it is each frame's own, with the ground at 0. A body stands
below its sensor, at the height that is known of the data set. An object counts as seen by the points in its box.
"""

import hashlib
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dsrc.data.checksums import ends_of
from dsrc.data.formats.annotation import with_own_bodies
from dsrc.data.formats.pcd import compensated
from dsrc.data.points_in_boxes import points_in_boxes
from dsrc.data.sweeps.argoverse import Argoverse
from dsrc.data.sweeps.bags import Bag
from dsrc.data.sweeps.kitti import KittiObject
from dsrc.data.sweeps.kitti_sequences import KittiTracking, SemanticKitti
from dsrc.data.sweeps.layout import Labels, Layout
from dsrc.data.sweeps.nuscenes import NuScenes
from dsrc.data.sweeps.openlabel import OpenLabel
from dsrc.data.sweeps.scans import Scans
from dsrc.data.velocity_from_tracks import LONGEST_GAP_S, TimedBoxes, tracked_velocity
from sensors.deskew import check_motion
from sensors.frame import AgentFrame, Frame
from sensors.sweep import Motion
from sim.boxes import Boxes
from sim.errors import DataError, complaint, unreadable

LAYOUTS: tuple[type[Layout], ...] = (
    KittiTracking,
    KittiObject,
    SemanticKitti,
    NuScenes,
    Argoverse,
    OpenLabel,
    Bag,
    Scans,
)
"""Layouts, those that are told by more before those that are told by less."""
IN_PLACE: tuple[type[Layout], ...] = (KittiTracking, KittiObject, SemanticKitti, NuScenes, Scans)
"""Layouts of loose scans, which are corrupted file by file in the tree that they have."""

_WHOLE_BYTES = 1 << 20
"""Most bytes of a file that a digest takes whole."""


def sweeps_below(root: Path) -> list[Path]:
    """Return the paths of the drives of sweeps at or below a file or folder, at most three folders down, sorted."""
    found: list[Path] = []
    places = [root]
    for _ in range(4):  # such as training/velodyne/0000
        deeper: list[Path] = []
        for place in places:
            drives = _drives_at(place)
            found += drives
            if not drives and place.is_dir():
                deeper += sorted(path for path in place.iterdir() if not path.name.startswith("."))
        places = deeper
    return found


def _drives_at(place: Path) -> list[Path]:
    """Return the drives of a file or folder itself, by the first layout that it has."""
    for layout in LAYOUTS:
        try:
            if drives := layout.below(place):
                return drives
        except OSError as error:
            raise DataError(unreadable(place, "folder", error)) from None
    return []


def layout_of(path: Path) -> Layout | None:
    """Return the layout of a drive by its path, opened; None where it is no drive of sweeps."""
    return next((found for layout in LAYOUTS if (found := layout.at(path)) is not None), None)


def of_loose_scans(path: Path) -> bool:
    """Return whether the clouds of a drive are files that `dsrc corrupt` takes one by one."""
    return isinstance(layout_of(path), IN_PLACE)


class SweepReader:
    """Random access to the frames of a drive of sweeps, a `dsrc.data.drives.Drive`.

    Attributes:
        drive: its path, which need not exist where a table lists several drives.
        motion: compensation of the sensors' motion in the frames; None for that of the files.
        agents: ids of the sensors: 0 for a single one.
        frames: numbers of the frames, ascending.
        protocol: empty; the layouts have no such file.
        format: name of the data set.
    """

    def __init__(self, drive: Path, motion: Motion | None = None, layout: Layout | None = None) -> None:
        """List the frames.

        Args:
            layout: of the drive, where it is open already.

        Raises:
            DataError: the drive is missing, empty or damaged.
            SettingsError: the motion is unknown.
        """
        if motion is not None:
            check_motion(motion)
        layout = layout or layout_of(Path(drive))
        if layout is None:
            raise DataError(complaint(drive, "drive", "sweeps in a known layout", "none"))
        if not layout.frames:
            raise DataError(complaint(drive, "frames", f"at least one, as {layout.format} has them", "none"))
        self.drive, self.motion, self.format = Path(drive), motion, layout.format
        self.protocol: dict = {}
        self.agents, self.frames = layout.agents, layout.frames
        self._layout = layout
        self._labels = lru_cache(maxsize=4)(layout.labels)

    def __len__(self) -> int:
        return len(self.frames)

    def __reduce__(self) -> tuple[type["SweepReader"], tuple[Path, Motion | None]]:
        return SweepReader, (self.drive, self.motion)

    def read(self, i: int) -> Frame:
        """Read the i-th frame (a position in `frames`).

        Raises:
            DataError: a file is missing or damaged, or the clouds cannot be compensated as `motion`.
        """
        layout = self._layout
        labels = self._labels(i) or Labels(Boxes.zeros())
        order = np.argsort(labels.boxes.object_id, kind="stable")
        truth = labels.boxes[order]
        agents, counts, speed = [], [], self._speed(i)
        rows = zip(self.agents, layout.kinds, layout.height_m, layout.sweeps(i), strict=True)
        for agent_id, kind, height, read in rows:
            sweep = compensated(self.drive, read, self.motion)
            down = np.eye(4)
            down[2, 3] = -height
            moving = speed if kind == "vehicle" else 0.0
            agents.append(AgentFrame(agent_id, kind, sweep.world_from_lidar @ down, moving, sweep))
            counts.append(_points_on(truth, sweep.points, sweep.world_from_lidar))
        velocity = self._velocity(i, TimedBoxes(layout.time_s(i), truth))
        if labels.velocity is not None:
            velocity = labels.velocity[order]
        frame = Frame(
            index=self.frames[i],
            time_s=layout.time_s(i),
            agents=tuple(agents),
            truth=truth,
            velocity=velocity,
            points_on=np.array(counts, np.int32).reshape(len(agents), len(truth)),
            region=labels.region,
            tilt=np.zeros((len(truth), 2)) if labels.tilt is None else labels.tilt[order],
        )
        return with_own_bodies(frame)

    def plans(self, i: int) -> dict[int, NDArray[np.float64]]:
        """Return an empty dict: the data sets have no plans."""
        return {}

    def labelled(self, i: int) -> bool:
        """Return whether the i-th frame has ground truth, an empty one included."""
        return self._layout.labelled(i)

    def complete(self) -> bool:
        """Return whether labels are complete everywhere in all frames that have them; no cloud is read."""
        regions = (labels.region for i in range(len(self)) if (labels := self._labels(i)) is not None)
        return all(region is None or (region.projection is None and not len(region.ignored)) for region in regions)

    def digest(self) -> str:
        """Return the SHA-256 of names, sizes, starts and ends of all files, small ones whole."""
        digest = hashlib.sha256()
        files = dict.fromkeys(file for i in range(len(self)) for file in self._layout.files(i))
        for file in files:
            if not file.is_file():
                continue
            size = file.stat().st_size
            digest.update(f"{file.name}\0{size}\0".encode())
            digest.update(file.read_bytes() if size <= _WHOLE_BYTES and file.suffix != ".bin" else ends_of(file))
        digest.update(repr(self.frames).encode())
        return digest.hexdigest()

    def _velocity(self, i: int, now: TimedBoxes) -> NDArray[np.float64]:
        """Return (N, 2) velocities by the tracks a frame earlier and later; NaN without any."""
        if not self._layout.tracked or not len(now.boxes):
            return np.full((len(now.boxes), 2), np.nan)
        near: list[TimedBoxes | None] = []
        for j in (i - 1, i + 1):
            labels = self._labels(j) if 0 <= j < len(self) else None
            near.append(None if labels is None else TimedBoxes(self._layout.time_s(j), labels.boxes))
        return tracked_velocity(now, *near)

    def _speed(self, i: int) -> float:
        """Return the first sensor's speed, m/s, from its places a frame earlier and later; 0 without neighbours."""
        if not self._layout.tracked:
            return 0.0
        near = [j for j in (i - 1, i, i + 1) if 0 <= j < len(self)]
        gap = self._layout.time_s(near[-1]) - self._layout.time_s(near[0])
        if not 0.0 < gap <= 2.0 * LONGEST_GAP_S:
            return 0.0
        places = [self._layout.poses(j)[0][:3, 3] for j in (near[0], near[-1])]
        return float(np.linalg.norm(places[1] - places[0]) / gap)


def _points_on(truth: Boxes, points: NDArray[np.float32], world_from_lidar: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return (N,) numbers of points in the boxes."""
    _, boxes = points_in_boxes(truth, points, world_from_lidar)
    return np.bincount(boxes, minlength=len(truth))
