"""Body models of road users: names by class, and the mesh of a model at any size.

Body frame: x forward, y left, z up, origin in the middle of the footprint at road level. The extents of a mesh are
exactly the box of its road user.
"""

from functools import lru_cache
from typing import TYPE_CHECKING

from sim.bodies.varied.shapes import is_varied, varied_shape
from sim.errors import SettingsError, did_you_mean
from sim.streams import Stream, random_generator

if TYPE_CHECKING:
    import trimesh

    from sim.mesh.solids import MeshPart

_PAINTS = ("silver", "white", "black", "blue", "red")
_CLOTHES = ("light", "dark")

MODELS: dict[str, tuple[str, ...]] = {
    "car": tuple(f"car-normal-citrus:{paint}" for paint in _PAINTS),
    "van": tuple(f"{van}:{paint}" for van in ("car-microcargo-citrus", "car-minibus-citrus") for paint in _PAINTS),
    "truck": ("truck:white", "truck:silver", "truck:blue", "truck:red"),
    "bus": ("bus:yellow", "bus:white", "bus:red"),
    "motorcycle": ("motorcycle:black", "motorcycle:red", "motorcycle:blue"),
    "bicycle": tuple(f"bicycle:{cloth}" for cloth in _CLOTHES),
    "pedestrian": tuple(f"pedestrian-{pose}:{cloth}" for pose in ("walking", "standing") for cloth in _CLOTHES),
}
"""Model names by class: shape, colon, paint or clothes."""

_GENERIC: dict[str, tuple[str, ...]] = {
    "car": tuple(f"{shape}:{paint}" for shape in ("saloon", "hatchback") for paint in _PAINTS),
    "van": tuple(f"panel_van:{paint}" for paint in _PAINTS),
}


def models_for(class_name: str) -> tuple[str, ...]:
    """Return the models of a class.

    Raises:
        SettingsError: the class is unknown.
    """
    if class_name not in MODELS:
        raise SettingsError(f"unknown class '{class_name}'{did_you_mean(class_name, MODELS)}")
    return MODELS[class_name]


def choose_model(class_name: str, name: str, seed: int) -> str:
    """Return the body model of the road user `name`: a function of its name and the seed alone."""
    models = models_for(class_name)
    rng = random_generator(seed, Stream.BODY_MODEL, name)
    return models[int(rng.integers(len(models)))]


def generic_models_for(class_name: str) -> tuple[str, ...]:
    """Return the models of a class that work without SUMO's files; raises as `models_for`."""
    return _GENERIC.get(class_name) or models_for(class_name)


def require_model(model: str) -> None:
    """Raise SettingsError for a model that is none of `MODELS`, `generic_models_for` or `sim.bodies.varied`."""
    if "/" in model and is_varied(model):
        return
    known = [name for models in (MODELS, _GENERIC) for names in models.values() for name in names]
    if model not in known:
        raise SettingsError(f"unknown model '{model}'{did_you_mean(model, known)}")


@lru_cache(maxsize=1024)
def body_mesh(model: str, size_lwh: tuple[float, float, float]) -> "trimesh.Trimesh":
    """Return the mesh of a model scaled to a size; shared, so do not modify it.

    Args:
        model: a name of `MODELS` or `generic_models_for`, or shape/variant:look of a world of version 2.
        size_lwh: length along x, width and height, m.

    Returns:
        A mesh with x and y centred on 0 and z in [0, h], `face_attributes["material"]` as in the static world.

    Raises:
        SettingsError: the model is unknown or the size is not positive.
    """
    from sim.mesh.solids import to_mesh

    return to_mesh(body_part(model, size_lwh))


def body_part(model: str, size_lwh: tuple[float, float, float]) -> "MeshPart":
    """Return the triangles of `body_mesh`; raises as that."""
    require_model(model)
    if len(size_lwh) != 3 or not all(0.0 < value < 100.0 for value in size_lwh):
        raise SettingsError(f"size of {model}: expected three lengths in (0, 100) m, found {tuple(size_lwh)}")
    from sim.mesh.solids import fit

    return fit(_shape(model), size_lwh)


@lru_cache(maxsize=256)
def _shape(model: str) -> "MeshPart":
    """Return the mesh part of a model in its own proportions, in the body frame."""
    from sim.bodies import generic, people, trucks

    if "/" in model:
        return varied_shape(model)
    shape, _, variant = model.partition(":")
    if shape.startswith("car-"):
        from sim.bodies.cars import sumo_car

        return sumo_car(shape, f"paint_{variant}")
    if shape in ("saloon", "hatchback", "panel_van"):
        return getattr(generic, shape)(f"paint_{variant}")
    if shape.startswith("pedestrian-"):
        return people.pedestrian(f"cloth_{variant}", walking=shape.endswith("walking"))
    if shape == "bicycle":
        return people.bicycle(f"cloth_{variant}")
    if shape == "motorcycle":
        return people.motorcycle(f"paint_{variant}")
    return trucks.truck(f"paint_{variant}") if shape == "truck" else trucks.bus(f"paint_{variant}")
