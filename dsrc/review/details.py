"""Details of one object in the ground truth of a frame."""

from collections.abc import Sequence

import numpy as np

from dsrc.review.view import ObjectDetails, ObjectVisibility
from sensors.frame import Frame
from sim.boxes import CLASSES
from sim.traffic.base import lit


def object_details(frame: Frame, object_id: int | None, ego_id: int, titles: Sequence[str]) -> ObjectDetails | None:
    """Return the details of an object; None when the frame lacks it.

    Args:
        frame: the frame.
        object_id: the object, or None.
        ego_id: the agent that detects.
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
        speed=float(np.hypot(*frame.velocity[row])),
        acceleration=float(frame.acceleration[row] @ [np.cos(yaw), np.sin(yaw)]),
        lights=lit(int(frame.signals[row])),
        lane=frame.lane[row],
        seen_by=int(frame.seen_by(ego_id)[row]),
        visibility=tuple(
            ObjectVisibility(title, int(points), float(fraction))
            for title, points, fraction in zip(
                titles, frame.points_on[:, row], frame.visible_fraction[:, row], strict=True
            )
        ),
    )
