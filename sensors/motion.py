"""Path: poses of moving bodies over the time of one sweep."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim.errors import DataError, complaint
from sim.geometry import pose_angles, pose_matrix, wrap_angle
from sim.traffic.base import Actors


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """K poses in time, of one body or of many that share the instants.

    Position and angles are interpolated linearly between the instants and constant outside.

    Attributes:
        time_s: (K,) float64 ascending, K >= 2, s.
        xyz: (..., K, 3) float64 positions in the world, m.
        angles: (..., K, 3) float64 yaw, pitch, roll, rad, unwrapped.

    Raises:
        DataError: fewer than two times, or times that do not ascend.
    """

    time_s: NDArray[np.float64]
    xyz: NDArray[np.float64]
    angles: NDArray[np.float64]

    def __post_init__(self) -> None:
        times = self.time_s
        if len(times) < 2 or not (times[1:] > times[:-1]).all():
            found = f"{len(times)}: {times.tolist()}"
            raise DataError(complaint("path", "time_s", "at least two ascending times", found))

    @classmethod
    def through(cls, time_s: ArrayLike, world_from_body: ArrayLike) -> Self:
        """Make the path through (..., K, 4, 4) poses at (K,) times."""
        poses = np.asarray(world_from_body, np.float64)
        angles = np.unwrap(np.stack(pose_angles(poses), axis=-1), axis=-2)
        return cls(np.asarray(time_s, np.float64), poses[..., :3, 3].copy(), angles)

    def __getitem__(self, rows: int | NDArray[np.integer] | NDArray[np.bool_]) -> Self:
        """Select bodies."""
        return type(self)(self.time_s, self.xyz[rows], self.angles[rows])

    def __len__(self) -> int:
        return len(self.xyz)

    def at(self, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (..., T, 4, 4) world_from_body at (T,) times."""
        knot = np.clip(np.searchsorted(self.time_s, time_s, side="right") - 1, 0, len(self.time_s) - 2)
        start, end = self.time_s[knot], self.time_s[knot + 1]
        share = np.clip((time_s - start) / (end - start), 0.0, 1.0)[:, None]
        xyz, angles = (
            (1.0 - share) * values[..., knot, :] + share * values[..., knot + 1, :]
            for values in (self.xyz, self.angles)
        )
        return pose_matrix(xyz, angles[..., 0], angles[..., 1], angles[..., 2])


def actor_paths(now: Actors, before: Actors | None = None, after: Actors | None = None, reach_s: float = 0.05) -> Path:
    """Return the paths of the N footprints of `now` through the instants before and after.

    An actor that is missing in the neighbouring instant is extrapolated at constant velocity, over `reach_s` where
    there is no neighbouring instant.
    """
    middle = _placement(now)
    times, tables = [now.time_s], [middle]
    for other, side in ((before, -1), (after, 1)):
        time_s = now.time_s + side * reach_s if other is None else other.time_s
        place = 0 if side < 0 else len(times)
        times.insert(place, time_s)
        tables.insert(place, _elsewhen(now, middle, other, time_s))
    stacked = np.stack(tables, axis=1)
    return Path(np.array(times), stacked[..., :3], stacked[..., 3:])


def _elsewhen(now: Actors, middle: NDArray[np.float64], other: Actors | None, time_s: float) -> NDArray[np.float64]:
    """Return (N, 6) placements of the actors of `now` at a neighbouring instant."""
    if other is not None and np.array_equal(now.boxes.object_id, other.boxes.object_id):
        table = _placement(other)
    else:
        table = middle.copy()
        table[:, :2] += now.velocity * (time_s - now.time_s)
        if other is not None:
            rows, found = _match(now, other)
            table[found] = _placement(other)[rows[found]]
    table[:, 3] = middle[:, 3] + wrap_angle(table[:, 3] - middle[:, 3])
    return table


def _placement(actors: Actors) -> NDArray[np.float64]:
    """Return (N, 6) rows x, y, z of the footprint's centre, yaw, pitch, roll."""
    table = np.zeros((len(actors), 6))
    table[:, :3] = actors.boxes.center
    table[:, 2] -= 0.5 * actors.boxes.size[:, 2]
    table[:, 3], table[:, 4], table[:, 5] = actors.boxes.yaw, actors.pitch, actors.roll
    return table


def _match(now: Actors, other: Actors) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return for each row of `now` its row in `other` and whether it is present."""
    ids, others = now.boxes.object_id, other.boxes.object_id
    if len(others) == 0:
        return np.zeros(len(ids), np.int64), np.zeros(len(ids), bool)
    rows = np.minimum(np.searchsorted(others, ids), len(others) - 1)
    return rows, others[rows] == ids
