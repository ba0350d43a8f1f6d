"""LZF decoder, the compression of `binary_compressed` PCD files.

A control byte n below 32 is followed by n + 1 literals; any other has the length (3 bits; 7 means that one more byte is
added) and the upper 5 bits of the distance of an earlier run, the next byte the lower 8.

The package python-lzf 0.2.6 gives the same bytes, 1.2 MB in 1.8 ms where this takes 2.5, but has no wheels: pip must
compile it.

Source: liblzf's description of the format (lzf_d.c is not used), http://oldhome.schmorp.de/marc/liblzf.html
"""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

_LITERALS = 32
_LONG = 7
_LONGEST_RUN = 264


def decompress(data: bytes, size: int) -> bytes:
    """Return the `size` bytes of compressed data.

    Raises:
        ValueError: the data ends early, refers to bytes before its beginning or has another size.
    """
    if size > _LONGEST_RUN * len(data):  # before memory is taken for what a damaged header promises
        raise ValueError(f"{size} bytes after decompression, found {len(data)} before it")
    out = np.zeros(size, np.uint8)
    written = _compiled()(np.frombuffer(data, np.uint8), out)
    if written != size:
        raise ValueError(f"{size} bytes after decompression, found {'damaged data' if written < 0 else written}")
    return out.tobytes()


@lru_cache(maxsize=1)
def _compiled() -> Callable[[NDArray[np.uint8], NDArray[np.uint8]], int]:
    """Return the loop compiled, a hundred times as fast."""
    from sensors.compiled import compiled  # takes half a second, and most files are not compressed

    return compiled()(_decompress)


def _decompress(data: NDArray[np.uint8], out: NDArray[np.uint8]) -> int:
    """Fill `out` and return the number of bytes, -1 for damaged data."""
    i, o, end, room = 0, 0, len(data), len(out)
    while i < end:
        control = int(data[i])
        i += 1
        if control < _LITERALS:
            length = control + 1
            if i + length > end or o + length > room:
                return -1
            for _ in range(length):
                out[o] = data[i]
                i += 1
                o += 1
            continue
        length = (control >> 5) + 2
        if length == _LONG + 2:
            if i >= end:
                return -1
            length += int(data[i])
            i += 1
        if i >= end:
            return -1
        start = o - ((control & 31) << 8) - int(data[i]) - 1
        i += 1
        if start < 0 or o + length > room:
            return -1
        for k in range(length):  # byte by byte: a run may overlap itself
            out[o] = out[start + k]
            o += 1
    return o
