"""Detections alone, without the clouds that they are of: files of boxes, and results whose drives are gone."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dsrc.evaluation.detection_table import one_frame
from dsrc.evaluation.scoring.frames import DetectionSet as ScoredSet
from dsrc.evaluation.scoring.frames import FrameKey
from dsrc.evaluation.scoring.read import EVERY, read_detections
from dsrc.review.sources.base import SEED, DetectionSet, Kind, MemorySet
from sensors.frame import AgentFrame, Frame
from sensors.sweep import make_sweep
from sim.boxes import Boxes
from sim.geometry import pose_matrix

_LIDAR_M = 1.9
"""Height of the LiDAR in whose frame the boxes are, above the drawn ground, m."""
_STEP_S = 0.1


class BoxSource:
    """Frames of detections without clouds, each in the frame of its ego's LiDAR, which stands still.

    Attributes: those of `Source`, and
        note: what is missing.
    """

    kind: Kind = "drive"
    seed = SEED

    def __init__(self, name: str, keys: Sequence[FrameKey], sets: Sequence[ScoredSet], note: str) -> None:
        self.name, self.note = name, note
        self.protocol: Mapping[str, Any] = {}
        self._keys = list(keys)
        self._truth = [
            next((one.truth[key].boxes for one in sets if one.truth and key in one.truth), None) for key in keys
        ]
        self.sets: dict[str, DetectionSet] = {}
        for one in sets:
            made = MemorySet(one.name)
            for row, key in enumerate(self._keys):
                if key in one.frames:
                    made.put(row, one_frame(row, key.frame, self._ego(row), one.frames[key], self._boxes(row)))
            self.sets[one.name] = made

    def __len__(self) -> int:
        return len(self._keys)

    @property
    def labelled(self) -> bool:
        """Whether true boxes are stored with the detections."""
        return any(boxes is not None for boxes in self._truth)

    def read(self, row: int) -> Frame:
        """Return the true boxes that are known, around an ego without points."""
        lidar = pose_matrix([0.0, 0.0, _LIDAR_M])
        time_s = _STEP_S * row
        sweep = make_sweep(np.zeros((0, 3)), lidar, time_s)
        ego = AgentFrame(self._ego(row), "vehicle", np.eye(4), 0.0, sweep)
        truth = self._boxes(row).transform(lidar)
        none = np.zeros((len(truth), 2))
        return Frame(self._keys[row].frame, time_s, (ego,), truth, none, np.zeros((1, len(truth)), np.int32))

    def _ego(self, row: int) -> int:
        return self._keys[row].ego_id or 0

    def _boxes(self, row: int) -> Boxes:
        boxes = self._truth[row]
        return Boxes.zeros() if boxes is None else boxes


def open_boxes(path: Path, note: str = "") -> list[BoxSource]:
    """Open detections without their clouds, a source for each drive, conditions as methods of their own.

    Args:
        path: file or folder in any form of `dsrc score`.
        note: why the clouds are missing; "" where the form has none.

    Raises:
        DataError: it is none of them, or damaged.
    """
    sets = read_detections(path, corruption=EVERY)
    keys = sorted({key for one in sets for key in one.frames}, key=lambda key: (key.drive, key.frame, key.ego_id or 0))
    drives = dict.fromkeys(key.drive for key in keys)
    note = note or "These are detections without clouds: name their drive to see both."
    return [BoxSource(drive or path.stem, [key for key in keys if key.drive == drive], sets, note) for drive in drives]
