"""Trees of several species: a trunk, boughs and a crown of leaves that rays pass and graze.

Heights and crowns are those of trees of 15 to 40 years in streets: GALK Strassenbaumliste (2012 and later) and
E. G. McPherson, N. S. van Doorn and P. J. Peper, Urban Tree Database and Allometric Equations (USDA PSW-GTR-253, 2016).
Densities of leaves let a few to thirty per cent of the rays pass a crown, the range of J. Konarska et al.,
Transmissivity of solar radiation through crowns of single urban trees (Theor. Appl. Climatol. 117, 2014) and Á. Takács
et al., Transmissivity characteristics of urban trees (Hungarian Geographical Bulletin 65, 2016). Trees at a kerb are
pruned to 4.8 m over the carriageway and 2.6 m over footways (RASt 06, clearances of 4.5 and 2.5 m).
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from sim.geometry import Array
from sim.mesh.solids import MeshPart, join, tube
from sim.world.beside.foliage import in_cone, in_ellipsoid, leaves


@dataclass(frozen=True, slots=True)
class Species:
    """Species of tree.

    Attributes:
        crown: its form: ellipsoid or cone.
        height_m: range of heights.
        slenderness: width of the crown over the height of the tree.
        foot_m: range of heights where the crown begins, before pruning.
        density: leaf area per volume of the crown, m2/m3.
    """

    name: str
    crown: Literal["ellipsoid", "cone"]
    height_m: tuple[float, float]
    slenderness: float
    foot_m: tuple[float, float]
    density: float


SPECIES = {
    species.name: species
    for species in (
        Species("lime", "ellipsoid", (8.0, 15.0), 0.50, (1.8, 3.0), 0.95),
        Species("plane", "ellipsoid", (9.0, 16.0), 0.62, (2.2, 3.5), 0.70),
        Species("maple", "ellipsoid", (6.5, 12.0), 0.58, (1.8, 2.6), 0.95),
        Species("oak", "ellipsoid", (9.0, 16.0), 0.65, (1.6, 3.0), 0.80),
        Species("birch", "ellipsoid", (8.0, 14.0), 0.36, (1.2, 2.5), 0.60),
        Species("cherry", "ellipsoid", (4.0, 7.0), 0.70, (1.1, 1.8), 1.10),
        Species("poplar", "ellipsoid", (12.0, 18.0), 0.20, (0.6, 1.5), 1.10),
        Species("spruce", "cone", (6.0, 14.0), 0.38, (0.1, 0.8), 1.40),
        Species("pine", "ellipsoid", (8.0, 14.0), 0.40, (3.0, 6.0), 0.70),
    )
}
"""Species by name."""

LEAVES_PER_TREE = 190
_BOUGHS = 4
_INNER = 0.35


@dataclass(frozen=True, slots=True, eq=False)
class Tree:
    """Tree at the origin.

    Attributes:
        part: its triangles.
        reach_m: how far it reaches from its trunk.
        foot_m: height of its lowest leaf.
    """

    part: MeshPart
    reach_m: float
    foot_m: float


def tree(rng: np.random.Generator, species: Species, *, fine: bool = True) -> Tree:
    """Return a tree at the origin.

    Args:
        fine: with all leaves; else a quarter of them, four times as large, for trees that no sensor comes near.
    """
    height = float(rng.uniform(*species.height_m))
    foot = min(float(rng.uniform(*species.foot_m)), 0.5 * height)
    radius = 0.5 * species.slenderness * height
    count = LEAVES_PER_TREE if fine else LEAVES_PER_TREE // 4
    middle, volume = _crown(rng, species, count, foot, height, radius)
    area = species.density * volume / count
    crown = leaves(rng, middle, rng.uniform(0.6, 1.4, count) * area)
    # No leaf reaches beyond the crown, whose radius decides on the position of a tree.
    reach = radius + 0.3
    out = np.hypot(*crown.vertices[:, :2].T)
    crown.vertices[:, :2] *= np.minimum(1.0, reach / np.maximum(out, 1e-9))[:, None]
    crown.vertices[:, 2] = np.maximum(crown.vertices[:, 2], foot)
    return Tree(join([*_wood(rng, species, foot, height, radius), crown]), reach, foot)


def _crown(
    rng: np.random.Generator, species: Species, count: int, foot: float, height: float, radius: float
) -> tuple[Array, float]:
    """Return (count, 3) positions of leaves and the volume of the crown, m3."""
    if species.crown == "cone":
        return in_cone(rng, count, foot, height, radius), np.pi / 3.0 * radius**2 * (height - foot)
    radii = np.array([radius, radius, 0.5 * (height - foot)])
    middle = in_ellipsoid(rng, count, [0.0, 0.0, 0.5 * (foot + height)], radii, _INNER)
    return middle, 4.0 / 3.0 * np.pi * float(radii.prod())


def _wood(rng: np.random.Generator, species: Species, foot: float, height: float, radius: float) -> list[MeshPart]:
    thick = 0.013 * height + 0.02
    top = foot + (0.9 if species.crown == "cone" else 0.55) * (height - foot)
    parts = [tube([0.0, 0.0, -0.3], [0.0, 0.0, top], (thick, 0.35 * thick), "bark", 6)]
    if species.crown == "ellipsoid":
        for angle in rng.uniform(0.0, 2.0 * np.pi) + 2.0 * np.pi / _BOUGHS * np.arange(_BOUGHS):
            start = [0.0, 0.0, foot + 0.1 * (height - foot)]
            out = 0.65 * radius
            end = [out * np.cos(angle), out * np.sin(angle), foot + float(rng.uniform(0.4, 0.6)) * (height - foot)]
            parts.append(tube(start, end, (0.4 * thick, 0.1 * thick), "bark", 3))
    return parts


def pruned(whole: Tree, foot_m: float) -> Tree:
    """Return a tree without leaves below a height; its crown is squeezed upwards, its trunk stays."""
    if whole.foot_m >= foot_m:
        return whole
    vertices = whole.part.vertices.copy()
    top = float(vertices[:, 2].max())
    above = vertices[:, 2] >= whole.foot_m
    share = (vertices[above, 2] - whole.foot_m) / (top - whole.foot_m)
    vertices[above, 2] = foot_m + share * (max(top, foot_m + 2.0) - foot_m)
    return Tree(MeshPart(vertices, whole.part.faces, whole.part.material), whole.reach_m, foot_m)
