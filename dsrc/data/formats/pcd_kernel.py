"""Compiled loops of `pcd`: records row by row, where a pass per column would touch every line of memory 13 times."""

import numpy as np
from numpy.typing import NDArray

from sensors.compiled import compiled

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]
Bytes = NDArray[np.uint8]


@compiled()
def fill_records(
    table: NDArray[np.void],
    points: Floats,
    side: float,
    scale: float,
    intensity: Floats,
    ring: NDArray[np.int16],
    column: Ints,
    time: Floats,
    object_id: Ints,
    number: Bytes,
    fate: Bytes,
    material: Bytes,
    cosine: Floats,
) -> None:
    """Fill the fields that every style of record has.

    Args:
        table: (P,) records, see `dsrc.data.formats.pcd`.
        points: (P, 3) in our frame.
        side: 1, or -1 for y to the right.
        scale: of the intensity.
    """
    for i in range(len(table)):
        row = table[i]
        row["x"], row["y"], row["z"] = points[i, 0], side * points[i, 1], points[i, 2]
        row["intensity"], row["ring"], row["column"] = scale * intensity[i], ring[i], column[i]
        row["time"], row["object_id"], row["return"] = time[i], object_id[i], number[i]
        row["fate"], row["material"], row["cosine"] = fate[i], material[i], cosine[i]


@compiled()
def fill_red(table: NDArray[np.void], intensity: Floats) -> None:
    """Fill the field `rgb` of (P,) records with the intensity as red, 8 bits; 0 for NaN."""
    for i in range(len(table)):
        value = intensity[i]
        red = np.rint(min(value, np.float32(1.0)) * np.float32(255.0)) if value > 0.0 else np.float32(0.0)
        table[i]["rgb"] = np.uint32(red) << np.uint32(16)
