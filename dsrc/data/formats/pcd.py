"""PCD v0.7 point clouds: reader of ASCII, binary and compressed files, writer of binary ones.

OPV2V's tools keep the intensity in the red channel of `rgb`, 8 bits; it is written beside every column of a sweep as a
field of its own, which those tools ignore. In OPV2V's trees points are in CARLA's left-handed sensor frame (y to the
right); in memory, and in the files of real sensors, in ours (y to the left).

Source: https://pointclouds.org/documentation/tutorials/pcd_file_format.html
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsrc.data.formats.decimals import read_numbers
from dsrc.data.formats.lzf import decompress
from sensors.deskew import deskew
from sensors.spec import LidarSpec
from sensors.sweep import Motion, Sweep, make_sweep
from sim.errors import DataError, complaint, notice
from sim.reading import parsing, read_bytes

_HEADER = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_OLD_NAMES = {"COLUMNS": "FIELDS"}
"""Header entries of versions before 0.7 that PCL takes too."""
_KINDS = {"F": "f", "U": "u", "I": "i"}
_SIZES = {"F": (4, 8), "U": (1, 2, 4, 8), "I": (1, 2, 4, 8)}

_RECORD = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("rgb", "<u4"),
        ("intensity", "<f4"),
        ("ring", "<i2"),
        ("column", "<i4"),
        ("time", "<f4"),
        ("object_id", "<i4"),
        ("return", "u1"),
        ("fate", "u1"),
        ("material", "u1"),
        ("cosine", "<f4"),
    ]
)
COLUMNS = {
    "intensity": "intensity",
    "ring": "ring",
    "column": "column",
    "time": "time_offset",
    "object_id": "object_id",
    "return": "return_number",
    "fate": "fate",
    "material": "material",
    "cosine": "cosine",
}
"""Columns of `Sweep` by field of the file; `material` counts in the order of `sim.mesh.materials.MATERIALS`."""


_PART = 6000
"""Records that are made at once: a quarter of a megabyte, written and hashed while it is in the processor's cache."""

SENSOR_FULL_SCALE = 256.0
"""Intensity in DAIR-V2X's files that equals 1 of ours; a power of two, so that nothing is rounded."""


@dataclass(frozen=True, slots=True)
class Acquisition:
    """How the points of a PCD file were taken.

    Attributes:
        height: rows of the grid of an organised cloud, its POINTS in rows of equal width; 1 without a grid.
        viewpoint: place and quaternion (w x y z) of the sensor, seven numbers as they are written. Points are in the
            sensor's frame, whatever it says.
    """

    height: int = 1
    viewpoint: str = "0 0 0 1 0 0 0"


NOWHERE = Acquisition()
"""Without a grid, the sensor at the origin."""


def padded(name: str, field: int) -> str:
    """Return the name of a field in a table: several may be PCL's padding `_`, and names of a table differ."""
    return f"_ {field}" if name == "_" else name


def unpadded(name: str) -> str:
    """Return the name of a field of a table as it stands in a file."""
    return name.partition(" ")[0]


def encode_table(table: NDArray[np.void], taken: Acquisition = NOWHERE) -> bytes:
    """Return a binary PCD file of a (P,) structured array of scalars and sub-arrays; `taken` has a height that fits."""
    return b"".join([_header_of(table.dtype, len(table), taken), np.ascontiguousarray(table).view(np.uint8).data])


def _header_of(dtype: np.dtype, points: int, taken: Acquisition = NOWHERE) -> bytes:
    names = dtype.names or ()
    dtypes = [dtype[name].base for name in names]
    kinds = {kind: letter for letter, kind in _KINDS.items()}
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(map(unpadded, names)),
        "SIZE " + " ".join(str(d.itemsize) for d in dtypes),
        "TYPE " + " ".join(kinds[d.kind] for d in dtypes),
        "COUNT " + " ".join(str(math.prod(dtype[name].shape)) for name in names),
        f"WIDTH {points // taken.height}",
        f"HEIGHT {taken.height}",
        f"VIEWPOINT {taken.viewpoint}",
        f"POINTS {points}",
        "DATA binary",
    ]
    return ("\n".join(lines) + "\n").encode("ascii")


def read_table(path: Path) -> NDArray[np.void]:
    """Return the table alone of `read_organised`."""
    return read_organised(path)[0]


def read_organised(path: Path) -> tuple[NDArray[np.void], Acquisition]:
    """Read all fields of a PCD file, `ascii`, `binary` or `binary_compressed`, and how its points were taken.

    Fields of COUNT 0, which Ouster writes, hold nothing and are left out; so are bytes after the last point, with a
    notice where they are a point or more.

    Returns:
        (P,) structured array, one field per FIELDS entry (of COUNT 1; wider ones are sub-arrays), padding named by
        `padded`; and what belongs to all points.

    Raises:
        DataError: the file is missing, truncated or damaged, or its header contradicts itself.
    """
    content = read_bytes(path, "PCD file")
    with parsing(path, "PCD file"):
        header, body = _split_header(path, content)
        dtype, points = _record_type(path, header), _point_count(path, header)
        taken = Acquisition(_height(header, points), _viewpoint(header))
        form = header["DATA"][0]
        if form == "binary":
            expected = points * dtype.itemsize
            if len(body) < expected:
                raise DataError(complaint(path, "DATA", f"{expected} bytes for {points} points", f"{len(body)} bytes"))
            if len(body) >= expected + max(dtype.itemsize, 1):
                notice(f"{path}: {len(body) - expected} bytes after {points} points are left out")
            return np.frombuffer(body[:expected], dtype), taken
        if form == "ascii":
            return _ascii_table(path, body, dtype, points), taken
        if form == "binary_compressed":
            return _compressed_table(path, body, dtype, points), taken
        raise DataError(complaint(path, "DATA", "ascii, binary or binary_compressed", form))


def encode_pcd(sweep: Sweep) -> Iterator[bytes | bytearray]:
    """Yield the parts of OPV2V's PCD file of a sweep: mirrored points, red intensity and all columns exactly."""
    return _parts(sweep, _RECORD, side=-1.0)


def encode_sensor_pcd(sweep: Sweep) -> Iterator[bytes | bytearray]:
    """Yield the parts of a PCD file in the style of real sensors: all columns, not mirrored, intensity up to 256."""
    dtype = np.dtype([(name, _RECORD[name]) for name in _RECORD.names or () if name != "rgb"])
    return _parts(sweep, dtype, scale=SENSOR_FULL_SCALE)


def _parts(sweep: Sweep, dtype: np.dtype, side: float = 1.0, scale: float = 1.0) -> Iterator[bytes | bytearray]:
    """Yield the header and `_PART` records at a time."""
    values = [np.ascontiguousarray(getattr(sweep, column)) for column in ("points", *COLUMNS.values())]
    yield _header_of(dtype, len(sweep))
    for start in range(0, len(sweep), _PART):
        yield records_of(dtype, side, scale, *(rows[start : start + _PART] for rows in values))


def records_of(
    dtype: np.dtype, side: float, scale: float, points: NDArray[np.float32], intensity: NDArray[np.float32], *more: Any
) -> bytearray:
    """Return the records of (P, 3) points, their intensity and the other (P,) columns of `COLUMNS`.

    Args:
        side: 1, or -1 for y to the right.
        scale: of the intensity.
    """
    from dsrc.data.formats.pcd_kernel import fill_records, fill_red  # takes half a second, and readers need none of it

    content = bytearray(len(points) * dtype.itemsize)
    table = np.frombuffer(content, dtype)
    fill_records(table, points, np.float32(side), np.float32(scale), intensity, *more)
    if "rgb" in (dtype.names or ()):
        fill_red(table, intensity)
    return content


def read_pcd(
    path: Path,
    world_from_lidar: NDArray[np.float64] | None = None,
    time_s: float = 0.0,
    spec: LidarSpec | None = None,
    *,
    mirrored: bool = True,
    full_scale: float | None = None,
) -> Sweep:
    """Read a sweep from our files or those of OPV2V; missing columns are those of `make_sweep`.

    Args:
        path: a PCD file with x, y, z and `intensity` or `rgb`.
        world_from_lidar: (4, 4) pose of the sensor, not in the file.
        time_s: reference time of the sweep, not in the file.
        spec: the sensor, not in the file.
        mirrored: OPV2V's style, y to the right and every point a return; else that of a real sensor: y to the left,
            beams without return may be nan and are left out.
        full_scale: the file's `intensity` that equals 1; None takes 255 where one exceeds 1 and there is no colour.

    Raises:
        DataError: the file cannot be read, lacks a coordinate or intensity, or has a coordinate that is not finite.
    """
    table = read_table(path)
    with parsing(path, "PCD file"):
        names = table.dtype.names or ()
        for field in ("x", "y", "z"):
            if field not in names:
                raise DataError(complaint(path, "FIELDS", f"a field {field}", " ".join(names)))
        for field in ("x", "y", "z", "rgb", *COLUMNS):
            if field in names and table.dtype[field].shape:
                raise DataError(complaint(path, f"COUNT of {field}", "1", table.dtype[field].shape[0]))
        if not mirrored:
            table = table[np.isfinite(table["x"]) & np.isfinite(table["y"]) & np.isfinite(table["z"])]
        with np.errstate(over="ignore"):
            coordinates = {field: table[field].astype(np.float32) for field in ("x", "y", "z")}
        for field, values in coordinates.items():
            check_finite(path, field, values, table[field])
        y = -coordinates["y"] if mirrored else coordinates["y"]
        points = np.stack([coordinates["x"], y, coordinates["z"]], axis=1)
        # Each of its own: a column of the table holds the whole table, and is read in strides.
        columns = {column: table[field].copy() for field, column in COLUMNS.items() if field in names}
        columns["intensity"] = _intensity(path, table, full_scale)
        return make_sweep(points, world_from_lidar, time_s, spec, **columns)


def check_finite(path: Path, field: str, values: NDArray, stored: NDArray | None = None) -> None:
    """Check the (P,) values of a field; DataError shows the first bad one as it is stored."""
    bad = np.flatnonzero(~np.isfinite(values))
    if len(bad):
        found = (values if stored is None else stored)[bad[0]]
        raise DataError(complaint(path, f"{field} of point {bad[0]}", "a finite number", str(found)))


def compensated(path: Path, sweep: Sweep, motion: Motion | None) -> Sweep:
    """Return the sweep of a file with another compensation of its sensor's motion, None for its own."""
    try:
        return sweep if motion is None else deskew(sweep, motion)
    except DataError as error:
        raise DataError(f"{path}: cannot be read as '{motion}': {error}") from None


def _intensity(path: Path, table: NDArray[np.void], full_scale: float | None) -> NDArray[np.float32]:
    """Return (P,) intensity in [0, 1]: of our field, else of the red of `rgb`, else of a field up to 255."""
    names = table.dtype.names or ()
    if "intensity" in names:
        intensity = table["intensity"].astype(np.float32)
        check_finite(path, "intensity", intensity)
        if full_scale is not None:
            return intensity / np.float32(full_scale)
        eight_bit = "rgb" not in names and len(intensity) > 0 and float(intensity.max()) > 1.0
        return intensity / np.float32(255.0) if eight_bit else intensity
    if "rgb" in names:
        packed = table["rgb"]
        if packed.dtype.itemsize != 4:
            raise DataError(complaint(path, "SIZE of rgb", "4", packed.dtype.itemsize))
        bits = np.ascontiguousarray(packed).view(np.uint32)
        return ((bits >> 16) & 0xFF).astype(np.float32) / np.float32(255.0)
    raise DataError(complaint(path, "FIELDS", "a field rgb or intensity", " ".join(names)))


def _split_header(path: Path, content: bytes) -> tuple[dict[str, list[str]], memoryview]:
    """Return the header's entries and a view of the bytes after its DATA line."""
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        end = content.find(b"\n", start)
        if end < 0:
            raise DataError(
                complaint(path, "header", "a line DATA", "the end of the file" if header else "no PCD file")
            )
        words = content[start:end].decode("ascii", "replace").split()
        start = end + 1
        if not words or words[0].startswith("#"):
            continue
        if words[0] not in _HEADER and words[0] not in _OLD_NAMES:
            raise DataError(complaint(path, "header", f"one of {' '.join(_HEADER)}", words[0]))
        header[_OLD_NAMES.get(words[0], words[0])] = words[1:]
    for name in ("FIELDS", "SIZE", "TYPE", "DATA"):
        if not header.get(name):
            raise DataError(complaint(path, "header", f"a line {name}", "none"))
    return header, memoryview(content)[start:]


def _record_type(path: Path, header: dict[str, list[str]]) -> np.dtype:
    names, sizes, types = header["FIELDS"], header["SIZE"], header["TYPE"]
    counts = header.get("COUNT", ["1"] * len(names))
    for field, entries in (("SIZE", sizes), ("TYPE", types), ("COUNT", counts)):
        if len(entries) != len(names):
            raise DataError(complaint(path, field, f"{len(names)} entries as in FIELDS", f"{len(entries)}"))
    fields = []
    for i, (name, size, kind, count) in enumerate(zip(names, sizes, types, counts, strict=True)):
        if kind not in _KINDS or not size.isdigit() or int(size) not in _SIZES[kind]:
            raise DataError(complaint(path, f"TYPE and SIZE of {name}", "F 4, U 4, I 4 or alike", f"{kind} {size}"))
        if not count.isdigit():
            raise DataError(complaint(path, f"COUNT of {name}", "a whole number", count))
        scalar, unique = f"<{_KINDS[kind]}{size}", padded(name, i)
        if int(count) > 0:
            fields.append((unique, scalar) if int(count) == 1 else (unique, scalar, (int(count),)))
    try:
        return np.dtype(fields)
    except ValueError as error:
        raise DataError(f"{path}: FIELDS: {error}") from None


def _point_count(path: Path, header: dict[str, list[str]]) -> int:
    numbers = {}
    for name in ("WIDTH", "HEIGHT", "POINTS"):
        words = header.get(name)
        if words is None:
            continue
        if len(words) != 1 or not words[0].isdigit():
            raise DataError(complaint(path, name, "a whole number", " ".join(words)))
        numbers[name] = int(words[0])
    if "POINTS" not in numbers and "WIDTH" in numbers:
        return numbers["WIDTH"] * numbers.get("HEIGHT", 1)
    if "POINTS" not in numbers:
        raise DataError(complaint(path, "header", "a line POINTS", "none"))
    if "WIDTH" in numbers and numbers["WIDTH"] * numbers.get("HEIGHT", 1) != numbers["POINTS"]:
        area = f"{numbers['WIDTH']} x {numbers.get('HEIGHT', 1)}"
        raise DataError(complaint(path, "POINTS", f"WIDTH x HEIGHT = {area}", numbers["POINTS"]))
    return numbers["POINTS"]


def _height(header: dict[str, list[str]], points: int) -> int:
    """Return the rows of the grid of points whose number is checked, 1 without a grid."""
    return int(header["HEIGHT"][0]) if points and "WIDTH" in header and "HEIGHT" in header else 1


def _viewpoint(header: dict[str, list[str]]) -> str:
    """Return the seven numbers of VIEWPOINT, those of the origin where it has others."""
    words = header.get("VIEWPOINT", [])
    try:
        known = len(words) == 7 and all(math.isfinite(float(word)) for word in words)
    except ValueError:
        known = False
    return " ".join(words) if known else NOWHERE.viewpoint


def _compressed_table(path: Path, body: memoryview, dtype: np.dtype, points: int) -> NDArray[np.void]:
    """Decode LZF: two sizes of 4 bytes, then field by field the values of all points."""
    if len(body) < 8:
        raise DataError(complaint(path, "DATA", "two sizes of 4 bytes", f"{len(body)} bytes"))
    packed, size = (int(n) for n in np.frombuffer(body[:8], "<u4"))
    expected = points * dtype.itemsize
    if size != expected:
        raise DataError(complaint(path, "DATA", f"{expected} bytes for {points} points", f"{size} bytes"))
    if len(body) < 8 + packed:
        raise DataError(complaint(path, "DATA", f"{packed} compressed bytes", f"{len(body) - 8} bytes"))
    try:
        columns = decompress(bytes(body[8 : 8 + packed]), size)
    except ValueError as error:
        raise DataError(f"{path}: DATA: expected {error}") from None
    table = np.zeros(points, dtype)
    start = 0
    for name in dtype.names or ():
        field = dtype[name]
        block = np.frombuffer(columns, field.base, points * int(np.prod(field.shape, dtype=int)), start)
        table[name] = block.reshape(points, *field.shape)
        start += points * field.itemsize
    return table


def _ascii_table(path: Path, body: memoryview, dtype: np.dtype, points: int) -> NDArray[np.void]:
    names = dtype.names or ()
    widths = [int(np.prod(dtype[name].shape, dtype=int)) for name in names]
    if points * sum(widths) > len(body):  # before memory is taken for what a damaged header promises
        raise DataError(complaint(path, "DATA", f"{points * sum(widths)} numbers", f"{len(body)} bytes"))
    values = _numbers(path, body, (points, sum(widths)))
    table = np.zeros(points, dtype)
    column = 0
    for name, width in zip(names, widths, strict=True):
        block = values[:, column : column + width]
        column += width
        if dtype[name].base.kind in "ui" and not np.isfinite(block).all():
            raise DataError(complaint(path, name, "whole numbers", "nan or inf"))
        table[name] = block.reshape(table[name].shape)
    return table


def _numbers(path: Path, body: memoryview, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the numbers of a text: by the compiled parser, else word by word with an error message."""
    values = read_numbers(body, shape[0] * shape[1])
    if values is not None:
        return values.reshape(shape)
    words = bytes(body).split()
    if len(words) != shape[0] * shape[1]:
        expected = f"{shape[0] * shape[1]} numbers for {shape[0]} points"
        raise DataError(complaint(path, "DATA", expected, f"{len(words)} numbers"))
    try:
        return np.array([float(word) for word in words]).reshape(shape)
    except ValueError as error:
        raise DataError(complaint(path, "DATA", "numbers", str(error))) from None
