"""Teacher clouds: dense, painted objects for the teacher of the distillation.

An agent's objects are replaced by what all agents together see of them; the points on objects carry paint 1, the
others 0. Source: DSRC, arXiv 2412.10739, "multi-view dense object construction" and "point painting".
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dsrc.data.sample import Sample
from sim.boxes import Boxes

Inside = Literal["rotated", "hull"]
"""`rotated`: the box itself, as in the paper; `hull`: its axis-aligned hull, as the released code has it."""


@dataclass(frozen=True, slots=True, eq=False)
class TeacherClouds:
    """What the teacher sees of a sample, in the ego LiDAR's frame.

    Attributes:
        clouds: per agent (P, 5) float32 x, y, z, intensity, paint; points on objects first.
        object_clouds: per agent (Q, 5) float32, its points on objects alone.
        merged: (M, 4) float32 the clouds of all agents, those of `further` ones last.
    """

    clouds: tuple[NDArray[np.float32], ...]
    object_clouds: tuple[NDArray[np.float32], ...]
    merged: NDArray[np.float32]


def teacher_clouds(
    sample: Sample,
    inside: Inside = "rotated",
    dense: bool = True,
    paint: bool = True,
    further: Sequence[NDArray[np.float32]] = (),
) -> TeacherClouds:
    """Build the teacher's clouds.

    Args:
        sample: the students' view.
        inside: which points belong to a box. With `hull` an agent without objects gets its whole cloud as object
            cloud, the released code's mistake; with `rotated` its object cloud is empty.
        dense: take the points on objects from all agents; else from the agent alone.
        paint: mark points on objects with 1 in the fifth column; else it is 0 everywhere.
        further: (P, 4) clouds in the sample's frame of agents that its student does not hear: they make objects denser.

    Returns:
        Clouds with row order: points on objects in the order of `merged`, then the agent's others in its order.
    """
    merged = np.concatenate([*sample.clouds, *further, np.zeros((0, 4), np.float32)])
    starts = np.cumsum([0] + [len(cloud) for cloud in sample.clouds])
    members = _Members(merged, inside)
    clouds, object_clouds = [], []
    for agent, boxes in enumerate(sample.agent_boxes):
        own = slice(starts[agent], starts[agent + 1])
        if inside == "hull" and len(boxes) == 0:
            whole = _painted(sample.clouds[agent], 0.0)
            clouds.append(whole)
            object_clouds.append(whole)
            continue
        on_object = members.of(boxes)
        chosen = np.flatnonzero(on_object) if dense else starts[agent] + np.flatnonzero(on_object[own])
        others = starts[agent] + np.flatnonzero(~on_object[own])
        cloud = _painted(merged.take(np.concatenate([chosen, others]), axis=0), 0.0)
        cloud[: len(chosen), 4] = 1.0 if paint else 0.0
        clouds.append(cloud)
        object_clouds.append(cloud[: len(chosen)])
    return TeacherClouds(tuple(clouds), tuple(object_clouds), merged)


def _painted(cloud: NDArray[np.float32], value: float) -> NDArray[np.float32]:
    return np.concatenate([cloud, np.full((len(cloud), 1), value, np.float32)], axis=1)


class _Members:
    """Finds the points in boxes; sorted by x once, so that each box looks at a thin slice only."""

    def __init__(self, points: NDArray[np.float32], inside: Inside) -> None:
        self._order = np.argsort(points[:, 0])
        self._points = points[self._order, :3]
        self._inside = inside
        self._known: dict[bytes, NDArray[np.int64]] = {}

    def of(self, boxes: Boxes) -> NDArray[np.bool_]:
        """Return (M,) whether each point, in the order given at first, lies in any of the boxes."""
        mask = np.zeros(len(self._order), bool)
        if len(boxes) == 0:
            return mask
        # The comparison is in float32 like the points, so that a face means the same for both.
        corners = boxes.corners().astype(np.float32)
        low, high = corners.min(axis=1), corners.max(axis=1)
        for row in range(len(boxes)):
            key = boxes.array[row].tobytes()
            if key not in self._known:
                self._known[key] = self._in_box(boxes[row : row + 1], low[row], high[row])
            mask[self._known[key]] = True
        return mask

    def _in_box(self, box: Boxes, low: NDArray[np.float32], high: NDArray[np.float32]) -> NDArray[np.int64]:
        first = np.searchsorted(self._points[:, 0], low[0], "left")
        last = np.searchsorted(self._points[:, 0], high[0], "right")
        near = self._points[first:last]
        if self._inside == "hull":
            mask = ((near >= low) & (near <= high)).all(axis=1)
        else:
            mask = box.contains(near)[0]
        return self._order[first:last][mask]
