"""Columns of clouds: their names, and whether the values of a file without names fit them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dsrc.data.formats.pcd import unpadded
from sim.errors import DataError, SettingsError, complaint, option

KITTI = ("x", "y", "z", "intensity")
NUSCENES = (*KITTI, "ring")

_INTENSITY = ("intensity", "reflectivity", "reflectance", "remission", "scalar_intensity", "i")
_RING = ("ring", "laser_id", "channel", "scalar_ring")
FARTHEST_M = 1e4
"""Farthest coordinate; a time stamp or the bits of a whole number are beyond, or are no number at all."""
_NEAR_M, _NEAR_SHARE, _SCENE_M = 2.0, 0.99, 3.0
"""Rows that are so near, so many of them, while the median of the others is farther: shares, colours, normals."""
_SIDE_SHARE = 0.2
"""Share of points with a negative coordinate, of which rows of another kind have none."""
_FEWEST = 16
"""Rows of a kind from which they are compared."""
_MOST_PARTS = 8
"""Most rows of four columns that a point is tried for: 32 columns."""


def parse_columns(given: str | Sequence[str] | None) -> tuple[str, ...] | None:
    """Return declared names of columns in order, None for none: text with commas, or names.

    Raises:
        SettingsError: x, y or z is missing, or a name but `_`, which stands for any column, comes twice.
    """
    if given is None:
        return None
    names = tuple(name.strip() for name in (given.split(",") if isinstance(given, str) else given))
    lower = [name.lower() for name in names]
    twice = next((name for name in lower if (name != "_" and lower.count(name) > 1) or not name), None)
    if twice is not None or not {"x", "y", "z"} <= set(lower):
        found = ",".join(names) if twice is None else f"{twice or 'an empty name'} in {','.join(names)}"
        raise SettingsError(complaint("corrupt", option("columns"), "names with x, y, z, each once", found))
    return names


def meaning(where: Path | str, names: Sequence[str]) -> tuple[tuple[str, str, str], str | None, str | None]:
    """Return the fields of x, y, z, of the intensity and of the ring, None where there is none.

    Raises:
        DataError: a coordinate is missing.
    """
    known = {name.lower(): name for name in names}
    for axis in "xyz":
        if axis not in known:
            raise DataError(complaint(where, "fields", f"a field {axis}", " ".join(known)))
    intensity, ring = (next((known[n] for n in words if n in known), None) for words in (_INTENSITY, _RING))
    return (known["x"], known["y"], known["z"]), intensity, ring


def check_values(path: Path, table: NDArray[np.void]) -> None:
    """Check that the values of a file without names are those of its columns, whose number nothing in it tells.

    Rows of another width put coordinates among the intensities, or every second, third ... row holds what no cloud is:
    whole numbers, nothing negative, or nothing but values near 0, while the others do not. Beams that fire by turns, in
    other directions, pass: no half of them sees only what is before, to the left and above.

    Raises:
        DataError: they are not.
    """
    axes, intensity, _ = meaning(path, table.dtype.names or ())
    with np.errstate(invalid="ignore"):
        points = np.stack([table[axis] for axis in axes], axis=1).astype(np.float64)
        bad = np.flatnonzero(table[intensity] < 0) if intensity is not None else np.zeros(0, int)
        far = np.flatnonzero((np.abs(points) > FARTHEST_M).any(axis=1))
    names = ",".join(map(unpadded, table.dtype.names or ()))
    hint = f"; declare the columns of a point by {option('columns')} {names},... of dsrc corrupt, or in scans.toml"
    if len(bad):
        found = f"{table[intensity][bad[0]]:g} in row {bad[0]}"
        raise DataError(complaint(path, f"intensity of columns {names}", "at least 0", found, hint))
    if len(far):
        found = f"{points[far[0]].tolist()} in row {far[0]}"
        raise DataError(complaint(path, f"x y z of columns {names}", f"at most {FARTHEST_M:g} m", found, hint))
    for parts in range(2, _MOST_PARTS + 1):
        for part in range(1, parts):
            if len(points) % parts == 0 and (odd := _oddity(points[::parts], points[part::parts])):
                width = parts * len(table.dtype.names or ())
                found = f"rows of two kinds, as if a point had {width} or more: each {parts}. row has {odd}"
                raise DataError(complaint(path, "columns", f"points of {names}", found, hint))


def _oddity(first: NDArray[np.float64], other: NDArray[np.float64]) -> str:
    """Return what tells (P, 3) rows from the points among which they lie, "" where nothing does."""
    first, other = first[has_return(first)], other[has_return(other)]
    if min(len(first), len(other)) < _FEWEST:
        return ""
    for axis in range(3):
        if _whole(other[:, axis]) and not _whole(first[:, axis]):
            return f"whole numbers for {'xyz'[axis]}"
    if (first < 0).any(axis=1).mean() >= _SIDE_SHARE and not (other < 0).any():
        return "no negative coordinate"
    near = np.linalg.norm(other, axis=1) <= _NEAR_M
    if near.mean() >= _NEAR_SHARE and np.median(np.linalg.norm(first, axis=1)) > _SCENE_M:
        return f"points within {_NEAR_M:g} m alone"
    return ""


def _whole(values: NDArray[np.float64]) -> bool:
    return bool((values == np.floor(values)).all())


def has_return(points: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return the (P,) mask of (P, 3) points that are finite and not the origin: beams without a return are that."""
    # Some processors raise a warning where a NaN is tested for truth, so that rows of finite values alone are tested.
    kept = np.isfinite(points).all(axis=1)
    kept[kept] = points[kept].any(axis=1)
    return np.asarray(kept)
