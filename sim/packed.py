"""Packed integer files: .npz archives of byte planes, compressed by LZMA.

numpy reads them as any other archive. Equal arrays give equal bytes.
"""

import io
import math
import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.files import replacing
from sim.reading import check_regular, parsing

LARGEST_BYTES = 1 << 30
"""Largest size of an archive unpacked, byte planes as whole integers: a city's static world takes a third of it."""
LARGEST_EMPTY = 1 << 16
"""Largest size of an empty array, bytes, with 1 for its axes of 0."""
MOST_ARRAYS = 10_000
"""Most arrays of an archive."""


def packed(values: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Return (B, N) byte planes of (N,) integers, lowest first; B fits the largest.

    The sign goes to the lowest bit (zigzag), so that small numbers of either sign leave the higher planes zero.
    """
    unsigned = ((values << 1) ^ (values >> 63)).astype("<u8")
    planes = unsigned.view(np.uint8).reshape(-1, 8).T
    used = int(np.flatnonzero(planes.any(axis=1)).max(initial=0)) + 1
    return np.ascontiguousarray(planes[:used])


def unpacked(planes: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return the (N,) integers of byte planes, the inverse of `packed`."""
    wide = np.zeros((planes.shape[1], 8), np.uint8)
    wide[:, : len(planes)] = planes.T[:, :8]
    unsigned = wide.view("<u8").ravel()
    return (unsigned >> np.uint64(1)).astype(np.int64) ^ -(unsigned & np.uint64(1)).astype(np.int64)


def differences(values: NDArray[np.int64], length: NDArray[np.int64], keep: bool = False) -> NDArray[np.int64]:
    """Return the differences of (N,) integers within each run; its first is 0, or the value itself with `keep`.

    Args:
        length: of each run, at least 1; their sum is N.
        keep: keep the first value of each run, as `sums` needs it.
    """
    change = np.diff(values, prepend=0)
    first = np.cumsum(length) - length
    change[first] = values[first] if keep else 0
    return change


def sums(changes: NDArray[np.int64], length: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the values of differences, the inverse of `differences` with `keep`."""
    total = np.cumsum(changes)
    first = np.cumsum(length) - length
    return total - np.repeat(total[first] - changes[first], length)


def write_arrays(path: Path, arrays: dict[str, NDArray]) -> None:
    """Write a .npz atomically; its bytes depend on the arrays only."""
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_LZMA) as archive:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asarray(array), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content.getvalue(), zipfile.ZIP_LZMA)


def read_arrays(path: Path, what: str) -> dict[str, NDArray]:
    """Read the arrays of a .npz.

    Raises:
        DataError: the file is missing, damaged or larger than `LARGEST_BYTES` in memory.
    """
    check_regular(path, what)
    # Opened here, because numpy leaves a damaged archive open.
    with parsing(path, what), path.open("rb") as file:
        with zipfile.ZipFile(file) as members:
            _check_sizes(members)
        file.seek(0)
        with np.load(file, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
        for name, array in arrays.items():
            if array.dtype.kind == "U":
                "".join(array.ravel().tolist()).encode()  # a surrogate is no text: it could not be written again
            if array.dtype.kind == "f" and array.dtype.itemsize > 8:
                raise ValueError(f"{name}: numbers of {array.dtype}")
        return arrays


def _check_sizes(archive: zipfile.ZipFile) -> None:
    """Raise ValueError unless the shapes in the headers fit the members and all of it fits `LARGEST_BYTES`.

    numpy allocates what a header says before it reads: a damaged one must not ask for terabytes.
    """
    infos = archive.infolist()
    if sum(info.file_size for info in infos) > LARGEST_BYTES:
        raise ValueError(f"more than {LARGEST_BYTES} bytes when unpacked")
    if len(infos) > MOST_ARRAYS:
        raise ValueError(f"more than {MOST_ARRAYS} arrays")
    unpacked_bytes = 0
    for info in infos:
        with archive.open(info) as member:
            first = np.lib.format.read_magic(member) == (1, 0)
            read = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
            shape, _, dtype = read(member)
        # The other sizes of an empty array cost nothing in the file, but memory of whoever works with them.
        most = max(info.file_size, LARGEST_EMPTY) if 0 in shape else info.file_size
        if math.prod(max(n, 1) for n in shape) * max(dtype.itemsize, 1) > most:
            raise ValueError(f"{info.filename}: an array of {shape} in {info.file_size} bytes")
        if len(shape) == 2 and dtype == np.uint8:
            unpacked_bytes += 8 * shape[1]  # byte planes: few bytes in the file, eight each when in use
    if unpacked_bytes > LARGEST_BYTES:
        raise ValueError(f"more than {LARGEST_BYTES} bytes when unpacked")
