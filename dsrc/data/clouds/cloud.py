"""Clouds of any source: a table of points to a sweep, and the corrupted sweep back to such a table.

Points that a corruption leaves as they are keep every column bit for bit; those that it moves or dims get new
coordinates and intensities; those that it adds get these, their ring, and zeros.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from sensors.corruptions.physics.receiver import DEFAULT_REFLECTIVITY
from sensors.corruptions.physics.rings import estimate_rings
from sensors.spec import LidarSpec
from sensors.sweep import ADDED, Sweep, make_sweep
from sim.errors import DataError, SettingsError, complaint

EIGHT_BIT = 255.0

_FIRST_ROW = ADDED - 1
"""`object_id` of the point of row 0 in the table, -1 for each row: no object, not added, and kept by corruptions."""


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Table of points, with the meaning of its columns.

    Attributes:
        table: (P,) structured array, one scalar field per column, sensor frame, m.
        axes: names of x, y, z.
        intensity: name of the intensity, None where unknown.
        ring: name of the beam index, counted from the top or from the bottom, None where unknown.
        full_scale: intensity that means 1; None takes 255 where one exceeds 1.
    """

    table: NDArray[np.void]
    axes: tuple[str, str, str] = ("x", "y", "z")
    intensity: str | None = None
    ring: str | None = None
    full_scale: float | None = None

    def __len__(self) -> int:
        return len(self.table)

    def sweep(self, spec: LidarSpec | None = None, on_vehicle: NDArray[np.bool_] | None = None) -> Sweep:
        """Return the points as a sweep whose ids lead back to the rows.

        Args:
            spec: the sensor, None if unknown; with it the points get rings, columns and firing times.
            on_vehicle: (P,) mask of points on vehicles, each of which becomes an object with the id of its row.

        Raises:
            DataError: an intensity or a ring is out of its range.
            SettingsError: the sensor has no rings to find.
        """
        points = np.stack([self.table[name] for name in self.axes], axis=1).astype(np.float32)
        row = np.arange(len(self))
        ids = _FIRST_ROW - row if on_vehicle is None else np.where(on_vehicle, row, _FIRST_ROW - row)
        columns: dict[str, Any] = {"intensity": self._unit(self.table), "object_id": ids}
        ring = self._ring_from_top(spec)
        if ring is None and spec is not None:
            ring = beams_of(points, spec)
        if ring is not None:
            columns["ring"] = ring
        if ring is not None and spec is not None and not spec.prisms and ring.max(initial=0) < spec.rings:
            columns["column"] = column = columns_of(points, ring, spec)
            columns["time_offset"] = spec.time_offset[ring, column]
        return make_sweep(points, spec=spec, **columns)

    def of(self, sweep: Sweep) -> NDArray[np.void]:
        """Return the table of a corrupted sweep that `sweep` has made."""
        row = rows_of(sweep)
        table, kept = np.zeros(len(row), self.table.dtype), row >= 0
        table[kept] = self.table[row[kept]]
        for axis, name in enumerate(self.axes):
            new = sweep.points[:, axis]
            _replace(table, name, ~kept | (table[name].astype(np.float32) != new), new)
        if self.intensity is not None:
            changed = ~kept | (self._unit(table) != sweep.intensity)
            _replace(table, self.intensity, changed, sweep.intensity * np.float64(self._scale))
        if self.ring is not None and not kept.all():
            top = self._from_bottom(sweep.spec)
            _replace(table, self.ring, ~kept, sweep.ring if top is None else top - sweep.ring)
        return table

    @property
    def _scale(self) -> float:
        if self.full_scale is not None or self.intensity is None or not len(self):
            return self.full_scale or 1.0
        return 1.0 if float(self.table[self.intensity].max()) <= 1.0 else EIGHT_BIT

    def _unit(self, table: NDArray[np.void]) -> NDArray[np.float32]:
        """Return the intensities of a table in [0, 1]; those of a dull surface where they are unknown."""
        if self.intensity is None:
            return np.full(len(table), DEFAULT_REFLECTIVITY, np.float32)
        return (table[self.intensity] / np.float64(self._scale)).astype(np.float32)

    def _ring_from_top(self, spec: LidarSpec | None) -> NDArray[np.int64] | None:
        """Return (P,) rings with 0 on top; None without a column of them."""
        if self.ring is None:
            return None
        ring = self.table[self.ring]
        most = np.iinfo(np.int16).max
        if len(ring) and not ((ring >= 0) & (ring <= most) & (ring == np.floor(ring))).all():
            expected = f"whole numbers from 0 to {most}"
            raise DataError(complaint("points", "ring", expected, f"{ring.min():g} to {ring.max():g}"))
        top = self._from_bottom(spec)
        return ring.astype(np.int64) if top is None else top - ring.astype(np.int64)

    def _from_bottom(self, spec: LidarSpec | None) -> int | None:
        """Return the number of the top ring where rings count from the bottom, else None."""
        if self.ring is None or len(self) == 0:
            return None
        ring = self.table[self.ring].astype(np.float64)
        x, y, z = (self.table[name].astype(np.float64) for name in self.axes)
        elevation = np.arctan2(z, np.hypot(x, y))
        rises = float(((ring - ring.mean()) * elevation).sum()) > 0.0
        return max(int(ring.max()), -1 if spec is None else spec.rings - 1) if rises else None


def rows_of(sweep: Sweep) -> NDArray[np.int64]:
    """Return (P,) the row in the table of each point of a sweep of `Cloud.sweep`, -1 for added points."""
    found = sweep.object_id.astype(np.int64)
    return np.where(found >= 0, found, np.where(found == ADDED, -1, _FIRST_ROW - found))


def beams_of(points: NDArray[np.floating], spec: LidarSpec) -> NDArray[np.int64]:
    """Return (P,) rings of points by their elevation: the rings found in them, matched to the sensor's beams.

    Where none can be found, as among a few points, each point has the nearest beam.

    Raises:
        SettingsError: the sensor is a scanner without rings.
    """
    if spec.prisms:
        expected = "a spinning sensor, or points with a column of rings"
        raise SettingsError(complaint("points", "sensor", expected, f"{spec.name}, which has no rings"))
    try:
        found = estimate_rings(points, spec.rings)
    except DataError:
        elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
        return np.abs(elevation[:, None] - spec.elevation).argmin(axis=1)
    # The best matching of sorted elevations keeps their order.
    _, beam = linear_sum_assignment(np.abs(found.elevation[:, None] - spec.elevation))
    return np.asarray(beam, np.int64)[found.ring]


def columns_of(points: NDArray[np.floating], ring: NDArray[np.integer], spec: LidarSpec) -> NDArray[np.int64]:
    """Return (P,) firings of points of known rings by their azimuth."""
    if spec.columns == 1:
        return np.zeros(len(points), np.int64)
    step = spec.azimuth[1] - spec.azimuth[0]
    turned = np.arctan2(points[:, 1], points[:, 0]) - spec.azimuth_offset[ring] - spec.azimuth[0]
    around = 2.0 * np.pi / abs(step)
    return np.rint((turned / step) % around).astype(np.int64) % spec.columns


def _replace(table: NDArray[np.void], name: str, rows: NDArray[np.bool_], values: NDArray[np.number]) -> None:
    """Set some rows of a column, rounded where it holds whole numbers."""
    kind = table[name].dtype
    new = values[rows]
    if kind.kind in "iu":
        new = np.clip(np.rint(new), np.iinfo(kind).min, np.iinfo(kind).max)
    table[name][rows] = new.astype(kind)
