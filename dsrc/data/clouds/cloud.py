"""Clouds of any source: a table of points to a sweep, and the corrupted sweep back to such a table.

Points that a corruption leaves as they are keep every column bit for bit; those that it moves or dims get new
coordinates and intensities; those that it adds get these, their ring, and zeros. Rows without a return, at the origin
or not finite, are no points: they stay in the table where they are.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsrc.data.clouds.columns import FARTHEST_M, has_return, meaning
from dsrc.data.clouds.intensity import Intensities, Scale, from_unit, to_unit
from sensors.corruptions.physics.receiver import DEFAULT_REFLECTIVITY
from sensors.corruptions.physics.rings import estimate_rings
from sensors.spec import LidarSpec
from sensors.sweep import ADDED, Sweep, make_sweep
from sim.errors import DataError, SettingsError, complaint

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
        scale: of the intensity; None finds it in the table, see `Intensities`.
    """

    table: NDArray[np.void]
    axes: tuple[str, str, str] = ("x", "y", "z")
    intensity: str | None = None
    ring: str | None = None
    scale: Scale | None = None

    @classmethod
    def named(cls, where: Path | str, table: NDArray[np.void], scale: Scale | None = None) -> "Cloud":
        """Return the cloud of a table by the names of its fields.

        Raises:
            DataError: a coordinate is missing; or it, the intensity or the ring is no number, or several.
        """
        axes, intensity, ring = meaning(where, table.dtype.names or ())
        for name in filter(None, (*axes, intensity, ring)):
            kind = table.dtype[name]
            if kind.shape:
                raise DataError(complaint(where, f"COUNT of {name}", "1", math.prod(kind.shape)))
            if kind.kind not in "fiu":
                raise DataError(complaint(where, f"type of {name}", "a number", str(kind)))
        return cls(table, axes, intensity, ring, scale)

    def __len__(self) -> int:
        return len(self.table)

    @property
    def returns(self) -> NDArray[np.bool_]:
        """(P,) mask of the rows that are points."""
        return has_return(np.stack([self.table[name] for name in self.axes], axis=1))

    def sweep(self, spec: LidarSpec | None = None, on_vehicle: NDArray[np.bool_] | None = None) -> Sweep:
        """Return the points as a sweep whose ids lead back to the rows.

        Args:
            spec: the sensor, None if unknown; with it the points get rings, columns and firing times.
            on_vehicle: (P,) mask of points on vehicles, each of which becomes an object with the id of its row.

        Raises:
            DataError: an intensity or a ring is out of its range, the intensities' scale cannot be found, or most
                points are so far away that they are in coordinates of a map.
            SettingsError: the sensor has no rings to find.
        """
        row = np.flatnonzero(self.returns)
        table = self.table[row]
        with np.errstate(over="ignore"):  # what is beyond float32 is refused where points are corrupted
            points = np.stack([table[name] for name in self.axes], axis=1).astype(np.float32)
        reach = np.abs(points).max(axis=1, initial=0.0)
        if 2 * len(far := np.flatnonzero((reach > FARTHEST_M) & (reach < np.inf))) > len(points):
            hint = "; points are in the sensor's frame: subtract its place from those of a map"
            found = " ".join(f"{value:g}" for value in points[far[0]].tolist())
            raise DataError(complaint("points", "x y z", f"at most {FARTHEST_M:g} m", found, hint))
        ids = _FIRST_ROW - row if on_vehicle is None else np.where(on_vehicle[row], row, _FIRST_ROW - row)
        columns: dict[str, Any] = {"intensity": self._unit(self._scale)[row], "object_id": ids}
        ring = self._ring_from_top(table, spec)
        if ring is None and spec is not None:
            ring = beams_of(points, spec)
        if ring is not None:
            columns["ring"] = ring
        if ring is not None and spec is not None and not spec.prisms and ring.max(initial=0) < spec.rings:
            columns["column"] = column = columns_of(points, ring, spec)
            columns["time_offset"] = spec.time_offset[ring, column]
        return make_sweep(points, spec=spec, **columns)

    def of(self, sweep: Sweep) -> NDArray[np.void]:
        """Return the (Q,) table of a corrupted sweep that `sweep` has made; `rows` tells where its rows are from."""
        row, order = self._order(sweep)
        table, points = np.zeros(len(row), self.table.dtype), slice(len(sweep))
        kept = row >= 0
        table[kept] = self.table[row[kept]]
        new, kept = table[points], kept[points]
        for axis, name in enumerate(self.axes):
            there = sweep.points[:, axis]
            _replace(new, name, ~kept | (new[name].astype(np.float32) != there), there)
        if self.intensity is not None and len(self):
            scale = self._scale
            changed = ~kept | (self._unit(scale)[row[points]] != sweep.intensity)
            _replace(new, self.intensity, changed, from_unit(sweep.intensity, scale))
        if self.ring is not None and not kept.all():
            top = self._from_bottom(self.table[self.returns], sweep.spec)
            _replace(new, self.ring, ~kept, sweep.ring if top is None else top - sweep.ring)
        return table[order]

    def rows(self, sweep: Sweep) -> NDArray[np.int64]:
        """Return (Q,) the row in the table of each row of `of(sweep)`, -1 for added points."""
        row, order = self._order(sweep)
        return row[order]

    def _order(self, sweep: Sweep) -> tuple[NDArray[np.int64], NDArray[np.intp]]:
        """Return the rows of the points of a sweep, then those without a return; and their order by the rows."""
        found, silent = rows_of(sweep), np.flatnonzero(~self.returns)
        # An added point comes before the kept one that it precedes in the sweep, else at the end of all.
        place = np.minimum.accumulate(np.where(found >= 0, found, len(self))[::-1])[::-1]
        return np.concatenate([found, silent]), np.argsort(np.concatenate([place, silent]), kind="stable")

    @property
    def _scale(self) -> Scale:
        if self.scale is not None or self.intensity is None:
            return self.scale or 1.0
        return Intensities.of(self.table[self.intensity][self.returns], "points").scale("points")

    def _unit(self, scale: Scale) -> NDArray[np.float32]:
        """Return the (P,) intensities in [0, 1]; those of a dull surface where they are unknown."""
        if self.intensity is None:
            return np.full(len(self), DEFAULT_REFLECTIVITY, np.float32)
        return to_unit(self.table[self.intensity], scale)

    def _ring_from_top(self, table: NDArray[np.void], spec: LidarSpec | None) -> NDArray[np.int64] | None:
        """Return (P,) rings of a table with 0 on top; None without a column of them."""
        if self.ring is None:
            return None
        ring = table[self.ring]
        most = np.iinfo(np.int16).max
        if len(ring) and not ((ring >= 0) & (ring <= most) & (ring == np.floor(ring))).all():
            expected = f"whole numbers from 0 to {most}"
            raise DataError(complaint("points", "ring", expected, f"{ring.min():g} to {ring.max():g}"))
        top = self._from_bottom(table, spec)
        return ring.astype(np.int64) if top is None else top - ring.astype(np.int64)

    def _from_bottom(self, table: NDArray[np.void], spec: LidarSpec | None) -> int | None:
        """Return the number of the top ring where rings of a table count from the bottom, else None."""
        if self.ring is None or len(table) == 0:
            return None
        ring = table[self.ring].astype(np.float64)
        x, y, z = (table[name].astype(np.float64) for name in self.axes)
        elevation = np.arctan2(z, np.hypot(x, y))
        rises = float(((ring - ring.mean()) * elevation).sum()) > 0.0
        return max(int(ring.max()), -1 if spec is None else spec.rings - 1) if rises else None


def rows_of(sweep: Sweep) -> NDArray[np.int64]:
    """Return (P,) the row in the table of each point of a sweep of `Cloud.sweep`, -1 for added points.

    Rows without a return are in no sweep; `Cloud.rows` has them too.
    """
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
    from scipy.optimize import linear_sum_assignment  # half a second, and few clouds lack a beam

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
