"""Building blocks of encounters: vehicle types, straight paths, houses and hedges."""

from collections.abc import Sequence

import numpy as np
import shapely

from sim.encounters.paths import PathBuilder, ReferencePath
from sim.encounters.types import HIT_S, Parameter, Structure
from sim.geometry import Array

CARS = ("car_small", "car_compact", "car_saloon", "car_estate", "car_suv")
VANS = ("van_people", "van_box")

EAST, NORTH, WEST, SOUTH = 0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi

AFTER_S = 9.0
"""Duration of paths after the time of the crash, s, for actors that do not crash."""

SPARE_M = 12.0

JITTER = Parameter("jitter_s", -0.5, 0.5, (-0.15, 0.15), "delay of the conflict actor at the crossing of the paths")


def pick(names: Sequence[str], rng: np.random.Generator) -> str:
    """Draw one of the names."""
    return names[int(rng.integers(len(names)))]


def straight_path(x: float, y: float, heading: float, speed_mps: float) -> tuple[ReferencePath, float]:
    """Return a straight path that reaches (x, y) at `HIT_S`, and the distance of that point along it, m."""
    before = speed_mps * HIT_S + SPARE_M
    pen = PathBuilder(x - before * np.cos(heading), y - before * np.sin(heading), heading)
    return pen.straight(before + speed_mps * AFTER_S + SPARE_M).path(), before


def block(x: float, y: float, other_x: float, other_y: float) -> shapely.Polygon:
    """Return the rectangle between any two opposite corners."""
    return shapely.box(min(x, other_x), min(y, other_y), max(x, other_x), max(y, other_y))


def corner_house(
    x: float, y: float, along_x: float, along_y: float, height_m: float, occluder: bool = True
) -> Structure:
    """Return a house of two wings, 12 m deep, with signed lengths `along_x` and `along_y` from a corner."""
    dx, dy = np.copysign(12.0, along_x), np.copysign(12.0, along_y)
    outline = block(x, y, x + along_x, y + dy) | block(x, y, x + dx, y + along_y)
    return Structure("building", outline, height_m, occluder)


def band(line: Array, inner_m: float, outer_m: float) -> shapely.Polygon:
    """Return the band between two distances to the left of a (K, 2) line, or to its right when they are negative."""
    inner, outer = (shapely.LineString(line).offset_curve(d) for d in (inner_m, outer_m))
    return shapely.Polygon([*inner.coords, *reversed(outer.coords)]).buffer(0)
