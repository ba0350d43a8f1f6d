"""Triangles and rays: the only module that knows Embree.

A `TriangleScene` is one committed bounding volume hierarchy in its own frame. Moving things never rebuild it: their
rays are brought into its frame instead. Another engine needs the same two things: a constructor and `cast`.
"""

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """What N rays hit first.

    Attributes:
        distance: (N,) float32 in units of the direction's length, m for unit directions; the reach where missed.
        face: (N,) int32 row of the triangle, -1 where missed.
        cosine: (N,) float32 |cos| of the angle between the ray and the triangle's normal, 0 where missed.
    """

    distance: NDArray[np.float32]
    face: NDArray[np.int32]
    cosine: NDArray[np.float32]


class TriangleScene:
    """One set of triangles, ready for rays.

    Robust mode is the default: a sensor that stands exactly above a node of the ground mesh leaks no ray through
    the edges that meet there.
    """

    def __init__(self, vertices: NDArray[np.floating], faces: NDArray[np.integer], *, robust: bool = True) -> None:
        """Build the hierarchy of (F, 3) `faces` over (V, 3) `vertices`; near the origin float32 is precise."""
        self._scene = EmbreeScene(robust=robust)
        if len(faces):
            TriangleMesh(
                self._scene,
                np.ascontiguousarray(vertices, dtype=np.float32),
                np.ascontiguousarray(faces, dtype=np.int32),
            )
        # The first ray commits the scene; cast one here so that later calls are safe from several threads.
        self._scene.run(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32), np.ones(1, np.float32))

    def cast(self, origins: NDArray[np.float32], directions: NDArray[np.float32], reach: NDArray[np.float32]) -> Hits:
        """Cast N rays, each up to its own reach; both sides of a triangle are solid.

        Args:
            origins: (N, 3) m.
            directions: (N, 3) unit vectors; zero or NaN directions miss.
            reach: (N,) farthest distance, m; not changed.
        """
        # Embree overwrites the reach of each ray that hits.
        distance = np.array(reach, np.float32)
        found = self._scene.run(origins, directions, distance, output=1)
        face, normal = found["primID"], found["Ng"]
        # Normals of missed rays are left over from the ray before.
        normal[face < 0] = 0.0
        length = np.sqrt(np.einsum("ij,ij->i", normal, normal))
        length[length == 0.0] = 1.0
        cosine = np.abs(np.einsum("ij,ij->i", normal, directions)) / length
        return Hits(distance=distance, face=face, cosine=np.minimum(cosine, np.float32(1.0)))
