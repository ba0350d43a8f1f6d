"""Points on vehicles, for faults of surfaces: by object ids, or else by the boxes of a frame."""

import numpy as np
from numpy.typing import NDArray

from sensors.frame import Frame
from sensors.sweep import UNKNOWN_MATERIAL, Sweep
from sim.boxes import CLASSES
from sim.errors import notice

_MARGIN_M = 0.1


def points_on_vehicles(frame: Frame, row: int) -> NDArray[np.bool_]:
    """Return the (P,) mask of an agent's points on vehicles, by the frame's truth.

    Without object ids they are those in its boxes, moved to the time of each point.

    Args:
        row: of the agent in `frame.agents`.
    """
    sweep = frame.agents[row].sweep
    ours = frame.truth.label != CLASSES.index("pedestrian")
    vehicles = frame.truth[ours]
    if (sweep.object_id >= 0).any():
        return np.isin(sweep.object_id, vehicles.object_id)
    if len(frame.truth) == 0:
        note_unlabelled(sweep, "boxes or ids of objects")
    points, inside = sweep.world_points, np.zeros(len(sweep), bool)
    for index, velocity in enumerate(frame.velocity[ours]):
        # Place of the point at the time of the boxes.
        way = velocity * (sweep.time_s + sweep.time_offset - frame.time_s)[:, None]
        then = points - np.column_stack([way, np.zeros(len(sweep))])
        inside |= vehicles[index : index + 1].contains(then, _MARGIN_M)[0]
    return inside


def note_unlabelled(sweep: Sweep, needs: str) -> None:
    """Warn if nothing tells what a sweep's points lie on: its vehicles then keep all their points."""
    if len(sweep) and (sweep.object_id < 0).all() and (sweep.material == UNKNOWN_MATERIAL).all():
        notice(f"incomplete_echo: expected points with {needs}, found an unlabelled cloud: no point of it is lost")
