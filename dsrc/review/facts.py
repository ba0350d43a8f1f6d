"""What the ground truth of a frame says of one object."""

from collections.abc import Sequence

import numpy as np

from dsrc.review.view import ObjectFacts, Sighting
from sensors.frame import Frame
from sim.boxes import CLASSES
from sim.traffic.base import lit


def facts_of(frame: Frame, object_id: int | None, ego_id: int, titles: Sequence[str]) -> ObjectFacts | None:
    """Return the facts of an object; None when the frame does not have it.

    Args:
        frame: the frame.
        object_id: of whom, None for nobody.
        ego_id: the agent that detects.
        titles: names of the agents, in the order of the frame.
    """
    found = np.flatnonzero(frame.truth.object_id == object_id)
    if object_id is None or len(found) == 0:
        return None
    row = int(found[0])
    yaw = frame.truth.yaw[row]
    return ObjectFacts(
        object_id=int(frame.truth.object_id[row]),
        class_name=CLASSES[frame.truth.label[row]],
        speed=float(np.hypot(*frame.velocity[row])),
        acceleration=float(frame.acceleration[row] @ [np.cos(yaw), np.sin(yaw)]),
        lights=lit(int(frame.signals[row])),
        lane=frame.lane[row],
        seen_by=int(frame.seen_by(ego_id)[row]),
        sightings=tuple(
            Sighting(title, int(points), float(fraction))
            for title, points, fraction in zip(
                titles, frame.points_on[:, row], frame.visible_fraction[:, row], strict=True
            )
        ),
    )
