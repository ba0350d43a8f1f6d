"""Message of an agent: the objects that it tells of, where it says that it is, and what it sees."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from dsrc.data.sample import SampleDetector
from dsrc.messages.seen_space import View
from dsrc.models.settings import fusion_of
from dsrc.ops.detections import Detections
from sensors.frame import Frame
from sim.boxes import CLASSES, VEHICLES, Boxes
from sim.geometry import invert
from sim.rows import Rows

SAME_M = 2.0
"""Largest distance of the centres of two boxes of one object, m; half the length of a longer one."""


@dataclass(frozen=True, slots=True, eq=False)
class Objects(Rows):
    """Objects of a message, world frame.

    Attributes:
        boxes: N boxes.
        score: (N,) confidence, 0 to 1.
        velocity: (N, 2) m/s; NaN where it is not measured.
    """

    boxes: Boxes
    score: NDArray[np.float64]
    velocity: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """What an agent tells at one instant.

    Attributes:
        sender: id of the agent.
        time_s: instant that it is said to be of, s.
        pose: (4, 4) world from agent, where it says that it is.
        objects: of which it tells.
        view: makes its seen space.
        attacked: whether an attack changed it; the truth, for the record: no defence reads it.
        false: (N,) objects that an attack put where none is, likewise.
    """

    sender: int
    time_s: float
    pose: NDArray[np.float64]
    objects: Objects
    view: Callable[[], View]
    attacked: bool
    false: NDArray[np.bool_]

    @classmethod
    def honest(
        cls, sender: int, time_s: float, pose: NDArray[np.float64], objects: Objects, view: Callable[[], View]
    ) -> "Message":
        """Return a message that nobody changed."""
        return cls(sender, time_s, pose, objects, view, False, np.zeros(len(objects), bool))


@dataclass(frozen=True, slots=True)
class Told:
    """What became of a helper's message, in episodes with an attack or a defence.

    Attributes:
        sender: id of the helper.
        objects: number of those that it tells of.
        false: of these, those that an attack put where none is.
        refused: of the objects, those that the ego refused.
        false_refused: of the false ones, likewise.
        attacked: whether an attack changed the message.
    """

    sender: int
    objects: int
    false: int
    refused: int
    false_refused: int
    attacked: bool


LIES = ("false_told", "false_refused", "true_refused", "helpers_honest", "helpers_wronged")
"""Names of the numbers of `lie_counts`."""


def lie_counts(told: Sequence[Told]) -> tuple[int, ...]:
    """Return what became of messages: `LIES`.

    They are objects that an attack put where none is, those of them that were refused, other objects that were refused,
    helpers whose messages no attack changed, and those of them of whom something was refused.
    """
    liars = {one.sender for one in told if one.attacked}
    honest = {one.sender for one in told} - liars
    wronged = {one.sender for one in told if one.refused} & honest
    false, caught = sum(one.false for one in told), sum(one.false_refused for one in told)
    return false, caught, sum(one.refused for one in told) - caught, len(honest), len(wronged)


def near_pairs(boxes: Boxes, others: Boxes, least_m: float = SAME_M) -> NDArray[np.bool_]:
    """Return (N, M) whether two boxes have centres within `least_m`, or half the length of the longer one."""
    distance = np.linalg.norm(boxes.center[:, None, :2] - others.center[None, :, :2], axis=2)
    longer = np.maximum(boxes.size[:, None, 0], others.size[None, :, 0])
    return np.asarray(distance <= np.maximum(least_m, 0.5 * longer))


def near_any(boxes: Boxes, others: Boxes, least_m: float = SAME_M) -> NDArray[np.bool_]:
    """Return (N,) whether another box is near, see `near_pairs`."""
    return np.asarray(near_pairs(boxes, others, least_m).any(axis=1))


def tells_boxes(detector: SampleDetector) -> bool:
    """Whether each agent detects alone and tells boxes."""
    return hasattr(detector, "detect_each") and fusion_of(detector.settings) == "late"


def counted_in(frame: Frame, row: int, detector: SampleDetector) -> Boxes:
    """Return the road users by which the message of an agent that tells boxes is sized: those that it has points on."""
    classes = getattr(detector, "classes", VEHICLES)
    known = np.isin(frame.truth.label, [CLASSES.index(name) for name in classes])
    return frame.truth[known & (frame.points_on[row] >= 1)]


def as_objects(found: Detections, world_from_sample: NDArray[np.float64]) -> Objects:
    """Return detections in a sample's frame as objects in the world, without velocities."""
    boxes = found.boxes.transform(world_from_sample)
    return Objects(boxes, found.score.astype(np.float64), np.full((len(boxes), 2), np.nan))


def as_detections(objects: Objects, world_from_sample: NDArray[np.float64]) -> Detections:
    """Return objects in the world as detections in a sample's frame."""
    return Detections(objects.boxes.transform(invert(world_from_sample)), objects.score.astype(np.float32))


def told_of(
    parts: Sequence[Detections],
    senders: Sequence[tuple[int, Frame, NDArray[np.float64]]],
    world_from_sample: NDArray[np.float64],
) -> list[Message]:
    """Return the honest messages of agents, each of what it detects.

    Args:
        parts: detections of each, in the sample's frame.
        senders: id of each, the frame that it measured in, and its believed (4, 4) world_from_lidar.
    """
    return [
        Message.honest(
            agent, frame.time_s, pose, as_objects(part, world_from_sample), partial(View.of, frame.agent(agent), pose)
        )
        for (agent, frame, pose), part in zip(senders, parts, strict=True)
    ]
