"""Message of an agent: the objects that it tells of, where it says that it is, and what it sees."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.seen_space import View
from sim.boxes import Boxes
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


def near_any(boxes: Boxes, others: Boxes, least_m: float = SAME_M) -> NDArray[np.bool_]:
    """Return (N,) whether another box has its centre within `least_m`, or half the length of the longer one."""
    if not len(boxes) or not len(others):
        return np.zeros(len(boxes), bool)
    distance = np.linalg.norm(boxes.center[:, None, :2] - others.center[None, :, :2], axis=2)
    longer = np.maximum(boxes.size[:, None, 0], others.size[None, :, 0])
    return np.asarray((distance <= np.maximum(least_m, 0.5 * longer)).any(axis=1))
