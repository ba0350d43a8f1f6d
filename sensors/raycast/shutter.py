"""Rolling shutter: where a sensor is when its beams fire, in the world and as bodies that move see it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sensors.beams import BLOCK
from sensors.raycast.base import Bodies, Shot
from sim.geometry import pose_matrix

_STEP_S = 1e-3
"""Poses run straight for at most so long: a body that turns at 3 rad/s is then true to 0.05 mm at 50 m."""

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Where a sensor is when the beams of c columns fire, in some frame.

    Attributes:
        start: (3, 4, c) float32 pose when share 0 of the column has passed.
        step: (3, 4, c) float32 its change over the column; None where all beams fire at `start`.
    """

    start: Floats
    step: Floats | None

    def at(self, share: Floats, columns: slice = slice(None)) -> Floats:
        """Return (3, 4, 1 or r, c) poses of some columns when (r,) shares of them have passed."""
        start = self.start[:, :, None, columns]
        return start if self.step is None else start + share[:, None] * self.step[:, :, None, columns]


class Shutter:
    """The time of one sweep, in columns since its start.

    Attributes:
        border: (K,) float64 moments between which poses run straight: borders of blocks, parts of long ones, and the
            knots of the bodies' path.
        segment: (C,) the border before each column.
    """

    def __init__(self, shot: Shot, knots_s: NDArray[np.float64]) -> None:
        """Prepare a sweep among bodies whose path has knots at (K,) times."""
        share, columns, column_s = shot.beams.firing_share, shot.beams.columns, shot.spec.column_s
        self._shot = shot
        self._together = bool((share == share[0]).all())
        parts = max(1, int(np.ceil(BLOCK * column_s / _STEP_S)))
        borders = np.linspace(0.0, float(shot.beams.blocks * BLOCK), shot.beams.blocks * parts + 1)
        if column_s > 0.0:
            knots = (knots_s - shot.time_s) / column_s + 0.5 * columns
            borders = np.sort(np.concatenate([borders, knots[(knots > 0.0) & (knots < borders[-1])]]))
        fired = np.arange(columns) + (float(share[0]) if self._together else 0.0)
        self.border = borders
        self.segment: NDArray[np.int64] = np.searchsorted(borders, fired, "right") - 1
        length = np.diff(borders)[self.segment]
        self._past_border: Floats = ((fired - borders[self.segment]) / length).astype(np.float32)
        self._per_column: Floats = (1.0 / length).astype(np.float32)

    def sensor(self, column: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (N, 3, 4) world_from_lidar at (N,) moments."""
        knots = self._shot.knots
        block = np.clip(column // BLOCK, 0, len(knots) - 2).astype(np.int64)
        share = (column / BLOCK - block)[:, None, None]
        return knots[block] + share * (knots[block + 1] - knots[block])

    def time_s(self, column: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the times of moments."""
        shot = self._shot
        return shot.time_s + (column - 0.5 * shot.beams.columns) * shot.spec.column_s

    def body_from_lidar(
        self, bodies: Bodies, rows: NDArray[np.int64], column: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return (N, 3, 4) body_from_lidar of (N,) bodies, each at its own of (N,) moments."""
        path, time_s = bodies.path, self.time_s(column)
        knot = np.clip(np.searchsorted(path.time_s, time_s, side="right") - 1, 0, len(path.time_s) - 2)
        start, end = path.time_s[knot], path.time_s[knot + 1]
        share = np.clip((time_s - start) / (end - start), 0.0, 1.0)[:, None]
        xyz, angles = (
            (1.0 - share) * values[rows, knot] + share * values[rows, knot + 1] for values in (path.xyz, path.angles)
        )
        rotation = pose_matrix(xyz, angles[:, 0], angles[:, 1], angles[:, 2])[:, :3, :3]
        sensor = self.sensor(column)
        sensor[:, :, 3] -= xyz
        return np.swapaxes(rotation, 1, 2) @ sensor

    def motion(
        self, poses: NDArray[np.float64], row: NDArray[np.int64], columns: NDArray[np.int64] | slice = slice(None)
    ) -> Motion:
        """Return the motion over c columns.

        Args:
            poses: (N, 3, 4) at borders.
            row: (c,) row in `poses` of the border before each column; that of the border after it is the next.
            columns: which.
        """
        table = np.ascontiguousarray(poses.transpose(1, 2, 0), dtype=np.float32)
        start, change = table.take(row, axis=2), np.diff(table).take(row, axis=2)
        start += self._past_border[columns] * change
        if self._together:
            return Motion(start, None)
        change *= self._per_column[columns]
        return Motion(start, change)
