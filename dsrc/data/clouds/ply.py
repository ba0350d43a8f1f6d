"""PLY point clouds: files of vertices alone, ASCII or binary of either byte order, scalars only.

Source: G. Turk, The PLY Polygon File Format (1994).
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.errors import DataError, complaint

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_FORMS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_END = b"end_header\n"


def decode_ply(path: Path, content: bytes) -> tuple[NDArray[np.void], str]:
    """Return the (P,) table of the vertices of a file's content, and its header.

    Raises:
        DataError: no PLY file, one of other elements than vertices or of lists, or fewer numbers than it says.
    """
    stop = content.find(_END)
    if not content.startswith(b"ply") or stop < 0:
        raise DataError(complaint(path, "header", "lines from ply to end_header", "none"))
    header = content[: stop + len(_END)].decode("ascii", "replace").replace("\r", "")
    form, count, fields = "", -1, []
    for line in header.splitlines():
        match line.split():
            case ["format", name, *_]:
                form = name
            case ["element", name, number]:
                if name == "vertex" and number.isdigit():
                    count = int(number)
                elif number != "0":
                    raise DataError(complaint(path, "element", "vertices alone", f"{name} {number}"))
            case ["property", kind, name] if kind in _TYPES and count >= 0:
                fields.append((name, _FORMS.get(form, "=") + _TYPES[kind]))
            case ["property", *words]:
                raise DataError(complaint(path, "property", "a scalar of a vertex", " ".join(words)))
    if form not in _FORMS or count < 0 or not fields:
        raise DataError(complaint(path, "header", f"vertices, as one of {', '.join(_FORMS)}", form or "no format"))
    dtype, body = np.dtype(fields), memoryview(content)[stop + len(_END) :]
    if form != "ascii":
        if len(body) != count * dtype.itemsize:
            expected = f"{count * dtype.itemsize} bytes for {count} vertices"
            raise DataError(complaint(path, "vertices", expected, f"{len(body)} bytes"))
        return np.frombuffer(body, dtype), header
    numbers = bytes(body).split()
    if len(numbers) != count * len(fields):
        expected = f"{count * len(fields)} numbers for {count} vertices"
        raise DataError(complaint(path, "vertices", expected, f"{len(numbers)} numbers"))
    table = np.zeros(count, dtype)
    for column, (name, _) in enumerate(fields):
        table[name] = np.array(numbers[column :: len(fields)]).astype(np.float64)
    return table, header


def encode_ply(table: NDArray[np.void], header: str) -> bytes:
    """Return the file of a table with the fields and the form of a header that `decode_ply` gave."""
    lines = [
        f"element vertex {len(table)}" if line.startswith("element vertex") else line for line in header.splitlines()
    ]
    start = ("\n".join(lines) + "\n").encode("ascii", "replace")
    if "\nformat ascii" not in header:
        return start + table.tobytes()
    rows = (" ".join(str(value) for value in row) for row in table.tolist())
    return start + "".join(f"{row}\n" for row in rows).encode()
