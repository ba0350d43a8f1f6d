"""Compact point clouds: the columns of a sweep without loss, in a quarter of the bytes of a PCD file.

The first line is `dsrc compact cloud 1`, the second a JSON header, and then follow the blocks of zstd, each of one byte
of the values of one column. A column is taken as unsigned bits; the difference of each value from the one before, which
is small along a ring, is folded from 0, -1, 1, -2, ... to 0, 1, 2, 3, ... and cut into planes: the lowest bytes of all
values, then the next. High planes are almost empty, low ones of coordinates are noise of the sensor, which nothing
compresses. Points are in our frame (y to the left). Times are one per firing column where they depend on it alone.
"""

import zlib
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
import zstandard
from msgspec import Meta
from numpy.typing import NDArray

from dsrc.data.formats.pcd import COLUMNS, check_finite
from dsrc.data.jsonio import decode_json
from sensors.spec import LidarSpec
from sensors.sweep import Sweep, make_sweep
from sim.errors import DataError, complaint
from sim.reading import parsing, read_bytes

VERSION = 1
MOST_POINTS = 1 << 24
"""Most points of a cloud: a header is not believed beyond it, for a few bytes of zstd can hold gigabytes of zeros."""
_MARK = b"dsrc compact cloud "
_LONGEST_LINE = 1 << 16
_LEVEL = 1
"""Of zstd: level 3 takes twice the time for 0.3 % less."""

_TYPES = {
    "x": "<f4",
    "y": "<f4",
    "z": "<f4",
    "intensity": "<f4",
    "ring": "<i2",
    "column": "<i4",
    "time": "<f4",
    "object_id": "<i4",
    "return": "|u1",
    "fate": "|u1",
    "material": "|u1",
    "cosine": "<f4",
}

_Count = Annotated[int, Meta(ge=0, le=MOST_POINTS)]
Per = Literal["point", "column"]
_Bytes = Annotated[int, Meta(ge=0)]


class Column(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Column of a file.

    Attributes:
        name: of the field, as in our PCD files.
        type: of its values, as numpy writes it.
        per: what has one value each: a point, or a firing column by its number.
        rows: number of values.
        planes: bytes of each block, lowest bytes of the values first.
    """

    name: str
    type: str
    per: Per
    rows: _Count
    planes: list[_Bytes]


class Header(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Header of a file; `check` is the CRC-32 of all blocks, so that any change of the points changes it."""

    points: _Count
    check: int
    columns: list[Column]


def encode_compact(sweep: Sweep) -> bytes:
    """Return the compact file of a sweep, all columns exactly; its bytes depend on the version of zstd.

    Raises:
        DataError: the sweep has more than `MOST_POINTS` points.
    """
    if len(sweep) > MOST_POINTS:
        raise DataError(complaint("sweep", "points", f"at most {MOST_POINTS} in a compact cloud", len(sweep)))
    fields = {"x": sweep.points[:, 0], "y": sweep.points[:, 1], "z": sweep.points[:, 2]}
    fields |= {field: getattr(sweep, column) for field, column in COLUMNS.items()}
    values = {name: np.ascontiguousarray(fields[name], dtype) for name, dtype in _TYPES.items()}
    by_column = _by_column(values["time"], values["column"])
    pack = zstandard.ZstdCompressor(level=_LEVEL).compress
    columns: list[Column] = []
    blocks: list[bytes] = []
    per: Per
    for name, dtype in _TYPES.items():
        per, kept = ("column", by_column) if name == "time" and by_column is not None else ("point", values[name])
        planes = [pack(plane) for plane in _split(kept)]
        columns.append(Column(name, dtype, per, len(kept), list(map(len, planes))))
        blocks += planes
    body = b"".join(blocks)
    header = msgspec.json.encode(Header(len(sweep), zlib.crc32(body), columns))
    return b"%s%d\n%s\n%s" % (_MARK, VERSION, header, body)


def read_compact(
    path: Path, world_from_lidar: NDArray[np.float64] | None = None, time_s: float = 0.0, spec: LidarSpec | None = None
) -> Sweep:
    """Read a sweep from a compact file; pose, time and sensor are not in it, see `dsrc.data.formats.pcd.read_pcd`.

    Raises:
        DataError: the file is missing, cut short, damaged, of another version or with other columns, or a coordinate
            or an intensity is not finite.
    """
    values = read_columns(path)
    with parsing(path, "compact cloud"):
        for name in ("x", "y", "z", "intensity"):
            check_finite(path, name, values[name])
        points = np.stack([values.pop(name) for name in ("x", "y", "z")], axis=1)
        return make_sweep(points, world_from_lidar, time_s, spec, **{COLUMNS[name]: values[name] for name in values})


def read_columns(path: Path) -> dict[str, NDArray]:
    """Return the (P,) columns of a compact file by name, whatever their values; raises as `read_compact`."""
    content = read_bytes(path, "compact cloud")
    with parsing(path, "compact cloud"):
        header, start = _header(path, content)
        body = memoryview(content)[start:]
        expected = sum(size for column in header.columns for size in column.planes)
        if len(body) != expected:
            raise DataError(complaint(path, "blocks", f"{expected} bytes as in the header", f"{len(body)} bytes"))
        if zlib.crc32(body) != header.check:
            raise DataError(complaint(path, "check", f"{header.check} as in the header", zlib.crc32(body)))
        values: dict[str, NDArray] = {}
        place, zstd = 0, zstandard.ZstdDecompressor()
        for column in header.columns:
            planes = []
            for size in column.planes:
                planes.append(_unpacked(path, column, body[place : place + size], zstd))
                place += size
            values[column.name] = _joined(planes, column)
        for column in header.columns:
            if column.per == "column":
                number = values["column"]
                if len(number) and not 0 <= number.min() <= number.max() < column.rows:
                    beyond = f"{number.min()} to {number.max()}"
                    raise DataError(complaint(path, "column", f"numbers from 0 to {column.rows - 1}", beyond))
                values[column.name] = values[column.name][number]
        return values


def _header(path: Path, content: bytes) -> tuple[Header, int]:
    """Return the header and the place of the first block."""
    first = content.find(b"\n", 0, len(_MARK) + 20)
    if first < 0 or not content.startswith(_MARK):
        raise DataError(complaint(path, "first line", f"{_MARK.decode()}{VERSION}", "no compact cloud"))
    version = content[len(_MARK) : first].decode("ascii", "replace")
    if version != str(VERSION):
        raise DataError(complaint(path, "version", str(VERSION), version))
    second = content.find(b"\n", first + 1, first + _LONGEST_LINE)
    if second < 0:
        raise DataError(complaint(path, "header", "a line of JSON", "the end of the file"))
    header = decode_json(path, content[first + 1 : second], Header)
    names = [column.name for column in header.columns]
    if names != list(_TYPES):
        foreign = [name for name in names if name not in _TYPES]
        missing = [name for name in _TYPES if name not in names]
        found = f"a foreign column {foreign[0]}" if foreign else f"none of {missing[0]}" if missing else " ".join(names)
        raise DataError(complaint(path, "columns", " ".join(_TYPES), found))
    for column in header.columns:
        if column.type != _TYPES[column.name]:
            raise DataError(complaint(path, f"type of {column.name}", _TYPES[column.name], column.type))
        if len(column.planes) != np.dtype(column.type).itemsize:
            expected = f"{np.dtype(column.type).itemsize} for {column.type}"
            raise DataError(complaint(path, f"planes of {column.name}", expected, len(column.planes)))
        if column.per == "column" and column.name != "time":
            raise DataError(complaint(path, f"per of {column.name}", "point", column.per))
        if column.per == "point" and column.rows != header.points:
            raise DataError(complaint(path, f"rows of {column.name}", f"{header.points} points", column.rows))
    return header, second + 1


def _by_column(time: NDArray, column: NDArray) -> NDArray | None:
    """Return the time of each firing column by its number; None where points of one column differ."""
    if not len(column) or column.min() < 0 or column.max() >= len(column):
        return None
    table = np.zeros(int(column.max()) + 1, time.dtype)
    table[column] = time
    return table if np.array_equal(table[column].view(np.uint32), time.view(np.uint32)) else None


def _split(values: NDArray) -> NDArray[np.uint8]:
    """Return (B, N) planes of the folded differences of (N,) values of B bytes."""
    size = values.dtype.itemsize
    bits = values.view(f"<u{size}")
    steps = bits.copy()
    steps[1:] -= bits[:-1]
    folded = (steps << 1) ^ -(steps >> (8 * size - 1))
    return np.ascontiguousarray(folded.view(np.uint8).reshape(-1, size).T)


def _unpacked(path: Path, column: Column, block: memoryview, zstd: zstandard.ZstdDecompressor) -> NDArray[np.uint8]:
    """Return (N,) bytes of a block, whose size is known before memory is taken for it."""
    try:
        size = zstandard.frame_content_size(block)
        if size != column.rows:
            found = "an unknown number" if size < 0 else size
            raise DataError(complaint(path, f"block of {column.name}", f"{column.rows} bytes", found))
        unpacked = zstd.decompress(block, max_output_size=column.rows, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise DataError(complaint(path, f"block of {column.name}", "a block of zstd", str(error))) from None
    return np.frombuffer(unpacked, np.uint8)


def _joined(planes: list[NDArray[np.uint8]], column: Column) -> NDArray:
    """Return the values of `_split` planes."""
    folded = np.stack(planes, axis=1).reshape(-1).view(f"<u{len(planes)}")
    return np.cumsum((folded >> 1) ^ -(folded & 1), dtype=folded.dtype).view(column.type)
