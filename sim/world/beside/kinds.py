"""Kinds of place along a street, derived from the map, and what stands there.

Shares and counts per 100 m of road edge are guesses within what street views of German towns, Helsinki and the
sceneries of KITTI (Karlsruhe: Geiger et al. 2013) show: no survey counts hedges.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely

from sim.world.roads.streets import Lane
from sim.world.roads.surfaces import TOWN_SPEED_MPS

Kind = Literal["town", "suburb", "rural", "motorway"]

_AROUND_M = 30.0
_TOWN_SHARE, _SUBURB_SHARE = 0.22, 0.02
"""Share of the ground within `_AROUND_M` of a lane that houses cover, from which it is a town or a suburb."""


@dataclass(frozen=True, slots=True)
class Density:
    """What stands along a road edge of a kind of place.

    Attributes:
        boundary: share of the edge by what bounds the plots: "hedge", "shrubs" or a kind of `fences.HEIGHT_M`; the rest
            is open.
        kerb: the same along the kerb, where the pavement is wide enough.
        bay: the same right behind parking bays.
        trees: trees behind the boundary, per 100 m.
        row: trees along the kerb, where a verge gives room, per 100 m.
        shrubs: single shrubs, per 100 m.
        grass: tufts, per 100 m.
        things: other things by name, per 100 m.
        species: which trees.
    """

    boundary: dict[str, float]
    kerb: dict[str, float]
    bay: dict[str, float]
    trees: float
    row: float
    shrubs: float
    grass: float
    things: dict[str, float]
    species: tuple[str, ...]


DENSITIES: dict[Kind, Density] = {
    "town": Density(
        boundary={"hedge": 0.52, "shrubs": 0.18, "wall": 0.14, "railing": 0.03, "picket": 0.03, "boards": 0.08},
        kerb={"hedge": 0.30, "shrubs": 0.18, "railing": 0.10},
        bay={"hedge": 0.28, "shrubs": 0.26, "wall": 0.12, "boards": 0.05},
        trees=5.0,
        row=4.0,
        shrubs=16.0,
        grass=10.0,
        things={
            "sign": 2.5,
            "bins": 1.2,
            "litter_bin": 1.0,
            "cabinet": 1.0,
            "bollard": 3.0,
            "bench": 0.6,
            "planter": 2.0,
            "bicycles": 1.2,
            "bus_stop": 0.25,
        },
        species=("lime", "plane", "maple", "cherry", "birch"),
    ),
    "suburb": Density(
        boundary={"hedge": 0.50, "shrubs": 0.22, "picket": 0.06, "mesh": 0.02, "wall": 0.08, "boards": 0.08},
        kerb={"hedge": 0.28, "shrubs": 0.22},
        bay={"hedge": 0.30, "shrubs": 0.30, "wall": 0.06, "boards": 0.06},
        trees=7.0,
        row=4.0,
        shrubs=20.0,
        grass=25.0,
        things={
            "sign": 1.5,
            "bins": 1.5,
            "cabinet": 0.8,
            "bollard": 0.5,
            "pole": 1.2,
            "bicycles": 0.3,
            "bus_stop": 0.2,
        },
        species=("lime", "maple", "oak", "birch", "cherry", "spruce", "pine"),
    ),
    "rural": Density(
        boundary={"shrubs": 0.64, "hedge": 0.20, "mesh": 0.06},
        kerb={"shrubs": 0.20},
        bay={"hedge": 0.20, "shrubs": 0.40},
        trees=9.0,
        row=3.0,
        shrubs=30.0,
        grass=90.0,
        things={"sign": 1.0, "delineator": 2.0, "pole": 1.5, "place_name": 0.2},
        species=("oak", "lime", "maple", "birch", "poplar", "spruce", "pine"),
    ),
    "motorway": Density(
        boundary={"shrubs": 0.60, "noise": 0.25, "mesh": 0.04},
        kerb={},
        bay={},
        trees=9.0,
        row=0.0,
        shrubs=36.0,
        grass=90.0,
        things={"sign": 0.5, "delineator": 2.0, "place_name": 0.3},
        species=("oak", "maple", "birch", "poplar", "spruce", "pine"),
    ),
}
"""What stands along a road edge by kind of place."""


def kinds_of(lanes: list[Lane], footprint: shapely.Geometry) -> list[Kind]:
    """Return the kind of place along each lane, by its limit, its opposite lanes and the houses around it.

    Args:
        footprint: polygon of the houses.
    """
    around = [shapely.LineString(lane.line).buffer(_AROUND_M + 0.5 * lane.width, quad_segs=2) for lane in lanes]
    houses = np.array([part for part in shapely.get_parts(footprint) if part.geom_type == "Polygon"], object)
    covered = np.zeros(len(lanes))
    if len(houses) and len(lanes):
        row, house = shapely.STRtree(houses).query(np.array(around, object), predicate="intersects")
        common = shapely.area(shapely.intersection(np.array(around, object)[row], houses[house]))
        np.add.at(covered, row, common)
    shares = covered / np.array([shape.area for shape in around]) if lanes else covered
    return [_kind(lane, float(share)) for lane, share in zip(lanes, shares, strict=True)]


def _kind(lane: Lane, houses: float) -> Kind:
    if lane.speed > TOWN_SPEED_MPS:
        return "motorway" if not lane.opposite else "rural"
    if houses >= _TOWN_SHARE:
        return "town"
    return "suburb" if houses >= _SUBURB_SHARE else "rural"
