"""The Traffic protocol and the table of actors that every backend yields."""

from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from sim.boxes import Boxes
from sim.geometry import pose_matrix

SIGNALS = {"right indicator": 1, "left indicator": 2, "hazard lights": 4, "brake light": 8}
"""Bits of `Actors.signals` by what is lit; SUMO sets others that nobody here reads."""

PARKED = "parked"
"""Names of actors that stand for the whole drive and never move begin so."""

POSITION_M, ANGLE_RAD, VELOCITY_MPS, ACCELERATION_MPS2, TIME_S = 1e-3, 1e-5, 1e-3, 1e-2, 1e-6
"""Steps to which traffic is rounded when it is recorded, so that a log of whole numbers replays it bit for bit."""


def lit(signals: int) -> tuple[str, ...]:
    """Return the names of what is lit, in the order of `SIGNALS`."""
    return tuple(name for name, bit in SIGNALS.items() if signals & bit)


@dataclass(frozen=True, slots=True, eq=False)
class Actors:
    """All actors at one instant, world frame, rows sorted by object id.

    Attributes:
        time_s: simulation time, s.
        boxes: N boxes (geometric centre); label, object id (>= 1000) and size included.
        pitch: (N,) float64 rad, positive lowers the front; boxes ignore it, bodies and sensors do not.
        velocity: (N, 2) float64 m/s in the world, from the motion of the box centre.
        acceleration: (N, 2) float64 m/s2 in the world, the change of `velocity` since the step before; zero for who has
            just appeared.
        model: (N,) names of body meshes, see `sim.bodies.choice`.
        name: (N,) names in the traffic simulation.
        signals: (N,) int32 bits of `SIGNALS`, as SUMO has them.
        lane: (N,) names of the lanes in the road network, "" off the road and for people who walk on none.
    """

    time_s: float
    boxes: Boxes
    pitch: NDArray[np.float64]
    velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    model: tuple[str, ...]
    name: tuple[str, ...]
    signals: NDArray[np.int32]
    lane: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.boxes)

    def world_from_body(self) -> NDArray[np.float64]:
        """Return (N, 4, 4) poses of the footprint centres at road level."""
        base = self.boxes.center.copy()
        base[:, 2] -= 0.5 * self.boxes.size[:, 2]
        return pose_matrix(base, self.boxes.yaw, self.pitch)

    def row(self, object_id: int) -> int:
        """Return the row of an object; KeyError when it is not on the road."""
        row = int(np.searchsorted(self.boxes.object_id, object_id))
        if row == len(self) or self.boxes.object_id[row] != object_id:
            raise KeyError(object_id)
        return row

    def parked(self) -> NDArray[np.bool_]:
        """Return (N,) which actors stand parked for the whole drive."""
        return np.array([name.startswith(PARKED) for name in self.name], bool)

    def joined(self, later: "Actors") -> "Actors":
        """Return these actors followed by others, whose ids are all higher, at the others' time."""
        ours, theirs = self.boxes, later.boxes
        return Actors(
            time_s=later.time_s,
            boxes=Boxes(
                center=np.concatenate([ours.center, theirs.center]),
                size=np.concatenate([ours.size, theirs.size]),
                yaw=np.concatenate([ours.yaw, theirs.yaw]),
                label=np.concatenate([ours.label, theirs.label]),
                object_id=np.concatenate([ours.object_id, theirs.object_id]),
            ),
            pitch=np.concatenate([self.pitch, later.pitch]),
            velocity=np.concatenate([self.velocity, later.velocity]),
            acceleration=np.concatenate([self.acceleration, later.acceleration]),
            model=self.model + later.model,
            name=self.name + later.name,
            signals=np.concatenate([self.signals, later.signals]),
            lane=self.lane + later.lane,
        )

    def rounded(self) -> Self:
        """Return the actors in whole steps of `POSITION_M` and the like; rounding again changes no bit.

        Raises:
            ValueError: a value is not finite.
        """
        boxes = replace(
            self.boxes,
            center=snapped(self.boxes.center, POSITION_M),
            size=snapped(self.boxes.size, POSITION_M),
            yaw=snapped(self.boxes.yaw, ANGLE_RAD),
        )
        return replace(
            self,
            time_s=float(snapped(np.float64(self.time_s), TIME_S)),
            boxes=boxes,
            pitch=snapped(self.pitch, ANGLE_RAD),
            velocity=snapped(self.velocity, VELOCITY_MPS),
            acceleration=snapped(self.acceleration, ACCELERATION_MPS2),
        )


def snapped(values: NDArray[np.float64] | np.float64, step: float) -> NDArray[np.float64]:
    """Round to whole steps; ValueError for values that are not finite."""
    return from_steps(in_steps(values, step), step)


def in_steps(values: NDArray[np.float64] | np.float64, step: float) -> NDArray[np.int64]:
    """Return how many whole steps values are, rounded; ValueError for values that are not finite."""
    if not np.isfinite(values).all():
        raise ValueError("a position, angle, speed or acceleration in the traffic is not finite")
    return np.rint(np.asarray(values, np.float64) * round(1.0 / step)).astype(np.int64)


def from_steps(count: NDArray[np.int64], step: float) -> NDArray[np.float64]:
    """Return the values of whole steps: the float next to the decimal number."""
    return count / np.float64(round(1.0 / step))


class Traffic(Protocol):
    """A traffic backend: a context manager that moves all actors in steps of `step_s`."""

    step_s: float

    @property
    def actors(self) -> Actors:
        """The actors at the current time."""
        ...

    def step(self) -> Actors:
        """Advance by `step_s` and return the actors then."""
        ...

    def close(self) -> None:
        """End the simulation; further steps are an error."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(self, *exc: object) -> None: ...
