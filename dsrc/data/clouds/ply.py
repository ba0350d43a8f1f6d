"""PLY point clouds: files of vertices alone, ASCII or binary of either byte order, scalars only.

Elements of which there is none, such as the faces of a cloud, are kept in the header, whatever their properties.

Source: G. Turk, The PLY Polygon File Format (1994).
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.errors import DataError, complaint, notice

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
_FORMS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_END = "end_header"
_LINE_ENDS = (b"\r\n", b"\n", b"\r")


def decode_ply(path: Path, content: bytes) -> tuple[NDArray[np.void], str]:
    """Return the (P,) table of the vertices of a file's content, and its header with its line ends.

    Bytes after the last vertex are left out, with a notice where they are a vertex or more.

    Raises:
        DataError: no PLY file, one of other elements than vertices or of lists, or fewer numbers than it says.
    """
    header, body = _split(path, content)
    form, count, fields, element, items = "", -1, [], "", -1
    for line in _lines(header)[0]:
        match line.split():
            case ["format", name, *_]:
                form = name
            case ["element", element, number] if number.isdigit():
                items = int(number)
                if element == "vertex" and count < 0:
                    count = items
                elif items:
                    raise DataError(complaint(path, "element", "vertices alone", f"{element} {number}"))
            case ["property", *_] if element and element != "vertex" and items == 0:
                pass
            case ["property", kind, name] if kind in _TYPES and element == "vertex":
                fields.append((name, _FORMS.get(form, "=") + _TYPES[kind]))
            case ["property", *words]:
                raise DataError(complaint(path, "property", "a scalar of a vertex", " ".join(words)))
            case ["element", *words]:
                raise DataError(complaint(path, "element", "a name and a number", " ".join(words)))
    if form not in _FORMS or count < 0 or not fields:
        raise DataError(complaint(path, "header", f"vertices, as one of {', '.join(_FORMS)}", form or "no format"))
    dtype = np.dtype(fields)
    if form != "ascii":
        size = count * dtype.itemsize
        if len(body) < size:
            raise DataError(complaint(path, "vertices", f"{size} bytes for {count} vertices", f"{len(body)} bytes"))
        if len(body) >= size + dtype.itemsize:
            notice(f"{path}: {len(body) - size} bytes after {count} vertices are left out")
        return np.frombuffer(body[:size], dtype), header
    numbers = bytes(body).split()
    if len(numbers) != count * len(fields):
        expected = f"{count * len(fields)} numbers for {count} vertices"
        raise DataError(complaint(path, "vertices", expected, f"{len(numbers)} numbers"))
    table = np.zeros(count, dtype)
    for column, (name, _) in enumerate(fields):
        table[name] = np.array(numbers[column :: len(fields)]).astype(np.float64)
    return table, header


def _split(path: Path, content: bytes) -> tuple[str, memoryview]:
    """Return the header, up to the end of its last line, and the bytes after it."""
    end = next((end for end in _LINE_ENDS if content.startswith(b"ply" + end)), None)
    start = 0
    while end is not None:
        stop = content.find(end, start)
        if stop < 0:
            break
        line, start = content[start:stop], stop + len(end)
        if line.strip() == _END.encode():
            return content[:start].decode("latin-1"), memoryview(content)[start:]
    raise DataError(complaint(path, "header", f"lines from ply to {_END}", "none"))


def _lines(header: str) -> tuple[list[str], str]:
    """Return the lines of a header, and what ends each."""
    end = next(end.decode() for end in _LINE_ENDS if header.startswith(f"ply{end.decode()}"))
    return header.removesuffix(end).split(end), end


def encode_ply(table: NDArray[np.void], header: str) -> bytes:
    """Return the file of a table with the fields and the form of a header that `decode_ply` gave."""
    lines, end = _lines(header)
    words = [line.split() for line in lines]
    counted = [
        f"element vertex {len(table)}" if w[:2] == ["element", "vertex"] else s
        for s, w in zip(lines, words, strict=True)
    ]
    start = "".join(f"{line}{end}" for line in counted).encode("latin-1")
    if not any(word[:2] == ["format", "ascii"] for word in words):
        return start + table.tobytes()
    rows = (" ".join(str(value) for value in row) for row in table.tolist())
    return start + "".join(f"{row}{end}" for row in rows).encode()
