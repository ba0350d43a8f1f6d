"""True boxes of frames in a tree: OPV2V, V2V4Real, DAIR-V2X-C or KITTI."""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from dsrc.data.drives import Drive, find_drives, open_drive
from dsrc.data.formats import kitti_labels
from dsrc.evaluation.scoring.frames import FrameKey, Truth
from dsrc.runs.executors import Progress
from sensors.frame import Frame
from sim.errors import DataError, complaint
from sim.geometry import invert

MOST_AGENTS = 5
"""Agents of a frame whose objects count: the first in the order of the folders, as in OpenCOOD and its forks."""


def truth_of_frame(frame: Frame, ego_id: int | None = None, drive: str = "") -> Truth:
    """True vehicles with a point of one of the first agents, as an ego knows them.

    Args:
        ego_id: the ego; None for the first vehicle, else the first agent.
        drive: begins the message of an error.

    Raises:
        DataError: the frame has no such agent.
    """
    ids = [agent.agent_id for agent in frame.agents]
    if ego_id is None:
        ego_id = next((agent.agent_id for agent in frame.agents if agent.kind == "vehicle"), ids[0] if ids else None)
    if ego_id is None or ego_id not in ids:
        raise DataError(complaint(f"{drive}frame {frame.index}", "ego", f"one of the agents {ids}", ego_id))
    ego = ids.index(ego_id)
    rows = [ego, *(row for row in range(len(ids)) if row != ego)][:MOST_AGENTS]
    place = np.array([frame.agents[row].sweep.world_from_lidar[:2, 3] for row in rows])
    distance = np.linalg.norm(place - place[0], axis=1)
    others = frame.truth.object_id != np.array([ids[row] for row in rows])[:, None]
    sees = (frame.points_on[rows] >= 1) & others
    reach = np.where(sees, distance[:, None], np.inf).min(axis=0)
    ego_from_world = invert(frame.agents[ego].sweep.world_from_lidar)
    boxes = frame.truth.transform(ego_from_world)
    region = None if frame.region is None else frame.region.transform(ego_from_world)
    kept = boxes.is_vehicle & np.isfinite(reach)
    if region is not None:
        kept &= region.counts(boxes)
    own = boxes.object_id == ego_id
    return Truth(
        boxes=boxes[kept],
        own=own[kept],
        reach_m=reach[kept],
        region=region,
        points=frame.points_on[ego][kept],
        others=boxes[boxes.is_vehicle & ~kept & ~own],
    )


def read_truth(tree: Path, keys: Iterable[FrameKey], progress: Progress | None = None) -> dict[FrameKey, Truth]:
    """Read the true boxes of frames.

    Those that count are judged as float32, as stored ones are; which of them count is decided before, see
    `Protocol.counts`. Frames of drives without ground truth are left out.

    Args:
        tree: drive, folder of drives, or KITTI's object tree, as labels alone where frames name no drive.
        progress: called with frames read and frames to read.

    Raises:
        DataError: the tree, a drive or a frame is missing or damaged.
    """
    keys = list(keys)
    labels = kitti_labels.label_folder(tree)
    if labels is not None and any(key.drive for key in keys) and find_drives(tree):
        labels = None  # of a drive, as `dsrc evaluate` and `dsrc detect` name the tree
    read = _Drives(tree).truth if labels is None else partial(_of_labels, labels)
    found = {}
    for done, key in enumerate(keys, 1):
        if (truth := read(key)) is not None:
            found[key] = replace(truth, rounds=True)
        if progress:
            progress(done, len(keys))
    return found


class _Drives:
    """Frames of the drives of a tree, by name and number."""

    def __init__(self, tree: Path) -> None:
        self.tree = tree
        self.paths: dict[str, list[Path]] = {}
        found = find_drives(tree)
        if not found:
            raise DataError(complaint(tree, "truth", "a tree of OPV2V or DAIR-V2X-C, or KITTI's label_2", "none"))
        for path in found:
            self.paths.setdefault(path.name, []).append(path)
        self.opened: tuple[str, Drive] | None = None

    def truth(self, key: FrameKey) -> Truth | None:
        """Read the true boxes of a frame; None of one that nobody labelled."""
        if self.opened is None or self.opened[0] != key.drive:
            self.opened = key.drive, open_drive(self._path(key.drive))
        drive = self.opened[1]
        if key.frame not in drive.frames:
            expected = f"one from {drive.frames[0]} to {drive.frames[-1]}" if drive.frames else "a drive with frames"
            raise DataError(complaint(drive.drive, "frame", expected, f"detections of frame {key.frame}"))
        position = drive.frames.index(key.frame)
        if not drive.labelled(position):
            return None
        return truth_of_frame(drive.read(position), key.ego_id, f"{drive.drive}: ")

    def _path(self, name: str) -> Path:
        if not name and len(self.paths) == 1:
            name = next(iter(self.paths))
        found = self.paths.get(name, [])
        if len(found) != 1:
            names = ", ".join(sorted(self.paths))
            what = (
                f"{len(found)} drives of that name" if found else repr(name) if name else "detections without a drive"
            )
            raise DataError(complaint(self.tree, "drive", f"one of {names}", what))
        return found[0]


def _of_labels(folder: Path, key: FrameKey) -> Truth:
    path = folder / f"{key.frame:06d}.txt"
    if key.drive or not path.is_file():
        found = f"detections of {key.drive} {key.frame}" if key.drive else f"no labels of frame {key.frame}"
        raise DataError(complaint(path, "labels", "those of every frame with detections", found))
    labels = kitti_labels.read_labels(path, kitti_labels.calibration_of(folder, key.frame))
    return Truth.of(labels.boxes, image=labels.image)
