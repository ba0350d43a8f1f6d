"""Tracks as plain arrays in a .npz, of the kind that ScenarioNet and nuPlan keep; no pickle is opened."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.boxes import check_radians
from sim.errors import DataError, complaint
from sim.packed import read_arrays
from sim.traffic.tracks.base import Recording, Track, class_of, make_track

SHAPES = {
    "time": "T",
    "id": "N",
    "type": "N",
    "position": "NT",
    "heading": "NT",
    "length": "N",
    "width": "N",
    "valid": "NT",
}
"""Arrays by name and their axes: N objects, T times; `position` has 2 or 3 numbers more, `height` (N) is optional."""


def read_track_arrays(path: Path) -> tuple[Recording, ...]:
    """Read a .npz of arrays: s, m and rad, world frame, places of the centres of boxes, `valid` where they are known.

    With three numbers the third is the height of the centre. `height` is an array like `length`, or missing.

    Raises:
        DataError: an array is missing or has another shape or kind; names it.
    """
    arrays = read_arrays(path, "track file")
    for name in SHAPES:
        if name not in arrays:
            raise DataError(complaint(path, name, "an array", f"none among {', '.join(sorted(arrays)) or 'nothing'}"))
    count = {"T": arrays["time"].shape[:1], "N": arrays["id"].shape[:1]}
    for name, axes in SHAPES.items():
        shape, wanted = arrays[name].shape, sum((count[axis] for axis in axes), ())
        fits = shape[:2] == wanted and shape[2:] in ((2,), (3,)) if name == "position" else shape == wanted
        if not fits:
            raise DataError(complaint(path, name, f"shape {wanted}{' x 2 or 3' if name == 'position' else ''}", shape))
        kinds = "US" + "iu" * (name == "id") if name in ("id", "type") else "b" if name == "valid" else "fiu"
        if arrays[name].dtype.kind not in kinds:
            expected = {"U": "text", "b": "booleans", "f": "numbers"}[kinds[0]]
            raise DataError(complaint(path, name, expected, str(arrays[name].dtype)))
    height = arrays.get("height", np.full(count["N"], np.nan))
    if height.shape != count["N"] or height.dtype.kind not in "fiu":
        raise DataError(complaint(path, "height", f"numbers of shape {count['N']}", f"{height.dtype} {height.shape}"))
    tracks: list[Track] = []
    for row in range(len(arrays["id"])):
        size = [float(arrays["length"][row]), float(arrays["width"][row]), float(height[row])]
        class_name = class_of(path, f"type[{row}]", _text(arrays["type"][row]), size[0])
        there = arrays["valid"][row]
        if class_name is None or not there.any():
            continue
        place = arrays["position"][row, there].astype(np.float64)
        center = np.column_stack([place, np.full(len(place), np.nan)])[:, :3]
        time_s, yaw = arrays["time"][there].astype(np.float64), arrays["heading"][row, there].astype(np.float64)
        check_radians(path, f"heading[{row}]", yaw)
        tracks.append(make_track(path, _text(arrays["id"][row]), class_name, size, time_s, center, yaw))
    return (Recording(tuple(tracks)),)


def _text(value: NDArray) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
