"""What does not move: the meshes of the world that a drive was recorded in, and the shapes of bodies."""

import logging
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsrc.review.palette import Rgb
from sim.errors import ScenarioError, UserError

log = logging.getLogger(__name__)


SINK_M = 0.12
"""The drawn world lies this much below the real one, so that points on the road lie on top of it."""


@dataclass(frozen=True, slots=True, eq=False)
class StaticPart:
    """One mesh of one colour.

    Attributes:
        name: of its node.
        vertices: (V, 3) float32, review frame.
        faces: (F, 3) uint32.
        rgb: its colour.
        opacity: None is opaque.
    """

    name: str
    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]
    rgb: Rgb
    opacity: float | None = None


@cache
def body_shape(class_name: str) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return the (V, 3) vertices and (F, 3) faces of a body of length, width and height 1, standing on z = 0."""
    from sim.bodies.choice import body_mesh, models_for, plain_models_for

    try:
        mesh = body_mesh(models_for(class_name)[0], (1.0, 1.0, 1.0))
    except ScenarioError:
        # SUMO, whose cars these are, need not be installed to look at a drive.
        mesh = body_mesh(plain_models_for(class_name)[0], (1.0, 1.0, 1.0))
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32)


@dataclass(frozen=True, slots=True)
class _Look:
    """Materials that are drawn as one mesh, and how."""

    name: str
    materials: tuple[str, ...]
    rgb: Rgb
    opacity: float | None = None


# Dark and unsaturated: the world is the stage, colours belong to agents and verdicts.
_LOOKS = (
    _Look("roads", ("asphalt", "gravel"), (30, 34, 42)),
    _Look("markings", ("marking",), (118, 126, 140)),
    _Look("pavements", ("pavement", "kerb"), (44, 49, 60)),
    _Look("green", ("ground", "hedge", "leaves", "bark"), (24, 38, 36)),
    _Look("buildings", ("brick", "plaster", "concrete", "roof", "glass"), (52, 60, 78), 0.55),
)
_REST = _Look("furniture", (), (72, 80, 96))


def static_parts(
    protocol: dict, origin: NDArray[np.float64], places: NDArray[np.float64], radius_m: float = 160.0
) -> list[StaticPart]:
    """Rebuild the static world of a drive, as far as it lies near the agents; empty when that is not possible.

    Args:
        protocol: content of the drive's `data_protocol.yaml`, {} when it has none.
        origin: (3,) world position of the review frame's origin, m.
        places: (N, 2) world positions near which the world is wanted, m.
        radius_m: how near.
    """
    own = protocol.get("testbed")
    if not isinstance(own, dict) or "scenario" not in own:
        return []
    try:
        mesh = _world(own["scenario"], int(own.get("seed", 0)))
    except (UserError, ImportError, ValueError) as error:
        # The drive is complete without it: a page without houses is better than no page.
        log.warning("the static world is not drawn: %s", error)
        return []
    return split_by_material(mesh, origin, places, radius_m)


def _world(scenario: dict, seed: int) -> Any:
    import msgspec

    from sim.scenario import Scenario
    from sim.world.build import build_world

    return build_world(msgspec.convert(scenario, Scenario), seed)


def split_by_material(
    mesh: Any, origin: NDArray[np.float64], places: NDArray[np.float64], radius_m: float
) -> list[StaticPart]:
    """Cut a world mesh to the surroundings of `places` (N, 2) and split it into the parts that are drawn alike."""
    from sim.mesh.materials import MATERIALS

    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)
    middle = vertices[faces].mean(axis=1)[:, :2]
    near = np.zeros(len(faces), bool)
    for place in places:
        near |= np.hypot(*(middle - place).T) <= radius_m
    look_of = {name: row for row, look in enumerate(_LOOKS) for name in look.materials}
    look_of_material = np.array([look_of.get(m.name, len(_LOOKS)) for m in MATERIALS])
    group = look_of_material[np.asarray(mesh.face_attributes["material"])]
    parts = []
    for row, look in enumerate((*_LOOKS, _REST)):
        chosen = faces[near & (group == row)]
        if len(chosen) == 0:
            continue
        used, flat = np.unique(chosen, return_inverse=True)
        moved = (vertices[used] - origin - [0.0, 0.0, SINK_M]).astype(np.float32)
        parts.append(StaticPart(look.name, moved, flat.reshape(-1, 3).astype(np.uint32), look.rgb, look.opacity))
    return parts
