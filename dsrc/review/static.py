"""Static world of a drive as coloured meshes, and unit meshes of bodies."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsrc.data.drive_folder import WORLD
from sim.boxes import CLASSES
from sim.errors import DataError, ScenarioError, UserError

SINK_M = 0.12
"""Depth of the drawn world below the real one, m: points on the road stay visible."""
GROUND_SINK_M = 0.4
"""The same of the ground: from afar a browser cannot tell which of two planes some centimetres apart is in front."""
AROUND_M = 160.0
"""Distance from the agents within which the world is drawn, m."""
_GROUND = "ground"


@dataclass(frozen=True, slots=True, eq=False)
class StaticPart:
    """Mesh of one colour, see `dsrc.review.palette.Look`.

    Attributes:
        name: of its node and its colour.
        vertices: (V, 3) float32, review frame.
        faces: (F, 3) uint32.
        opacity: None for opaque.
    """

    name: str
    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]
    opacity: float | None = None


@cache
def body_shape(class_name: str) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """(V, 3) vertices and (F, 3) faces of a body of length, width and height 1, standing on z = 0."""
    from sim.bodies.choice import body_part, generic_models_for, models_for

    try:
        part = body_part(models_for(class_name)[0], (1.0, 1.0, 1.0))
    except ScenarioError:
        # The cars are SUMO's, which reviewing a drive does not need.
        part = body_part(generic_models_for(class_name)[0], (1.0, 1.0, 1.0))
    return np.asarray(part.vertices, np.float32), np.asarray(part.faces, np.uint32)


def load_bodies() -> None:
    """Load the shapes of all classes."""
    for class_name in CLASSES:
        body_shape(class_name)


# Parts of the world and their materials; the last one has the rest.
_PARTS = {
    "roads": ("asphalt", "gravel"),
    "markings": ("marking",),
    "pavements": ("pavement", "kerb"),
    _GROUND: ("ground",),
    "plants": ("hedge", "leaves", "bark"),
    "buildings": ("brick", "plaster", "concrete", "roof", "glass"),
    "furniture": (),
}
_OPACITY = {"buildings": 0.55}


def static_parts(
    protocol: dict,
    origin: NDArray[np.float64],
    places: NDArray[np.float64],
    folder: Path | None = None,
    radius_m: float = AROUND_M,
) -> list[StaticPart]:
    """Static world of a drive near the agents; empty when the drive names no scenario.

    Args:
        protocol: content of the drive's `data_protocol.yaml`, {} without one.
        folder: of the drive, whose file of the world is read; where there is none the world is built again.
        origin: (3,) world position of the review frame's origin, m.
        places: (N, 2) world positions whose surroundings are drawn, m.

    Raises:
        DataError: the world cannot be read or built: its file is damaged, or its network, SUMO or a file is missing.
    """
    own = protocol.get("testbed")
    if not isinstance(own, dict) or "scenario" not in own:
        return []
    try:
        mesh = _world(own["scenario"], int(own.get("seed", 0)), folder)
    except (UserError, ImportError, ValueError, TypeError, OverflowError) as error:
        raise DataError(f"roads and buildings are not drawn: {error}") from None
    return split_by_material(mesh, origin, places, radius_m)


def _world(scenario: dict, seed: int, folder: Path | None) -> Any:
    # The world of a city takes a minute to build, and is another one where it is built by later code.
    if folder is not None and (folder / WORLD).is_file():
        from sim.world.world_file import load_world

        return load_world(folder / WORLD).static
    import msgspec

    from dsrc.closed_loop.kept import kept_world
    from sim.scenario import Scenario

    return kept_world(msgspec.convert(scenario, Scenario), seed)


def split_by_material(
    mesh: Any, origin: NDArray[np.float64], places: NDArray[np.float64], radius_m: float
) -> list[StaticPart]:
    """Cut a world mesh to the surroundings of `places` (N, 2) and split it by drawing style."""
    from sim.mesh.materials import MATERIALS

    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    near = _near(vertices, faces, places, radius_m)
    part_of = {material: row for row, materials in enumerate(_PARTS.values()) for material in materials}
    part_of_material = np.array([part_of.get(material.name, len(_PARTS) - 1) for material in MATERIALS])
    group = part_of_material[np.asarray(mesh.face_attributes["material"])]
    parts = []
    for row, name in enumerate(_PARTS):
        group_faces = faces[near & (group == row)]
        if len(group_faces) == 0:
            continue
        used, flat = np.unique(group_faces, return_inverse=True)
        sink = GROUND_SINK_M if name == _GROUND else SINK_M
        moved = (vertices[used] - origin - [0.0, 0.0, sink]).astype(np.float32)
        parts.append(StaticPart(name, moved, flat.reshape(-1, 3).astype(np.uint32), _OPACITY.get(name)))
    return parts


def cut_around(parts: Sequence[StaticPart], place: NDArray[np.float64], radius_m: float) -> list[StaticPart]:
    """Parts cut to the surroundings of a place (2,) in the review frame, m."""
    made = []
    for part in parts:
        used, flat = np.unique(part.faces[_near(part.vertices, part.faces, place[None], radius_m)], return_inverse=True)
        if len(used):
            made.append(replace(part, vertices=part.vertices[used], faces=flat.reshape(-1, 3).astype(np.uint32)))
    return made


def _near(
    vertices: NDArray[np.floating], faces: NDArray[np.integer], places: NDArray[np.float64], radius_m: float
) -> NDArray[np.bool_]:
    """(F,) mask of the faces near places (N, 2)."""
    corners = vertices[faces, :2]
    low, high = corners.min(axis=1), corners.max(axis=1)
    near = np.zeros(len(faces), bool)
    for place in places:
        # To the box around a face: the ground is two triangles whose middles are far from everything.
        near |= np.hypot(*(np.clip(place, low, high) - place).T) <= radius_m
    return near
