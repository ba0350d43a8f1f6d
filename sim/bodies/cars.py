"""Cars and vans from the meshes that ship with SUMO."""

import numpy as np

from sim.errors import ScenarioError
from sim.mesh.materials import material_index
from sim.mesh.meshfiles import read_obj
from sim.mesh.solids import MeshPart, box, fit, join
from sim.roads.tools import sumo_home

_MATERIAL_OF_GROUP = {
    "windows": "glass",
    "lights": "head_lamp",
    "lights.red": "tail_lamp",
    "lights.orange": "indicator",
    "tires": "tyre",
    "metal": "metal",
}


def sumo_car(name: str, paint: str) -> MeshPart:
    """Return a car of SUMO with the materials of `sim.mesh`, in the body frame, scaled to a unit box.

    Args:
        name: file name below `data/3D` of SUMO, without its ending.

    Raises:
        ScenarioError: the file is missing or cannot be read.
    """
    file = read_obj(sumo_home() / "data" / "3D" / f"{name}.obj")
    unknown = {str(g) for g in file.group if not g.startswith("carmaterial")} - set(_MATERIAL_OF_GROUP)
    if unknown:
        raise ScenarioError(f"{name}.obj: unknown material {sorted(unknown)[0]!r}")
    # The file has y up and looks along +z with +x to its left: (x, y, z) becomes (z, x, y), a mere rotation.
    vertices = file.vertices[:, [2, 0, 1]]
    material = [material_index(_MATERIAL_OF_GROUP.get(str(group), paint)) for group in file.group]
    body = fit(MeshPart(vertices, file.faces, np.array(material, np.uint8)), (1.0, 1.0, 1.0))
    # Number plates flush with the bumpers, inside the box.
    plates = [box([x, -0.14, 0.26], [x + 0.004, 0.14, 0.335], "plate") for x in (-0.5, 0.496)]
    return join([body, *plates])
