"""Sweep: points of one rotation of one LiDAR."""

from dataclasses import dataclass, fields
from typing import Any, ClassVar, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from sensors.motion import Path
from sensors.spec import LidarSpec
from sim.errors import DataError, complaint
from sim.geometry import invert, transform_points
from sim.rows import Rows

Motion = Literal["middle", "start", "end", "raw"]
"""Compensation of the sensor's own motion: all points in the sensor frame at the middle, start or end of the sweep, or
raw, not compensated: each point in the sensor frame at its own firing."""
MOTIONS: tuple[Motion, ...] = get_args(Motion)

STATIC = -1
"""`object_id` of points on the static world."""
ADDED = -2
"""`object_id` of false points, added by a corruption."""

UNKNOWN_MATERIAL = 255
"""`material` of points whose file or corruption gives none."""

_SLACK_S = 1e-6
"""Tolerance beyond the ends of a path: firing times are float32."""

KEPT, ATTENUATED, MOVED, SCATTERED = range(4)
"""Values of `fate`: untouched, dimmer, displaced, or a false return in place of a true one or beside it."""


@dataclass(frozen=True, slots=True, eq=False)
class Sweep(Rows):
    """One rotation of one LiDAR; P points in the sensor frame at `time_s` (x forward, y left, z up).

    Raw points (see `motion`) are in the sensor frame at `time_s + time_offset` instead, each in its own.

    Attributes:
        points: (P, 3) float32, m.
        intensity: (P,) float32 in [0, 1].
        ring: (P,) int16 beam index, 0 = highest elevation.
        column: (P,) int32 firing index within the rotation.
        time_offset: (P,) float32 firing time minus `time_s`, s.
        object_id: (P,) int32 actor hit, `STATIC` or `ADDED`.
        return_number: (P,) uint8, 1 = the nearest of those that the beam reports.
        fate: (P,) uint8 effect of corruptions on the point: `KEPT`, `ATTENUATED`, `MOVED`, `SCATTERED`.
        material: (P,) uint8 index into `sim.mesh.materials.MATERIALS`, `UNKNOWN_MATERIAL` where unknown.
        cosine: (P,) float32 cosine of the angle between ray and surface normal, from 0 to 1; 0 where unknown.
        world_from_lidar: (4, 4) float64 pose of the sensor at `time_s`.
        time_s: reference time of the sweep, s: its middle unless `motion` says start or end.
        spec: the sensor, None where unknown.
        path: true world_from_lidar over the sweep, None where unknown.
        motion: compensation of the sensor's motion; `sensors.deskew` changes it.
        lost: number of surface points that corruptions removed from the whole sweep; selecting points keeps it.
    """

    SHARED: ClassVar = ("world_from_lidar", "time_s", "spec", "path", "motion", "lost")

    points: NDArray[np.float32]
    intensity: NDArray[np.float32]
    ring: NDArray[np.int16]
    column: NDArray[np.int32]
    time_offset: NDArray[np.float32]
    object_id: NDArray[np.int32]
    return_number: NDArray[np.uint8]
    fate: NDArray[np.uint8]
    material: NDArray[np.uint8]
    cosine: NDArray[np.float32]
    world_from_lidar: NDArray[np.float64]
    time_s: float
    spec: LidarSpec | None = None
    path: Path | None = None
    motion: Motion = "middle"
    lost: int = 0

    def __post_init__(self) -> None:
        n = len(self.points)
        if self.points.shape != (n, 3):
            raise ValueError(f"Sweep.points must have shape (P, 3), got {self.points.shape}")
        for name in POINT_FIELDS[1:]:
            if getattr(self, name).shape != (n,):
                raise ValueError(f"Sweep.{name} must have shape ({n},), got {getattr(self, name).shape}")

    @property
    def range(self) -> NDArray[np.float32]:
        """(P,) distance from the sensor, m."""
        return np.linalg.norm(self.points, axis=1)

    @property
    def world_points(self) -> NDArray[np.float64]:
        """(P, 3) points in the world frame, m, each where its beam hit at its firing.

        Raises:
            DataError: the points are raw and the sensor's path is unknown.
        """
        return np.asarray(transform_points(self.world_from_lidar, self.compensated_points))

    @property
    def compensated_points(self) -> NDArray[np.float64]:
        """(P, 3) points in the sensor frame at `time_s`, raw ones too; raises as `world_points`."""
        points = self.points.astype(np.float64)
        if self.motion != "raw":
            return points
        poses, row = firing_poses(self)
        return moved(poses[row], points)


POINT_FIELDS = tuple(f.name for f in fields(Sweep))[:10]
"""The fields of `Sweep` that have one row per point, `points` first."""


def firing_poses(sweep: Sweep) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Return (T, 4, 4) reference_from_sensor at each firing time and (P,) the row of each point.

    Only the relative motion is taken from the path, so it serves a pose estimate with an error as well.

    Raises:
        DataError: the path is unknown or shorter than the sweep, or a firing time is not finite.
    """
    path = path_of(sweep)
    times, row = firing_times(sweep)
    return invert(path_at(path, np.array([sweep.time_s]))) @ path_at(path, times), row


def firing_times(sweep: Sweep) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Return (T,) distinct firing times, s, ascending, and (P,) the row of each point.

    Raises:
        DataError: firing times are not finite, or all equal although the columns fire one after another.
    """
    if not np.isfinite(sweep.time_offset).all():
        raise DataError(complaint("sweep", "time_offset", "finite firing times", "nan or inf"))
    if len(sweep) > 1 and not sweep.time_offset.any() and not _fires_at_once(sweep):
        raise DataError(complaint("sweep", "time_offset", "a firing time of each point", "none: all are 0"))
    offset, row = np.unique(sweep.time_offset, return_inverse=True)
    return sweep.time_s + offset.astype(np.float64), row


def _fires_at_once(sweep: Sweep) -> bool:
    """Return whether the sensor fires all points at the reference time."""
    spec = sweep.spec
    return spec is not None and not spec.time_offset[sweep.ring % spec.rings, sweep.column % spec.columns].any()


def path_of(sweep: Sweep) -> Path:
    """Return the sensor's path; DataError where unknown."""
    if sweep.path is None:
        raise DataError(complaint("sweep", "path", "the sensor's poses over the sweep", "none"))
    return sweep.path


def path_at(path: Path, time_s: NDArray[np.float64], whose: str = "sweep") -> NDArray[np.float64]:
    """Return (T, 4, 4) poses as `Path.at`; DataError for times outside the path of `whose`."""
    first, last = path.time_s[[0, -1]]
    if len(time_s) and not (first - _SLACK_S <= time_s.min() and time_s.max() <= last + _SLACK_S):
        expected = f"poses from {time_s.min():.6f} to {time_s.max():.6f} s"
        raise DataError(complaint(whose, "path", expected, f"those from {first:.6f} to {last:.6f} s"))
    return path.at(time_s)


def moved(transform: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Map (P, 3) points by (P, 4, 4) transforms, one each."""
    return np.einsum("pij,pj->pi", transform[:, :3, :3], points) + transform[:, :3, 3]


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
        "material": np.uint8,
        "cosine": np.float32,
    }
    defaults = {"object_id": STATIC, "return_number": 1, "material": UNKNOWN_MATERIAL}
    unknown = set(columns) - set(dtypes)
    if unknown:
        raise TypeError(f"unknown sweep columns: {sorted(unknown)}")
    filled: dict[str, Any] = {
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
