"""Details of one object in the ground truth of a frame, or of one detection."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from dsrc.data.points_in_boxes import points_in_boxes
from dsrc.evaluation.detection_table import points_left
from dsrc.review.errors.judged import JudgedRun
from dsrc.review.view import DetectionDetails, ObjectDetails, ObjectVisibility
from sensors.frame import Frame
from sim.boxes import CLASSES, Boxes
from sim.geometry import invert
from sim.traffic.base import lit


def object_details(
    frame: Frame, recorded: Frame, object_id: int | None, ego_id: int, titles: Sequence[str]
) -> ObjectDetails | None:
    """Return the details of an object; None when the frame lacks it.

    Args:
        recorded: the frame before the corruption.
        titles: names of the agents, in the order of the frame.
    """
    found = np.flatnonzero(frame.truth.object_id == object_id)
    if object_id is None or len(found) == 0:
        return None
    row = int(found[0])
    yaw = frame.truth.yaw[row]
    return ObjectDetails(
        object_id=int(frame.truth.object_id[row]),
        class_name=CLASSES[frame.truth.label[row]],
        size=_size(frame.truth, row),
        distance_m=_distance(frame, ego_id, frame.truth.center[row]),
        speed=float(np.hypot(*frame.velocity[row])),
        acceleration=float(frame.acceleration[row] @ [np.cos(yaw), np.sin(yaw)]),
        lights=lit(int(frame.signals[row])),
        lane=frame.lane[row],
        seen_by=int(frame.seen_by(ego_id)[row]),
        visibility=tuple(
            ObjectVisibility(title, int(points), int(left), float(fraction))
            for title, points, left, fraction in zip(
                *(titles, frame.points_on[:, row], points_left(recorded, frame)[:, row]),
                frame.visible_fraction[:, row],
                strict=True,
            )
        ),
    )


def verdict_on(object_id: int, judged: JudgedRun, threshold: float, iou: float) -> tuple[str, float, float]:
    """Verdict on an object of one frame, and score and IoU of its detection, NaN without one."""
    rows = np.flatnonzero(judged.table.object_id == object_id)
    if len(rows) == 0:
        return "not evaluated", math.nan, math.nan
    rank = int(judged.at(iou).found_by[rows[0]])
    if rank < 0:
        return "missed", math.nan, math.nan
    verdict = "found" if rank < judged.kept(threshold) else "missed"
    return verdict, float(judged.table.score[rank]), judged.nearest_at(iou, rank)[1]


def detection_details(
    frame: Frame, rank: int, judged: JudgedRun, iou: float, titles: Sequence[str], labelled: bool
) -> DetectionDetails:
    """Details of a detection.

    Args:
        rank: place of the detection in the order of the scores.
        judged: detections of this frame alone.
        titles: names of the agents, in the order of the frame.
        labelled: whether the drive has ground truth.
    """
    ego_id = int(judged.table.ego_id[0])
    box = judged.boxes[rank : rank + 1].transform(frame.agent(ego_id).sweep.world_from_lidar)
    nearest, overlap = judged.nearest_at(iou, rank)
    verdict = "true" if judged.at(iou).matched[rank] >= 0 else "false"
    object_id = int(judged.table.object_id[nearest]) if nearest >= 0 else None
    return DetectionDetails(
        rank=rank,
        class_name=CLASSES[box.label[0]],
        size=_size(box, 0),
        distance_m=_distance(frame, ego_id, box.center[0]),
        score=float(judged.table.score[rank]),
        verdict=verdict if labelled else "",
        object_id=object_id,
        object_name="" if object_id is None else f"{CLASSES[judged.table.label[nearest]]} {object_id}",
        iou=overlap,
        points=tuple(zip(titles, _points_in(frame, box), strict=True)),
    )


def _size(boxes: Boxes, row: int) -> tuple[float, float, float]:
    length, width, height = boxes.size[row].tolist()
    return length, width, height


def _distance(frame: Frame, ego_id: int, center: NDArray[np.float64]) -> float:
    return float(np.hypot(*(center - frame.agent(ego_id).world_from_body[:3, 3])[:2]))


def _points_in(frame: Frame, box: Boxes) -> list[int]:
    """Points of each agent in one box of the world frame."""
    counts = []
    for agent in frame.agents:
        inside, _ = points_in_boxes(box.transform(invert(agent.sweep.world_from_lidar)), agent.sweep.points)
        counts.append(len(inside))
    return counts
