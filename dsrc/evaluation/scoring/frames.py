"""Sets of detections, and the true boxes of their frames before a protocol chooses among them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from dsrc.data.formats.kitti_labels import InImage
from dsrc.evaluation.metrics.ap import FrameResult
from dsrc.evaluation.metrics.protocols import Protocol
from dsrc.ops.detections import Detections
from sensors.frame import Region
from sim.boxes import Boxes


class FrameKey(NamedTuple):
    """Frame of a drive.

    Attributes:
        drive: name of the drive; "" where there is only one.
        frame: its number.
        ego_id: agent in whose LiDAR's frame the boxes are; None for the first vehicle.
    """

    drive: str
    frame: int
    ego_id: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """N true vehicles of a frame, in the ego LiDAR's frame.

    Attributes:
        boxes: of any agent, at any distance.
        own: (N,) the ego's own box.
        reach_m: (N,) distance from the ego of the nearest agent with a point on it, m; 0 where the ego has one.
        image: of each box in the camera's image; None if unknown.
        rounds: boxes are judged as float32, as stored ones are; which of them count is decided before.
        region: where boxes are judged, true ones and detections; None for everywhere.
        points: (N,) the ego's points on each; None if unknown.
        others: vehicles that are left out: without any point, or out of the region.
    """

    boxes: Boxes
    own: NDArray[np.bool_]
    reach_m: NDArray[np.float64]
    image: InImage | None = None
    rounds: bool = False
    region: Region | None = None
    points: NDArray[np.int32] | None = None
    others: Boxes = field(default_factory=Boxes.zeros)

    def judged(self, rows: NDArray[np.bool_] | slice) -> Boxes:
        """Return the boxes of some rows as they are judged."""
        boxes = self.boxes[rows]
        if not self.rounds:
            return boxes
        return Boxes.from_array(boxes.array.astype(np.float32), boxes.label, boxes.object_id)

    @classmethod
    def of(cls, boxes: Boxes, own: NDArray[np.bool_] | None = None, image: InImage | None = None) -> Self:
        """True boxes of which nothing else is known: the ego's own is the one around the origin."""
        if own is None:
            around = boxes.contains(np.column_stack([np.zeros((len(boxes), 2)), boxes.center[:, 2]]))
            own = np.diagonal(around).copy()
        return cls(boxes, own, np.zeros(len(boxes)), image)


@dataclass(frozen=True, slots=True, eq=False)
class DetectionSet:
    """Detections of one method.

    Attributes:
        name: of the method.
        frames: detections by frame, in their order.
        truth: true boxes that are stored with them; None for none.
        has_scores: the confidence is known; without it detections are the best first in each frame.
        note: what limits the set, one line; "" for nothing.
        images: of the detections in the camera's image, by frame; None if unknown.
    """

    name: str
    frames: Mapping[FrameKey, Detections]
    truth: Mapping[FrameKey, Truth] | None = None
    has_scores: bool = True
    note: str = ""
    images: Mapping[FrameKey, InImage] | None = None


def select(protocol: Protocol, detections: Detections, truth: Truth) -> FrameResult:
    """Detections and true boxes of a frame that count in a protocol."""
    kept = protocol.counts(truth.boxes) & (truth.reach_m <= protocol.reach_m)
    if not protocol.ego:
        kept &= ~truth.own
    return FrameResult(detections[protocol.counts(detections.boxes)], truth.judged(kept))
