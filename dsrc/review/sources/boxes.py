"""Detections alone, without the clouds that they are of: files of boxes, and results whose drives are gone."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dsrc.evaluation.detection_table import one_frame
from dsrc.evaluation.scoring.frames import DetectionSet as ScoredSet
from dsrc.evaluation.scoring.frames import FrameKey
from dsrc.evaluation.scoring.read import EVERY, read_detections
from dsrc.review.sources.base import Source
from dsrc.review.sources.live import LiveSource
from sensors.frame import AgentFrame, Frame
from sensors.sweep import make_sweep
from sim.boxes import Boxes
from sim.geometry import pose_matrix

_LIDAR_M = 1.9
"""Height of the LiDAR in whose frame the boxes are, above the drawn ground, m."""
_STEP_S = 0.1


def _source(name: str, keys: Sequence[FrameKey], sets: Sequence[ScoredSet], note: str) -> Source:
    """Source of detections without clouds, each frame in that of its ego's LiDAR, which stands still."""
    source, lidar = LiveSource(name, len(keys)), pose_matrix([0.0, 0.0, _LIDAR_M])
    source.note = note
    for row, key in enumerate(keys):
        stored = [one.truth[key].boxes for one in sets if one.truth and key in one.truth]
        source.labelled |= bool(stored)
        boxes, ego_id, time_s = stored[0] if stored else Boxes.zeros(), key.ego_id or 0, _STEP_S * row
        ego = AgentFrame(ego_id, "vehicle", np.eye(4), 0.0, make_sweep(np.zeros((0, 3)), lidar, time_s))
        none, hits = np.zeros((len(boxes), 2)), np.zeros((1, len(boxes)), np.int32)
        frame = Frame(key.frame, time_s, (ego,), boxes.transform(lidar), none, hits)
        known = {one.name: one.frames[key] for one in sets if key in one.frames}
        source.put(frame, {name: one_frame(row, key.frame, ego_id, found, boxes) for name, found in known.items()})
    source.end()
    return source


def open_boxes(path: Path, note: str = "") -> list[Source]:
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
    note = note or "Detections without clouds; a folder of dsrc evaluate has both."
    return [_source(drive or path.stem, [key for key in keys if key.drive == drive], sets, note) for drive in drives]
