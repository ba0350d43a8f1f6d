"""Readers of the two mesh formats that ship with SUMO: 3D Studio (.3ds) and Wavefront (.obj)."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.errors import ScenarioError, complaint
from sim.reading import parsing, read_bytes

# Chunk ids of a .3ds file: https://en.wikipedia.org/wiki/.3ds
_NESTED = (0x4D4D, 0x3D3D, 0x4100)
_OBJECT, _VERTICES, _FACES, _FACE_MATERIAL = 0x4000, 0x4110, 0x4120, 0x4130


@dataclass(frozen=True, slots=True, eq=False)
class MeshFile:
    """Triangles of a mesh file, in its own axes.

    Attributes:
        vertices: (V, 3) float64.
        faces: (F, 3) int64 rows of `vertices`.
        group: (F,) names of the material of each face, "" without one.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    group: NDArray[np.str_]


def read_3ds(path: Path) -> MeshFile:
    """Read all triangles of a .3ds file.

    Raises:
        ScenarioError: the file is missing, truncated or of another format.
    """
    data = read_bytes(path, ".3ds file", ScenarioError)
    with parsing(path, ".3ds file", ScenarioError):
        if data[:2] != b"\x4d\x4d":
            raise ScenarioError(complaint(path, "first chunk", "4D4D of a .3ds file", data[:2].hex()))
        return _checked(_collect_3ds(data))


def _collect_3ds(data: bytes) -> MeshFile:
    vertices: list[NDArray[np.float64]] = []
    faces: list[NDArray[np.int64]] = []
    groups: list[NDArray[np.str_]] = []
    count = 0
    for kind, start in _chunks_3ds(data, 0, len(data)):
        if kind == _VERTICES:
            count += len(vertices[-1]) if vertices else 0
            (n,) = struct.unpack_from("<H", data, start)
            vertices.append(np.frombuffer(data, "<f4", 3 * n, start + 2).reshape(n, 3).astype(np.float64))
        elif kind == _FACES:
            (n,) = struct.unpack_from("<H", data, start)
            faces.append(np.frombuffer(data, "<u2", 4 * n, start + 2).reshape(n, 4)[:, :3].astype(np.int64) + count)
            groups.append(np.full(n, "", dtype="U64"))
        elif kind == _FACE_MATERIAL:
            end = data.index(b"\0", start)
            (n,) = struct.unpack_from("<H", data, end + 1)
            groups[-1][np.frombuffer(data, "<u2", n, end + 3)] = data[start:end].decode("latin-1")
    if not faces:
        raise ValueError("it holds no triangles")
    return MeshFile(np.concatenate(vertices), np.concatenate(faces), np.concatenate(groups))


def _chunks_3ds(data: bytes, start: int, end: int) -> Iterator[tuple[int, int]]:
    """Yield (id, offset of the content) of every chunk in the order of the file, parents first."""
    while start + 6 <= end:
        kind, length = struct.unpack_from("<HI", data, start)
        stop = start + length
        if length < 6 or stop > end:
            raise ValueError(f"chunk {kind:04X} at byte {start} is longer than its parent")
        yield kind, start + 6
        if kind in _NESTED:
            yield from _chunks_3ds(data, start + 6, stop)
        elif kind == _OBJECT:
            yield from _chunks_3ds(data, data.index(b"\0", start + 6) + 1, stop)
        elif kind == _FACES:
            (n,) = struct.unpack_from("<H", data, start + 6)
            yield from _chunks_3ds(data, start + 8 + 8 * n, stop)
        start = stop


def read_obj(path: Path) -> MeshFile:
    """Read all faces of an .obj file as triangles, polygons as fans.

    Raises:
        ScenarioError: the file is missing or not an .obj file.
    """
    vertices, faces, groups, group = [], [], [], ""
    data = read_bytes(path, ".obj file", ScenarioError)
    with parsing(path, ".obj file", ScenarioError):
        for line in data.decode("latin-1").splitlines():
            word, _, rest = line.partition(" ")
            if word == "v":
                vertices.append([float(value) for value in rest.split()[:3]])
            elif word == "usemtl":
                group = rest.strip()
            elif word == "f":
                corner = [int(part.split("/")[0]) for part in rest.split()]
                corner = [row - 1 if row > 0 else len(vertices) + row for row in corner]
                for second, third in pairwise(corner[1:]):
                    faces.append([corner[0], second, third])
                    groups.append(group)
        return _checked(
            MeshFile(np.array(vertices, np.float64), np.array(faces, np.int64), np.array(groups, dtype="U64"))
        )


def _checked(mesh: MeshFile) -> MeshFile:
    """Return a mesh; ValueError unless it has triangles, a vertex for every corner and finite places."""
    if mesh.faces.shape[1:] != (3,) or mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise ValueError("it holds no triangles, or corners without a vertex")
    if not np.isfinite(mesh.vertices).all():
        raise ValueError("a vertex is not finite")
    return mesh
