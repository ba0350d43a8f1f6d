"""Teacher clouds: dense, painted objects as input of the distillation's teacher.

An agent's objects hold the points of all agents; the points on objects carry paint 1, the others 0. Source: DSRC, arXiv
2412.10739, "multi-view dense object construction" and "point painting".
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dsrc.data.points_in_boxes import points_in_boxes
from dsrc.data.sample import Sample
from sim.boxes import Boxes, concatenate

Inside = Literal["rotated", "hull"]
"""`rotated`: the box itself, as in the paper; `hull`: its axis-aligned hull, as the released code has it."""


@dataclass(frozen=True, slots=True, eq=False)
class TeacherClouds:
    """Clouds of a teacher, in the ego LiDAR's frame.

    Attributes:
        clouds: per agent (P, 5) float32 x, y, z, intensity, paint; points on objects first.
        object_clouds: per agent (Q, 5) float32, points on objects alone.
        merged: (M, 4) float32 clouds of all agents, those of `further` ones last.
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
        inside: points of a box. With `hull` an agent without objects gets its whole cloud as object cloud, the released
            code's mistake; with `rotated` its object cloud is empty.
        dense: take the points on objects from all agents; else from the agent alone.
        paint: mark points on objects with 1 in the fifth column; else it is 0 everywhere.
        further: (P, 4) clouds, in the sample's frame, of agents that its student does not fuse: more points on objects.

    Returns:
        Clouds with row order: points on objects in the order of `merged`, then the agent's others in its order.
    """
    merged = np.concatenate([*sample.clouds, *further, np.zeros((0, 4), np.float32)])
    starts = np.cumsum([0] + [len(cloud) for cloud in sample.clouds])
    on_objects = _on_objects(merged, sample.agent_boxes, inside)
    clouds, object_clouds = [], []
    for agent, (boxes, on_object) in enumerate(zip(sample.agent_boxes, on_objects, strict=True)):
        own = slice(starts[agent], starts[agent + 1])
        if inside == "hull" and len(boxes) == 0:
            whole = _painted(sample.clouds[agent], 0.0)
            clouds.append(whole)
            object_clouds.append(whole)
            continue
        chosen = np.flatnonzero(on_object) if dense else starts[agent] + np.flatnonzero(on_object[own])
        others = starts[agent] + np.flatnonzero(~on_object[own])
        cloud = _painted(merged.take(np.concatenate([chosen, others]), axis=0), 0.0)
        cloud[: len(chosen), 4] = 1.0 if paint else 0.0
        clouds.append(cloud)
        object_clouds.append(cloud[: len(chosen)])
    return TeacherClouds(tuple(clouds), tuple(object_clouds), merged)


def _on_objects(points: NDArray[np.float32], agent_boxes: Sequence[Boxes], inside: Inside) -> NDArray[np.bool_]:
    """Return the (A, M) mask of points in one of each agent's boxes."""
    boxes = concatenate(list(agent_boxes))
    # Several agents know most objects.
    _, first, same = np.unique(boxes.array, axis=0, return_index=True, return_inverse=True)
    rows, owners = points_in_boxes(boxes[first], points, hull=inside == "hull")
    known = np.zeros((len(agent_boxes), len(first)), bool)
    known[np.repeat(np.arange(len(agent_boxes)), [len(own) for own in agent_boxes]), same.reshape(-1)] = True
    mask = np.zeros((len(agent_boxes), len(points)), bool)
    for agent in range(len(agent_boxes)):
        mask[agent, rows[known[agent, owners]]] = True
    return mask


def _painted(cloud: NDArray[np.float32], value: float) -> NDArray[np.float32]:
    return np.concatenate([cloud, np.full((len(cloud), 1), value, np.float32)], axis=1)
