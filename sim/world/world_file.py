"""World file: static world of a drive, and the body shapes from files of eclipse-sumo.

Whole millimetres, packed: usable on a machine without the maps, meshes and programs that built it.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from sim.bodies.choice import body_mesh, require_model
from sim.errors import DataError, complaint
from sim.mesh.materials import MATERIALS, material_index
from sim.mesh.solids import MeshPart, fit, to_mesh
from sim.packed import packed, read_arrays, unpacked, write_arrays
from sim.reading import parsing
from sim.traffic.base import from_steps, in_steps

VERSION = 1
GRID_M = 1e-3
"""Resolution of vertices, m; markings lie a centimetre above their road."""
_UNIT_GRID = 1e-5
"""Resolution of body vertices in a unit cube: a twentieth of a millimetre of a car."""

_STATIC = "static"


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Content of a world file.

    Attributes:
        static: static mesh, with `face_attributes["material"]`.
        shapes: body shape -> its mesh part in a unit box, in a placeholder paint that `body_mesh` replaces.
    """

    static: trimesh.Trimesh
    shapes: Mapping[str, MeshPart]

    def body_mesh(self, model: str, size_lwh: tuple[float, float, float]) -> trimesh.Trimesh:
        """Return the mesh of a body, of a stored shape if present; see `sim.bodies.choice.body_mesh`."""
        shape, _, paint = model.partition(":")
        if shape not in self.shapes:
            return body_mesh(model, size_lwh)
        require_model(model)
        part = self.shapes[shape]
        painted = part.material == material_index(_any_paint())
        material = np.where(painted, np.uint8(material_index(f"paint_{paint}")), part.material)
        return to_mesh(fit(MeshPart(part.vertices, part.faces, material), size_lwh))


def shapes_of(models: Iterable[str]) -> dict[str, MeshPart]:
    """Return the body shapes of models that need files of eclipse-sumo."""
    shapes = sorted({model.partition(":")[0] for model in models})
    return {shape: _sumo_shape(shape) for shape in shapes if shape.startswith("car-")}


def save_world(static: trimesh.Trimesh, shapes: Mapping[str, MeshPart], path: Path) -> Path:
    """Write a world file atomically; equal worlds give equal bytes.

    Args:
        static: triangles with `face_attributes["material"]`.
    """
    material = np.asarray(static.face_attributes["material"])
    parts = {_STATIC: MeshPart(np.asarray(static.vertices, np.float64), np.asarray(static.faces), material), **shapes}
    columns: dict[str, NDArray] = {"version": np.array(VERSION), "part": np.array(list(parts), dtype=np.str_)}
    for name, part in parts.items():
        columns |= {f"{name}/{key}": values for key, values in _columns(part, _grid(name)).items()}
    write_arrays(path, columns)
    return path


def load_world(path: Path) -> World:
    """Read a world file.

    Raises:
        DataError: the file is missing, damaged or no world.
    """
    columns = read_arrays(path, "static world")
    with parsing(path, "static world"):
        return _world(path, columns)


def _world(path: Path, columns: Mapping[str, NDArray]) -> World:
    if int(columns.get("version", np.array(-1))) != VERSION:
        raise DataError(
            complaint(path, "version", f"a world of version {VERSION}", str(columns.get("version", "none")))
        )
    names = [str(name) for name in np.atleast_1d(columns.get("part", np.array([], np.str_)))]
    if _STATIC not in names:
        raise DataError(complaint(path, "part", f"'{_STATIC}' among the parts", names))
    parts = {name: _piece(path, columns, name) for name in names}
    return World(to_mesh(parts.pop(_STATIC)), parts)


def _any_paint() -> str:
    return next(material.name for material in MATERIALS if material.name.startswith("paint_"))


@lru_cache(maxsize=8)
def _sumo_shape(shape: str) -> MeshPart:
    from sim.bodies.cars import sumo_car

    return sumo_car(shape, _any_paint())


def _grid(name: str) -> float:
    return GRID_M if name == _STATIC else _UNIT_GRID


def _columns(part: MeshPart, grid: float) -> dict[str, NDArray]:
    vertices = in_steps(np.asarray(part.vertices, np.float64), grid)
    used = np.unique(part.material)
    return {
        "materials": np.array([MATERIALS[index].name for index in used.tolist()], dtype=np.str_),
        "material": np.searchsorted(used, part.material).astype(np.uint8),
        "corner": packed(np.diff(np.asarray(part.faces, np.int64).ravel(), prepend=0)),
        **{axis: packed(np.diff(vertices[:, row], prepend=0)) for row, axis in enumerate("xyz")},
    }


def _piece(path: Path, columns: Mapping[str, NDArray], name: str) -> MeshPart:
    kinds = {"materials": ("U", 1), "material": ("u", 1), **dict.fromkeys(("x", "y", "z", "corner"), ("u", 2))}
    for key, (kind, axes) in kinds.items():
        array = columns.get(f"{name}/{key}")
        if array is None or array.dtype.kind != kind or array.ndim != axes:
            raise DataError(complaint(path, f"{name}/{key}", f"an array of {axes} axes and kind {kind}", "none"))
    x, y, z, corner = (np.cumsum(unpacked(columns[f"{name}/{key}"])) for key in ("x", "y", "z", "corner"))
    material, used = columns[f"{name}/material"], columns[f"{name}/materials"].tolist()
    if not len(x) == len(y) == len(z) or len(corner) != 3 * len(material):
        raise DataError(complaint(path, name, "three axes per vertex, three corners and a material per face", "others"))
    if len(corner) and not 0 <= corner.min() <= corner.max() < len(x):
        raise DataError(complaint(path, f"{name}/corner", f"rows of {len(x)} vertices", "others"))
    known = [one.name for one in MATERIALS]
    unknown = [one for one in used if one not in known]
    if unknown or (len(material) and int(material.max()) >= len(used)):
        found = unknown[0] if unknown else f"row {material.max()}"
        raise DataError(complaint(path, f"{name}/materials", "names of materials", found))
    index = np.array([known.index(one) for one in used], np.uint8)
    return MeshPart(from_steps(np.stack([x, y, z], axis=1), _grid(name)), corner.reshape(-1, 3), index[material])
