"""The world of the LiDAR benchmark: a grid of streets with houses, trees and lamps, and moving vehicles with sensors.

Everything follows from a seed and nothing from a network or a mesh file but SUMO's cars, so that figures of different
days are about the same triangles.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
import trimesh
from numpy.typing import NDArray

from sensors.motion import Path, actor_paths
from sensors.scan.lidar import Sensor
from sensors.spec import LidarSpec
from sim.bodies.choice import MODELS, body_mesh
from sim.bodies.vehicle_types import TYPES
from sim.boxes import CLASSES, Boxes
from sim.geometry import pose_matrix, transform_points
from sim.mesh.solids import MeshPart, box, join, mesh_part, move, to_mesh, tube
from sim.traffic.base import Actors
from sim.world.furniture.kerbside import lamp_post

SIDE_M = 400.0
ROADS_M = (-130.0, 0.0, 130.0)
"""Where the middle lines of the roads lie, along x as along y."""

HALF_ROAD_M = 8.0
LANES_M = (-6.0, -2.0, 2.0, 6.0)
"""Middle lines of the lanes, left of the road's; those left of it are driven against the road's direction."""

_WALK_M = 3.0
_KERB_M = 0.12
_CELL_M = 2.0
_STOREY_M = 3.0
_WINDOW_EVERY_M = 2.5
_RECESS_M = 0.15
_HOUSE_DEPTH_M = 11.0
_TREE_EVERY_M = 12.0
_LAMP_EVERY_M = 30.0
_LEAVES = 140
_SLOT_M = 11.0
_APART_M = 20.0

BENCHMARK_LIDAR = LidarSpec(
    name="benchmark-64",
    elevation_deg=tuple(np.linspace(2.0, -24.9, 64).round(6).tolist()),
    columns=1800,
    rate_hz=10.0,
    range_max_m=120.0,
    range_10_m=300.0,
    range_noise_m=0.02,
    dropoff_rate=0.1,
    dropoff_intensity_limit=0.7,
    dropoff_zero_intensity=0.15,
    source="64 x 1800 rays over the elevations of an HDL-64E; noise and drop-off of OPV2V's sensor",
)


def street_world(seed: int = 1) -> trimesh.Trimesh:
    """Return 400 x 400 m of streets around the origin, about 280,000 triangles with `face_attributes["material"]`."""
    return to_mesh(_district(np.random.default_rng(seed)))


def city(triangles: int, seed: int = 1) -> trimesh.Trimesh:
    """Return at least so many triangles: districts like `street_world`, each of its own seed, in rows of five."""
    districts: list[MeshPart] = []
    found = 0
    while found < triangles:
        row, column = divmod(len(districts), 5)
        district = _district(np.random.default_rng((seed, len(districts))))
        districts.append(move(district, (SIDE_M * column, SIDE_M * row, 0.0)))
        found += len(district.faces)
    return to_mesh(join(districts))


def _district(rng: np.random.Generator) -> MeshPart:
    return join([*_sheets(), *_markings(), *_houses(rng), *_verge(rng)])


def _sheets() -> list[MeshPart]:
    """Return roads, pavements and yards as grids of cells of 1.5 to 2 m, and the kerbs between them."""
    strips = _strips()
    parts = []
    for x_low, x_high, across in strips:
        for y_low, y_high, along in strips:
            on_road = "road" in (across, along)
            material = "asphalt" if on_road else "pavement" if "walk" in (across, along) else "ground"
            z = 0.0 if on_road else _KERB_M
            parts.append(_sheet(np.array([x_low, y_low]), np.array([x_high, y_high]), z, material))
    for low, high, kind in strips:
        if kind != "road":
            edges = [road + side * HALF_ROAD_M for road in ROADS_M for side in (-1.0, 1.0)]
            parts.extend(_both_ways([_kerb(np.array([low, edge]), np.array([high, edge])) for edge in edges]))
    return parts


def _strips() -> list[tuple[float, float, str]]:
    """Return (low, high, kind) of the strips that a way across all roads of one direction meets, m."""
    kinds = ("walk", "road", "walk", "yard")
    ends = [-0.5 * SIDE_M]
    for road in ROADS_M:
        ends += [road + far for far in (-HALF_ROAD_M - _WALK_M, -HALF_ROAD_M, HALF_ROAD_M, HALF_ROAD_M + _WALK_M)]
    ends.append(0.5 * SIDE_M)
    return list(zip(ends, ends[1:], ("yard", *kinds * len(ROADS_M)), strict=False))


def _sheet(low: NDArray[np.float64], high: NDArray[np.float64], z: float, material: str) -> MeshPart:
    """Return a level rectangle of nearly square cells, two triangles each."""
    cells = np.ceil((high - low) / _CELL_M - 1e-9).astype(int)
    x, y = (np.linspace(low[k], high[k], cells[k] + 1) for k in range(2))
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    corner = (np.arange(cells[0])[:, None] * (cells[1] + 1) + np.arange(cells[1])).ravel()
    right, up, both = corner + cells[1] + 1, corner + 1, corner + cells[1] + 2
    faces = np.concatenate([np.column_stack([corner, right, both]), np.column_stack([corner, both, up])])
    return mesh_part(np.column_stack([grid, np.full(len(grid), z)]), faces, material)


def _kerb(start: NDArray[np.float64], end: NDArray[np.float64]) -> MeshPart:
    corners = [(*start, 0.0), (*end, 0.0), (*end, _KERB_M), (*start, _KERB_M)]
    return mesh_part(corners, [[0, 1, 2], [0, 2, 3]], "kerb")


def _quads(count: int) -> NDArray[np.int64]:
    """Return the faces of so many quads of four vertices each."""
    first = 4 * np.arange(count)[:, None]
    return np.concatenate([first + np.array([0, 1, 2]), first + np.array([0, 2, 3])])


def _both_ways(parts: list[MeshPart]) -> list[MeshPart]:
    """Return what lies along the roads in x, and the same along the roads in y."""
    return [*parts, *(move(part, yaw=0.5 * np.pi) for part in parts)]


def _markings() -> list[MeshPart]:
    """Return dashes between the lanes of all roads, 5 mm above them: surfaces at one height have no order."""
    low = np.array([[x, road + line - 0.06] for x in np.arange(-196.0, 196.0, 9.0) for road in ROADS_M
                    for line in (-4.0, 0.0, 4.0) if np.abs(np.array(ROADS_M) - x).min() > 12.0])  # fmt: skip
    size = np.array([3.0, 0.12])
    corners = low[:, None] + size * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    vertices = np.concatenate([corners.reshape(-1, 2), np.full((4 * len(low), 1), 0.005)], axis=1)
    return _both_ways([mesh_part(vertices, _quads(len(low)), "marking")])


def _houses(rng: np.random.Generator) -> list[MeshPart]:
    """Return rows of houses on both sides of every road."""
    set_back = HALF_ROAD_M + _WALK_M + 1.0
    parts = []
    for turned in (False, True):
        # At the corners of a block the rows along x come first.
        clear = set_back + (_HOUSE_DEPTH_M + 1.0 if turned else 0.0)
        for (low, high), road, side in product(_between(clear), ROADS_M, (-1.0, 1.0)):
            for start, end in _plots(low, high, rng):
                house = _house(end - start, int(rng.integers(3, 6)), rng)
                place = (start if side > 0.0 else end, road + side * set_back, 0.0)
                house = move(house, place, 0.0 if side > 0.0 else np.pi)
                parts.append(move(house, yaw=0.5 * np.pi) if turned else house)
    return parts


def _between(clear_m: float) -> list[tuple[float, float]]:
    """Return the stretches of a road between the crossings and the borders of the district."""
    ends = [-0.5 * SIDE_M + 1.0, *(road + side for road in ROADS_M for side in (-clear_m, clear_m)), 0.5 * SIDE_M - 1.0]
    return list(zip(ends[::2], ends[1::2], strict=True))


def _plots(low: float, high: float, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Return the fronts of the houses along a stretch; one plot in eight is empty."""
    plots, at = [], low
    while high - at >= 10.0:
        end = at + rng.uniform(12.0, 22.0)
        end = high if high - end < 10.0 else end
        if rng.random() > 0.125:
            plots.append((at, end))
        at = end
    return plots


def _house(length_m: float, storeys: int, rng: np.random.Generator) -> MeshPart:
    """Return a house whose front lies on the x axis from 0 to its length and looks along -y."""
    height = _STOREY_M * storeys
    wall = ("brick", "plaster", "concrete")[int(rng.integers(3))]
    body = box((0.0, 0.0, 0.0), (length_m, _HOUSE_DEPTH_M, height), wall)
    # The box's own front gives way to the one with windows.
    front = (body.vertices[body.faces][:, :, 1] == 0.0).all(axis=1)
    shell = MeshPart(body.vertices, body.faces[~front], body.material[~front])
    columns = max(1, int(length_m / _WINDOW_EVERY_M))
    unit = _window(wall)
    cells = [
        move(unit, (length_m / columns * column, 0.0, _STOREY_M * storey), scale=(length_m / columns, 1.0, _STOREY_M))
        for column in range(columns)
        for storey in range(storeys)
    ]
    return join([shell, *cells])


@lru_cache(maxsize=8)
def _window(wall: str) -> MeshPart:
    """Return one by one metre of wall in x and z with a pane that lies deeper: 18 triangles."""
    outer = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    hole = np.array([[0.25, 0.3], [0.75, 0.3], [0.75, 0.8], [0.25, 0.8]])
    loops = [np.insert(corners, 1, depth, axis=1) for corners, depth in ((outer, 0.0), (hole, 0.0), (hole, _RECESS_M))]
    here, there = np.arange(4), np.roll(np.arange(4), -1)
    faces = [
        np.column_stack(triangle)
        for ring in (0, 4)
        for triangle in (
            (here + ring, there + ring, there + ring + 4),
            (here + ring, there + ring + 4, here + ring + 4),
        )
    ]
    frame = mesh_part(np.concatenate(loops), np.concatenate(faces), wall)
    return join([frame, mesh_part(loops[2], [[0, 1, 2], [0, 2, 3]], "glass")])


def _verge(rng: np.random.Generator) -> list[MeshPart]:
    """Return trees and lamps on the pavements."""
    aside = HALF_ROAD_M + 0.8
    parts = []
    for turned in (False, True):
        for (low, high), road, side in product(_between(HALF_ROAD_M + _WALK_M + 4.0), ROADS_M, (-1.0, 1.0)):
            y = road + side * aside
            row = [
                move(_tree(rng), (x, y, _KERB_M), rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.8, 1.2))
                for x in np.arange(low, high, _TREE_EVERY_M)
            ]
            row += [
                move(lamp_post(), (x, y, _KERB_M), -side * 0.5 * np.pi)
                for x in np.arange(low + 5.0, high, _LAMP_EVERY_M)
            ]
            parts += [move(part, yaw=0.5 * np.pi) for part in row] if turned else row
    return parts


def _tree(rng: np.random.Generator) -> MeshPart:
    """Return a trunk and a crown of square leaf cards that look anywhere."""
    place = rng.normal(size=(_LEAVES, 3))
    place *= (rng.uniform(0.2, 1.0, (_LEAVES, 1)) ** (1.0 / 3.0)) / np.linalg.norm(place, axis=1, keepdims=True)
    first, second = rng.normal(size=(2, _LEAVES, 3))
    second -= first * ((first * second).sum(axis=1) / (first * first).sum(axis=1))[:, None]
    first, second = (0.25 * way / np.linalg.norm(way, axis=1, keepdims=True) for way in (first, second))
    middle = place * np.array([1.7, 1.7, 1.4]) + np.array([0.0, 0.0, 4.2])
    corners = np.stack([middle - first - second, middle + first - second, middle + first + second,
                        middle - first + second], axis=1)  # fmt: skip
    leaves = mesh_part(corners.reshape(-1, 3), _quads(_LEAVES), "leaves")
    return join([tube([0.0, 0.0, 0.0], [0.0, 0.0, 3.4], (0.16, 0.11), "bark"), leaves])


@dataclass(frozen=True, slots=True, eq=False)
class Fleet:
    """N vehicles on the lanes; each drives an arc for the second or so that anyone looks.

    Attributes:
        start: the vehicles at time 0.
        yaw_rate: (N,) rad/s.
        agents: rows of those that carry a sensor.
        heavy_detail: how often the triangles of trucks are cut into four; those of cars and vans are once.
    """

    start: Actors
    yaw_rate: NDArray[np.float64]
    agents: tuple[int, ...]
    heavy_detail: int

    def actors(self, time_s: float) -> Actors:
        """Return the vehicles at an instant."""
        start = self.start
        rows = start.boxes.array
        turned = self.yaw_rate * time_s
        # The chord of an arc points half-way between the headings at its ends.
        rows[:, :2] += time_s * _turn(start.velocity, 0.5 * turned)
        rows[:, 6] += turned
        boxes = Boxes.from_array(rows, start.boxes.label, start.boxes.object_id)
        velocity = _turn(start.velocity, turned)
        return replace(start, time_s=time_s, boxes=boxes, velocity=velocity)

    def body_mesh(self, model: str, size: tuple[float, float, float]) -> trimesh.Trimesh:
        """Return the mesh of a vehicle: that of the simulator with finer triangles."""
        return _fine(model, size, self.heavy_detail if model.startswith("truck") else 1)

    def meshes(self) -> list[trimesh.Trimesh]:
        """Return the N meshes in their body frames."""
        sizes = self.start.boxes.size.round(3).tolist()
        return [self.body_mesh(model, tuple(size)) for model, size in zip(self.start.model, sizes, strict=True)]

    def sensors(
        self, time_s: float, rng: np.random.Generator, spec: LidarSpec = BENCHMARK_LIDAR, reach_s: float = 0.05
    ) -> list[Sensor]:
        """Return the sensors of the agents for the sweeps around an instant."""
        mount = pose_matrix(np.array(spec.mount_xyz_m))
        now = self.actors(time_s)
        path = actor_paths(now, self.actors(time_s - reach_s), self.actors(time_s + reach_s))
        return [
            Sensor(spec, Path.through(path.time_s, path[row].at(path.time_s) @ mount), time_s, own, int(rides_on))
            for row, rides_on, own in zip(
                self.agents, now.boxes.object_id[list(self.agents)], rng.spawn(len(self.agents)), strict=True
            )
        ]


def _turn(vectors: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn (N, 2) vectors counter-clockwise by (N,) angles."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * vectors[:, 0] - s * vectors[:, 1], s * vectors[:, 0] + c * vectors[:, 1]], axis=1)


@lru_cache(maxsize=1024)
def _fine(model: str, size: tuple[float, float, float], detail: int) -> trimesh.Trimesh:
    mesh = body_mesh(model, size)
    vertices, faces, material = mesh.vertices, mesh.faces, mesh.face_attributes["material"]
    for _ in range(detail):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
        material = np.repeat(material, 4)
    return trimesh.Trimesh(vertices, faces, face_attributes={"material": material}, process=False)


_MIXES = {60: (46, 9, 5, 1), 200: (130, 20, 50, 2)}
"""Cars, vans, trucks and the detail of trucks, by the number of vehicles: 262,000 and 1,114,000 moving triangles."""

FLEETS = tuple(_MIXES)
"""Sizes of the fleets."""


def fleet(vehicles: int = 60, seed: int = 1, agents: int = 5) -> Fleet:
    """Return one of `FLEETS`, denser towards the middle of the streets; agents are cars there, 20 m apart."""
    cars, vans, trucks, heavy_detail = _MIXES[vehicles]
    rng = np.random.default_rng(seed)
    kinds = np.repeat(["car", "van", "truck"], [cars, vans, trucks])
    rng.shuffle(kinds)
    slots = _slots(rng)
    near = np.exp(-np.hypot(slots[:, 0], slots[:, 1]) / 25.0)
    slots = slots[rng.choice(len(slots), vehicles, replace=False, p=near / near.sum())]
    models, rows = [], np.zeros((vehicles, 7))
    for row, kind in enumerate(kinds):
        types = [entry for entry in TYPES.values() if entry.label == kind]
        length, width, height = types[int(rng.integers(len(types)))].size
        models.append(str(rng.choice(MODELS[kind])))
        rows[row] = (*slots[row, :2], 0.5 * height, length, width, height, slots[row, 2])
    heading = np.stack([np.cos(rows[:, 6]), np.sin(rows[:, 6])], axis=1)
    start = Actors(
        time_s=0.0,
        boxes=Boxes.from_array(rows, [CLASSES.index(kind) for kind in kinds], 1000 + np.arange(vehicles)),
        pitch=np.zeros(vehicles),
        velocity=heading * rng.uniform(3.0, 14.0, (vehicles, 1)),
        acceleration=np.zeros((vehicles, 2)),
        model=tuple(models),
        name=tuple(f"vehicle_{row}" for row in range(vehicles)),
        signals=np.zeros(vehicles, np.int32),
        lane=("",) * vehicles,
    )
    carriers = _spaced(rows[:, :2], np.flatnonzero(kinds == "car"), agents)
    return Fleet(start, rng.normal(0.0, 0.05, vehicles), carriers, heavy_detail)


def _slots(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return (M, 3) x, y, yaw of places on the lanes where vehicles do not touch."""
    slots = []
    for at in np.arange(-190.0, 191.0, _SLOT_M):
        crossing = np.abs(np.array(ROADS_M) - at).min() < 2.0 * HALF_ROAD_M
        for road in ROADS_M:
            for lane in LANES_M:
                along = at + rng.uniform(-0.3, 0.3)
                slots.append((along, road + lane, 0.0 if lane < 0.0 else np.pi))
                if not crossing:
                    slots.append((road - lane, along, 0.5 * np.pi if lane < 0.0 else -0.5 * np.pi))
    return np.array(slots)


def _spaced(xy: NDArray[np.float64], rows: NDArray[np.int64], count: int) -> tuple[int, ...]:
    """Choose rows from the middle outwards, none within 20 m of another."""
    chosen: list[int] = []
    for row in rows[np.argsort(np.hypot(*xy[rows].T))]:
        if all(np.hypot(*(xy[row] - xy[other])) >= _APART_M for other in chosen):
            chosen.append(int(row))
        if len(chosen) == count:
            break
    return tuple(sorted(chosen))


def baked(
    static: trimesh.Trimesh, vehicles: Fleet, time_s: float, left_out: int | None = None
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return (V, 3) vertices and (F, 3) faces of the world and its vehicles as they stand at an instant.

    Args:
        static: the streets.
        vehicles: the fleet.
        time_s: the instant.
        left_out: row of a vehicle that is not there.
    """
    poses = vehicles.actors(time_s).world_from_body()
    vertices, faces = [np.asarray(static.vertices)], [np.asarray(static.faces)]
    count = len(static.vertices)
    for row, mesh in enumerate(vehicles.meshes()):
        if row != left_out:
            vertices.append(transform_points(poses[row], np.asarray(mesh.vertices)))
            faces.append(np.asarray(mesh.faces) + count)
            count += len(mesh.vertices)
    return np.concatenate(vertices), np.concatenate(faces)
