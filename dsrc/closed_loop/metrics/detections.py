"""Calibration of the detections that an ego drives by: how often a box of a score is right."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.log import EpisodeLog
from dsrc.evaluation.metrics.ap import FrameResult, match_frames
from dsrc.evaluation.metrics.calibration import IOU, Reliability, reliability
from dsrc.ops.detections import Detections
from dsrc.runs.executors import Progress


def detection_hits(log: EpisodeLog) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the scores of an episode's detections, and whether each hits a road user, as (D,) arrays.

    A detection hits the free box that overlaps it most, by half or more in bird's-eye view, of the road users but the
    ego at the instant of its measurement; what a liar reports is none of them.
    """
    times = np.array([log.actors[step].time_s for step in range(len(log.actors))])
    frames = []
    for percept in (tick.percept for tick in log.ticks if tick.percept is not None):
        boxes = log.actors[int(np.abs(times - percept.time_s).argmin())].boxes
        others = boxes[boxes.object_id != log.settings.ego_id]
        frames.append(FrameResult(Detections(percept.boxes, percept.score.astype(np.float32)), others))
    matches = match_frames(frames, (IOU[1],))
    return matches.score, matches.matched[IOU] >= 0


def calibrations(keys: Iterable[str], folder: Path, progress: Progress | None = None) -> dict[str, Reliability]:
    """Return the reliability curves of the detections of episodes whose logs are there, by their keys.

    Args:
        keys: of the episodes.
        folder: of the logs.
        progress: called with episodes done and episodes in all.

    Raises:
        DataError: a log is damaged.
    """
    every, found = list(dict.fromkeys(keys)), {}
    for done, key in enumerate(every, start=1):
        path = folder / f"{key}.npz"
        if path.is_file():
            found[key] = reliability(*detection_hits(EpisodeLog.load(path)))
        if progress is not None:
            progress(done, len(every))
    return found
