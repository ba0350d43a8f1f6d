"""Packed integer files: .npz archives of byte planes, compressed by LZMA.

numpy reads them as any other archive. Equal arrays give equal bytes.
"""

import io
import lzma
import zipfile
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.errors import DataError, complaint, unreadable
from sim.files import replacing


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


def write_arrays(path: Path, arrays: dict[str, NDArray]) -> None:
    """Write a .npz atomically; its bytes depend on the arrays only."""
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_LZMA) as archive:
        for name, array in arrays.items():
            content = io.BytesIO()
            np.lib.format.write_array(content, np.asarray(array), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content.getvalue(), zipfile.ZIP_LZMA)


def read_arrays(path: Path, what: str) -> dict[str, NDArray]:
    """Read the arrays of a .npz.

    Args:
        path: of the file.
        what: expected content, for messages.

    Raises:
        DataError: the file is missing or damaged.
    """
    if not path.is_file():
        raise DataError(complaint(path, what, "an existing file", "no such file"))
    broken = (OSError, ValueError, EOFError, KeyError, AttributeError, NotImplementedError)
    try:
        # Opened here, because numpy leaves a damaged archive open.
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (*broken, zipfile.BadZipFile, zlib.error, lzma.LZMAError) as error:
        raise DataError(unreadable(path, what, error)) from None
