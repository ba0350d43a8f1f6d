"""Sweep: the points of one rotation of one LiDAR."""

from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from sensors.spec import LidarSpec
from sim.geometry import transform_points

STATIC = -1
"""`object_id` of points on the static world."""
ADDED = -2
"""`object_id` of points that no surface returned: a corruption made them."""

KEPT, ATTENUATED, MOVED, SCATTERED = range(4)
"""Values of `fate`: untouched, dimmer, displaced, or a return that a corruption put there instead or in addition."""


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """One rotation of one LiDAR; P points in the sensor frame at `time_s` (x forward, y left, z up).

    Attributes:
        points: (P, 3) float32, m.
        intensity: (P,) float32 in [0, 1].
        ring: (P,) int16 beam index, 0 = highest elevation.
        column: (P,) int32 firing index within the rotation.
        time_offset: (P,) float32 firing time minus `time_s`, s.
        object_id: (P,) int32 actor hit, `STATIC` or `ADDED`.
        return_number: (P,) uint8, 1 = first.
        fate: (P,) uint8, what a corruption did to the point: `KEPT`, `ATTENUATED`, `MOVED`, `SCATTERED`.
        world_from_lidar: (4, 4) float64 pose of the sensor at `time_s`.
        time_s: reference time of the sweep, s.
        spec: the sensor, None when a file does not say.
    """

    points: NDArray[np.float32]
    intensity: NDArray[np.float32]
    ring: NDArray[np.int16]
    column: NDArray[np.int32]
    time_offset: NDArray[np.float32]
    object_id: NDArray[np.int32]
    return_number: NDArray[np.uint8]
    fate: NDArray[np.uint8]
    world_from_lidar: NDArray[np.float64]
    time_s: float
    spec: LidarSpec | None = None

    def __post_init__(self) -> None:
        n = len(self.points)
        if self.points.shape != (n, 3):
            raise ValueError(f"Sweep.points must have shape (P, 3), got {self.points.shape}")
        for name in POINT_FIELDS[1:]:
            if getattr(self, name).shape != (n,):
                raise ValueError(f"Sweep.{name} must have shape ({n},), got {getattr(self, name).shape}")

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: NDArray[np.bool_] | NDArray[np.integer] | slice) -> Self:
        """Select points by a mask, indices or a slice."""
        return replace(self, **{name: getattr(self, name)[rows] for name in POINT_FIELDS})

    @property
    def range(self) -> NDArray[np.float32]:
        """(P,) distance from the sensor, m."""
        return np.linalg.norm(self.points, axis=1)

    @property
    def world_points(self) -> NDArray[np.float64]:
        """(P, 3) points in the world frame, m."""
        return np.asarray(transform_points(self.world_from_lidar, self.points.astype(np.float64)))


POINT_FIELDS = tuple(f.name for f in fields(Sweep))[:8]
"""The fields of `Sweep` that have one row per point, `points` first."""


def make_sweep(
    points: NDArray[np.floating],
    world_from_lidar: NDArray[np.float64] | None = None,
    time_s: float = 0.0,
    spec: LidarSpec | None = None,
    **columns: NDArray,
) -> Sweep:
    """Make a sweep from (P, 3) points; columns left out are zero, or `STATIC` for the object."""
    n = len(points)
    dtypes = {
        "intensity": np.float32,
        "ring": np.int16,
        "column": np.int32,
        "time_offset": np.float32,
        "object_id": np.int32,
        "return_number": np.uint8,
        "fate": np.uint8,
    }
    defaults = {"object_id": STATIC, "return_number": 1}
    unknown = set(columns) - set(dtypes)
    if unknown:
        raise TypeError(f"unknown sweep columns: {sorted(unknown)}")
    filled = {
        name: np.asarray(columns[name], dtype) if name in columns else np.full(n, defaults.get(name, 0), dtype)
        for name, dtype in dtypes.items()
    }
    pose = np.eye(4) if world_from_lidar is None else np.asarray(world_from_lidar, np.float64)
    return Sweep(
        points=np.asarray(points, np.float32).reshape(n, 3),
        world_from_lidar=pose,
        time_s=time_s,
        spec=spec,
        **filled,
    )


def concatenate(sweep: Sweep, *others: Sweep) -> Sweep:
    """Append the points of other sweeps of the same sensor and instant."""
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(s, name) for s in (sweep, *others)]) for name in POINT_FIELDS
    }
    return replace(sweep, **columns)
