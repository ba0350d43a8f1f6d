"""Motion that an ego drove, and the other road users around it, as a log has them."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.log import EpisodeLog
from sim.boxes import Boxes, concatenate
from sim.rows import Rows
from sim.traffic.base import Actors


@dataclass(frozen=True, slots=True, eq=False)
class Motion(Rows):
    """Ground truth of the ego over T steps before its first contact.

    A crash changes speeds at once; what it does to them is no driving.

    Attributes:
        boxes: T boxes, world frame.
        time_s: (T,) s.
        velocity: (T, 2) m/s.
        acceleration: (T, 2) m/s2, world frame.
        actors: T tables of all road users.
        ego_id: object id of the ego.
    """

    SHARED: ClassVar = ("ego_id",)

    boxes: Boxes
    time_s: NDArray[np.float64]
    velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    actors: tuple[Actors, ...]
    ego_id: int

    @classmethod
    def of(cls, log: EpisodeLog) -> "Motion":
        """Return the motion of the ego of a log, without the steps from a contact on or after it left the traffic."""
        ego_id, rows, actors = log.settings.ego_id, [], []
        for tick in log.ticks:
            if tick.contact is not None or ego_id not in tick.actors.boxes.object_id:
                break
            rows.append(tick.actors.row(ego_id))
            actors.append(tick.actors)
        pairs = list(zip(actors, rows, strict=True))
        return cls(
            boxes=concatenate([one.boxes[row : row + 1] for one, row in pairs]),
            time_s=np.array([one.time_s for one in actors], np.float64),
            velocity=np.array([one.velocity[row] for one, row in pairs], np.float64).reshape(-1, 2),
            acceleration=np.array([one.acceleration[row] for one, row in pairs], np.float64).reshape(-1, 2),
            actors=tuple(actors),
            ego_id=ego_id,
        )

    @property
    def speed_mps(self) -> NDArray[np.float64]:
        """(T,) speed, m/s."""
        return np.asarray(np.linalg.norm(self.velocity, axis=1), np.float64)

    def others(self, step: int) -> tuple[Boxes, NDArray[np.float64]]:
        """Return boxes and (N, 2) velocities of the other road users at a step, m/s."""
        actors = self.actors[step]
        other = actors.boxes.object_id != self.ego_id
        return actors.boxes[other], actors.velocity[other]

    def tracks(self) -> dict[int, tuple[NDArray[np.int64], Boxes]]:
        """Return the steps and the boxes at these steps of every other road user, by object id."""
        every = concatenate([actors.boxes for actors in self.actors])
        step = np.repeat(np.arange(len(self.actors)), [len(actors) for actors in self.actors])
        order = np.argsort(every.object_id, kind="stable")
        ids, first = np.unique(every.object_id[order], return_index=True)
        rows = np.split(order, first[1:])
        return {int(i): (step[own], every[own]) for i, own in zip(ids, rows, strict=False) if i != self.ego_id}
