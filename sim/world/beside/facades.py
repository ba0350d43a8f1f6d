"""Relief of facades: plinths, cornices, pilasters, sills, bays, balconies, awnings, steps and climbing plants.

Depths are those of houses of 1870 to today in German towns (E. Neufert, Bauentwurfslehre): sills 0.1 to 0.2 m,
pilasters 0.1 to 0.25 m, bays 0.6 to 0.9 m, balconies 1.0 to 1.5 m deep with parapets of 0.9 to 1.1 m (MBO §38), steps
of 0.17 by 0.29 m (DIN 18065), awnings 2.5 m above the pavement (RASt 06).
"""

import numpy as np
import shapely

from sim.geometry import Array
from sim.mesh.materials import material_index
from sim.mesh.solids import MeshPart, join, mesh_part
from sim.roads.polygons import STOREY_M
from sim.world.beside.foliage import leaves
from sim.world.beside.ground import Ground
from sim.world.buildings.facades import WALLS, face_outside, wall_groups

_FACING_M = 20.0
_LENGTH_M, _HEIGHT_M = 4.0, 2.8
_BAY_M = 2.6
_HIGHEST_M = 6.2
"""Relief above is left out: few beams meet it."""


class _Relief:
    """Boxes before one wall: x along it, y out of it, z above its foot."""

    def __init__(self, wall: Array, foot: float, high: float) -> None:
        way = wall[1] - wall[0]
        self.length = float(np.hypot(*way))
        self.start, self.way = wall[0], way / self.length
        self.out = np.array([self.way[1], -self.way[0]])
        self.foot, self.top = foot, min(high - foot, _HIGHEST_M)
        self.boxes: list[tuple[str, Array]] = []

    def box(self, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], material: str) -> None:
        """Add a box, clipped to the wall's length and height."""
        low, high = max(x[0], 0.05), min(x[1], self.length - 0.05)
        if high - low > 0.04 and z[1] <= self.top + 0.3:
            corners = np.array(
                [[a, b, c] for c in z for a, b in ((low, y[0]), (high, y[0]), (high, y[1]), (low, y[1]))]
            )
            self.boxes.append((material, self.placed(corners)))

    def placed(self, corners: Array) -> Array:
        """Return (N, 3) positions in the world."""
        flat = self.start + corners[:, :1] * self.way + corners[:, 1:2] * self.out
        return np.column_stack([flat, self.foot + corners[:, 2]])


_FACES = np.array([[3, 2, 6], [3, 6, 7], [4, 7, 6], [4, 6, 5], [0, 3, 7], [0, 7, 4], [1, 5, 6], [1, 6, 2]])[:, ::-1]
"""Front, top and ends of a box; its back lies in the wall, its bottom is out of sight of a sensor on a roof."""


def relief(rng: np.random.Generator, parts: list[MeshPart], houses: shapely.Geometry, ground: Ground) -> list[MeshPart]:
    """Return the relief of the walls that face a street.

    Args:
        parts: triangles of the houses.
        houses: polygon of the houses.
    """
    walls, foot, high = _walls(join(parts), houses)
    if not len(walls):
        return []
    lines = shapely.linestrings(walls)
    near = shapely.dwithin(ground.road, lines, _FACING_M) & ground.is_fine(walls.mean(axis=1))
    shapely.prepare(houses)
    way = walls[:, 1] - walls[:, 0]
    out = np.column_stack([way[:, 1], -way[:, 0]]) / np.hypot(*way.T)[:, None]
    near &= ~shapely.dwithin(houses, shapely.points(walls.mean(axis=1) + 2.0 * out), 0.5)
    found: list[MeshPart] = []
    boxes: dict[str, list[Array]] = {}
    for row in np.flatnonzero(near):
        wall = _Relief(walls[row], float(foot[row]), float(high[row]))
        room = float(shapely.distance(lines[row], ground.road)) - 0.4
        steps = float(shapely.distance(lines[row], ground.walk)) - 0.2
        found += _decorate(rng, wall, room, min(room, steps))
        for material, corners in wall.boxes:
            boxes.setdefault(material, []).append(corners)
    for material, all_corners in boxes.items():
        first = 8 * np.arange(len(all_corners))[:, None, None]
        found.append(mesh_part(np.concatenate(all_corners), (first + _FACES).reshape(-1, 3), material))
    return found


def _decorate(rng: np.random.Generator, wall: _Relief, room: float, room_low: float) -> list[MeshPart]:
    """Add what one wall has and return its climbing plants.

    Args:
        room: free depth above people's heads, m.
        room_low: free depth on the ground, m.
    """
    stone = ["concrete", "plaster", "brick"][int(rng.integers(3))]
    style = rng.uniform(size=8)
    if room < 0.4:
        return []
    low = min(0.25, max(room_low, 0.08))
    wall.box((0.0, wall.length), (0.0, min(float(rng.uniform(0.06, 0.14)), low)), (-0.4, rng.uniform(0.4, 0.9)), stone)
    wall.box((0.0, wall.length), (0.0, 0.25), (STOREY_M - 0.1, STOREY_M + 0.15), stone)
    bays = int((wall.length - 2.4) / _BAY_M)
    start = 0.5 * (wall.length - bays * _BAY_M)
    at = start + _BAY_M * np.arange(bays + 1, dtype=np.float64)
    if style[0] < 0.5:
        deep, half = min(float(rng.uniform(0.12, 0.25)), low), float(rng.uniform(0.15, 0.3))
        for x in at[::2]:
            wall.box((x - half, x + half), (0.0, deep), (-0.3, min(wall.top, STOREY_M + 0.15)), stone)
    _sills(wall, at[:-1] + 0.5 * _BAY_M, min(float(rng.uniform(0.12, 0.2)), low))
    entrance = int(rng.integers(bays)) if bays else 0
    if bays and room_low > 1.5:
        _entrance(wall, float(at[entrance]), int(rng.integers(1, 5)))
    if bays and style[1] < 0.35 and room > 1.2:
        _balconies(wall, at[:-1:2], float(rng.uniform(1.0, 1.4)), stone)
    elif bays and style[2] < 0.25 and room > 0.9:
        x = float(at[int(rng.integers(bays))])
        wall.box((x + 0.1, x + 2.5), (0.0, 0.75), (STOREY_M, wall.top - 0.2), stone)
    parts = []
    if bays > 1 and style[3] < 0.3 and room > 1.2:
        parts.append(_awning(wall, float(at[0]) + 0.1, float(at[min(bays, 3)]) - 0.1, float(rng.uniform(0.9, 1.3))))
    if style[4] < 0.14 and room_low > 0.5:
        parts.append(_climber(rng, wall))
    wall.box((0.1, 0.2), (0.02, 0.12), (0.0, wall.top), "metal")
    return parts


def _sills(wall: _Relief, at: Array, deep: float) -> None:
    for x in at:
        wall.box((x - 0.75, x + 0.75), (0.0, deep), (0.9, 0.99), "concrete")


def _entrance(wall: _Relief, x: float, steps: int) -> None:
    for number in range(steps):
        wall.box((x - 0.8, x + 0.8), (0.0, 0.29 * (steps - number)), (-0.3, 0.17 * (number + 1)), "concrete")
    wall.box((x - 1.0, x + 1.0), (0.0, 1.0), (2.45 + 0.17 * steps, 2.57 + 0.17 * steps), "concrete")


def _balconies(wall: _Relief, at: Array, deep: float, material: str) -> None:
    floor = STOREY_M
    for x in at:
        ends = (x + 0.1, x + 2.4)
        wall.box(ends, (0.0, deep), (floor - 0.05, floor + 0.12), "concrete")
        wall.box(ends, (deep - 0.06, deep), (floor + 0.12, floor + 1.05), material)
        for side in ends:
            wall.box((side - 0.03, side + 0.03), (0.0, deep - 0.06), (floor + 0.12, floor + 1.05), material)


def _awning(wall: _Relief, low: float, high: float, deep: float) -> MeshPart:
    corners = np.array([[low, 0.02, 2.95], [high, 0.02, 2.95], [high, deep, 2.55], [low, deep, 2.55]])
    return mesh_part(wall.placed(corners), [[0, 2, 1], [0, 3, 2]], "cloth_light")


def _climber(rng: np.random.Generator, wall: _Relief) -> MeshPart:
    """Return ivy on a part of a wall."""
    wide, tall = float(rng.uniform(1.5, min(6.0, wall.length))), float(rng.uniform(2.0, max(2.1, min(5.0, wall.top))))
    left, count = float(rng.uniform(0.0, wall.length - wide)), int(12 * wide * tall)
    corners = np.column_stack(
        [rng.uniform(left, left + wide, count), rng.uniform(0.03, 0.4, count), rng.uniform(0.1, tall, count)]
    )
    return leaves(rng, wall.placed(corners), rng.uniform(0.05, 0.14, count), "hedge")


def _walls(whole: MeshPart, houses: shapely.Geometry) -> tuple[Array, Array, Array]:
    """Return (W, 2, 2) ends of upright walls with the outside on their right, (W,) heights of foot and top.

    Walls on sloping ground are parallelograms: their foot is the higher of both, their top the lower.
    """
    chosen = np.isin(whole.material, [material_index(name) for name in WALLS])
    triangles = whole.vertices[whole.faces[chosen]]
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.linalg.norm(normal, axis=1)
    triangles = triangles[(np.abs(normal[:, 2]) < 0.02 * area) & (area > 0.1)]
    if not len(triangles):
        return np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0)
    group, ends = wall_groups(triangles)
    foot, top, covered = (np.full(len(ends), value) for value in (-np.inf, np.inf, 0.0))
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    np.add.at(covered, group, 0.5 * np.linalg.norm(normal, axis=1))
    first = np.abs(triangles[:, :, :2] - ends[group][:, None, 0]).sum(axis=2) < 0.02
    for here in (first, ~first):
        low, high = np.full(len(ends), np.inf), np.full(len(ends), -np.inf)
        np.minimum.at(low, group, np.where(here, triangles[:, :, 2], np.inf).min(axis=1))
        np.maximum.at(high, group, np.where(here, triangles[:, :, 2], -np.inf).max(axis=1))
        foot, top = np.maximum(foot, low), np.minimum(top, high)
    length = np.hypot(*(ends[:, 1] - ends[:, 0]).T)
    filled = covered > 0.8 * length * (top - foot)
    walls, outside_right = face_outside(ends, length, houses)
    keep = filled & outside_right & (length >= _LENGTH_M) & (top - foot >= _HEIGHT_M)
    return walls[keep], foot[keep], top[keep]
