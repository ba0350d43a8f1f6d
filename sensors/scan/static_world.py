"""StaticWorld: static triangles in tiles; an engine gets only those around the sensors.

A city of millions of triangles is a mesh like any other:

    arrays = np.load("city.npz")
    mesh = trimesh.Trimesh(
        arrays["vertices"], arrays["faces"], face_attributes={"material": arrays["material"]}, process=False
    )
    scene = RayScene(mesh)
    del mesh, arrays

The world keeps its own copy, 12 bytes per vertex and 13 per triangle, so that the mesh can be freed; `process=False`
keeps trimesh from merging vertices, which takes memory and time. With 5.2 million triangles over 6.1 million vertices
the peak is 0.7 GB, 1.2 GB if `trimesh.load_mesh` reads them from GLB and 1.7 GB from binary PLY. STL, which shares no
vertices, and text formats take more. None of these formats keeps the materials, and GLB and STL hold float32:
coordinates must lie near their origin.
"""

import numpy as np
from numpy.typing import NDArray

from sensors.raycast import Solid

TILE_M = 250.0
"""Edge of a tile: a sensor at 10 m/s needs others every 25 s."""

TOGETHER_M = 500.0
"""Places within this of one another share a solid."""

WHOLE_M = 2000.0
WHOLE_FACES = 1_500_000
"""Largest extent along x and y, m, and number of triangles of a small world: at 1 km from the origin float32 shifts 99
of 100 points by less than 0.07 mm."""

_GRAIN_M = 2.0**-15
_CHUNK = 1 << 19
_KEPT = 16
_KEPT_FACES = 2_000_000


class StaticWorld:
    """The static triangles of a world.

    A small world is one solid. A large one is cut into square tiles; the tiles in use depend on the places of the
    sensors alone, so that a frame has the same bytes whichever frames were made before it.

    A triangle belongs to the tile that holds the middle of its bounding box, and a tile is as large as its triangles.
    A triangle larger than a tile, such as a plain below a city, belongs to no tile and is tested by itself.

    Attributes:
        height: lowest and highest z of the vertices in the world frame, m; zeros for an empty world.
    """

    def __init__(self, vertices: NDArray[np.float64], faces: NDArray[np.int32], material: NDArray[np.uint8]) -> None:
        """Sort the (F, 3) faces over (V, 3) vertices in the world frame into tiles."""
        low, high = (vertices.min(axis=0), vertices.max(axis=0)) if len(vertices) else np.zeros((2, 3))
        self.height: tuple[float, float] = (float(low[2]), float(high[2]))
        self._tiles: list[Solid] = []
        self._large = np.zeros((0, 3, 3))
        self._large_material = np.zeros(0, np.uint8)
        self._made: dict[tuple[bytes, ...], Solid] = {}
        self._is_whole = len(faces) <= WHOLE_FACES and float((high - low)[:2].max()) <= WHOLE_M
        boxes = [(low[:2], high[:2])]
        if self._is_whole:
            origin = np.round((low + high) / 2.0)
            self._tiles.append(Solid((vertices - origin).astype(np.float32), faces, material, origin))
        else:
            boxes = self._cut(vertices, faces, material)
        self._boxes = np.array(boxes, np.float64).reshape(-1, 2, 2).transpose(1, 2, 0).copy()
        self._large_boxes = np.stack([self._large.min(axis=1).T[:2], self._large.max(axis=1).T[:2]])

    def around(self, xy: NDArray[np.float64], reach_m: float) -> Solid:
        """Return at least the triangles within `reach_m` of any of (N, 2) places.

        Its origin is near the middle of the places: if they lie together, see `together`, float32 is good for 0.05 mm
        (99 of 100 points). The same object comes back while the places stay within their tiles.
        """
        cells = _cells(xy) if len(xy) else np.zeros((1, 2))
        low, high = cells * TILE_M - reach_m, (cells + 1) * TILE_M + reach_m
        tiles, large = _touching(self._boxes, low, high), _touching(self._large_boxes, low, high)
        if self._is_whole and tiles[0]:
            return self._tiles[0]
        # Half a tile, hence exact in float32: a world moved by whole tiles has the same solids.
        middle = 0.5 * TILE_M * (cells.min(axis=0) + cells.max(axis=0) + 1.0)
        key = (middle.tobytes(), np.packbits(tiles).tobytes(), np.packbits(large).tobytes())
        solid = self._made.pop(key, None)
        if solid is None:
            solid = self._join(middle, np.flatnonzero(tiles), np.flatnonzero(large))
        self._made[key] = solid
        while len(self._made) > 1 and (
            len(self._made) > _KEPT or sum(len(made.faces) for made in self._made.values()) > _KEPT_FACES
        ):
            self._made.pop(next(iter(self._made)))
        return solid

    def _cut(
        self, vertices: NDArray[np.float64], faces: NDArray[np.int32], material: NDArray[np.uint8]
    ) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """Fill the tiles and return the bounding box of each."""
        cell = np.zeros((len(faces), 2), np.int32)
        is_large = np.zeros(len(faces), bool)
        # Corners of all triangles at once would take more memory than the world itself.
        for start in range(0, len(faces), _CHUNK):
            rows = slice(start, start + _CHUNK)
            corners = vertices[faces[rows], :2]
            low, high = corners.min(axis=1), corners.max(axis=1)
            cell[rows] = np.floor((low + high) / (2.0 * TILE_M))
            is_large[rows] = (high - low).max(axis=1) > TILE_M
        self._large, self._large_material = _grainy(vertices[faces[is_large]]), material[is_large]
        order = np.lexsort((cell[:, 1], cell[:, 0]))
        order = order[~is_large[order]]
        borders = np.flatnonzero((np.diff(cell[order], axis=0) != 0).any(axis=1)) + 1
        boxes = []
        for tile in np.split(order, borders) if len(order) else []:
            used, local = np.unique(faces[tile], return_inverse=True)
            corners = _grainy(vertices[used])
            low, high = corners.min(axis=0), corners.max(axis=0)
            origin = np.round((low + high) / 2.0)
            self._tiles.append(
                Solid(
                    (corners - origin).astype(np.float32),
                    local.reshape(-1, 3).astype(np.int32),
                    material[tile],
                    origin,
                )
            )
            boxes.append((low[:2], high[:2]))
        return boxes

    def _join(self, middle: NDArray[np.float64], tiles: NDArray[np.int64], large: NDArray[np.int64]) -> Solid:
        """Return the triangles of some tiles and some large ones as one solid."""
        chosen, corners = [self._tiles[row] for row in tiles], self._large[large]
        levels = [tile.origin[2] for tile in chosen] or corners[:, :, 2].ravel().tolist() or [0.0]
        origin = np.array([*middle, np.round(np.mean(levels))])
        first = np.cumsum([0, *(len(tile.vertices) for tile in chosen)])
        vertices = [(tile.vertices + (tile.origin - origin)).astype(np.float32) for tile in chosen]
        faces = [tile.faces + start for tile, start in zip(chosen, first[:-1].astype(np.int32), strict=True)]
        single = np.arange(3 * len(large), dtype=np.int32).reshape(-1, 3) + np.int32(first[-1])
        return Solid(
            np.concatenate([*vertices, (corners - origin).astype(np.float32).reshape(-1, 3)]),
            np.concatenate([*faces, single]),
            np.concatenate([*(tile.material for tile in chosen), self._large_material[large]]),
            origin,
        )


def _grainy(vertices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return coordinates to 15 um: exact in float32 up to 512 m from whole metres, thus the same in all tiles."""
    return np.round(vertices / _GRAIN_M) * _GRAIN_M


def together(xy: NDArray[np.float64]) -> list[NDArray[np.int64]]:
    """Return the rows of (N, 2) places in groups that can share a solid: within `TOGETHER_M` of the first of them."""
    left, groups = np.arange(len(xy)), []
    while len(left):
        far = np.abs(xy[left] - xy[left[0]]).max(axis=1) > TOGETHER_M
        groups.append(left[~far])
        left = left[far]
    return groups


def _cells(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (C, 2) rows and columns of the tiles that hold (N, 2) places, each once, in order."""
    cells = np.floor(np.asarray(xy, np.float64) / TILE_M)
    # Along a sensor's way most places lie in the tile of the one before.
    moved = np.concatenate([[True], (cells[1:] != cells[:-1]).any(axis=1)])
    return np.array(sorted(set(map(tuple, cells[moved].tolist()))))


def _touching(boxes: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (T,) whether (2, 2, T) lowest and highest x and y touch any of the squares from (C, 2) to (C, 2)."""
    touching = np.zeros(boxes.shape[2], bool)
    for (west, south), (east, north) in zip(low.tolist(), high.tolist(), strict=True):
        along = (boxes[0, 0] <= east) & (boxes[1, 0] >= west)
        touching |= along & (boxes[0, 1] <= north) & (boxes[1, 1] >= south)
    return touching
