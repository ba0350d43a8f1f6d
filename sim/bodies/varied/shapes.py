"""Body shapes of worlds of version 2 by name: the mesh part of `shape/variant:look`."""

from collections.abc import Callable
from typing import TYPE_CHECKING

from sim.bodies.varied.looks import is_look
from sim.bodies.varied.types import VARIED

if TYPE_CHECKING:
    from sim.mesh.solids import MeshPart


def is_varied(model: str) -> bool:
    """Return whether a name is that of a body of a world of version 2."""
    shape, _, rest = model.partition("/")
    variant, _, look = rest.partition(":")
    known = (one for one in VARIED.values() if one.shape == shape and variant in dict(one.variants))
    return any(is_look(one.looks, look) for one in known)


def varied_shape(model: str) -> "MeshPart":
    """Return the mesh part of a model in its own proportions, in the body frame."""
    from sim.bodies.varied import cars, cycles, heavy, walkers

    shape, _, rest = model.partition("/")
    variant, _, look = rest.partition(":")
    first, _, second = look.partition("+")
    load = "" if variant == "plain" else variant
    if shape in cars.FORMS:
        return cars.car(shape, first, "clear" if variant == "plain" else variant)  # type: ignore[arg-type]
    if shape in walkers.GAITS:
        return walkers.person(shape, load, first, second)  # type: ignore[arg-type]
    makers: dict[str, Callable[[], MeshPart]] = {
        "light_lorry": lambda: heavy.light_lorry(first),
        "box_lorry": lambda: heavy.box_lorry(first),
        "tipper": lambda: heavy.tipper(first),
        "flatbed": lambda: heavy.flatbed(first),
        "tanker": lambda: heavy.tanker(first),
        "semi_trailer": lambda: heavy.semi_trailer(
            first, curtain="tarpaulin_blue" if variant == "blue" else "tarpaulin"
        ),
        "midi_bus": lambda: heavy.midi_bus(first, variant),
        "city_bus": lambda: heavy.city_bus(first, variant),
        "coach": lambda: heavy.coach(first, variant),
        "road_motorcycle": lambda: cycles.road_motorcycle(first, second),
        "tourer": lambda: cycles.road_motorcycle(first, second, cases=True),
        "scooter": lambda: cycles.scooter(first, second, load=load),
        "city_bike": lambda: cycles.city_bike(first, second, load=load),
        "racing_bike": lambda: cycles.racing_bike(first, second),
        "cargo_bike": lambda: cycles.cargo_bike(first, second, cover=variant == "cover"),
    }
    return makers[shape]()
