"""A toy world for the sensors: box rooms, box cars and traffic that drives straight on."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from sensors.presets import get_lidar
from sensors.scan.scene import RayScene
from sensors.spec import LidarSpec
from sim.boxes import Boxes
from sim.mesh.materials import MATERIALS
from sim.scenario import AgentRule, DemandSpec, NetworkSpec, Scenario
from sim.traffic.base import Actors

BRIGHT = max(range(len(MATERIALS)), key=lambda i: (MATERIALS[i].finish == "diffuse") * MATERIALS[i].reflectivity)
CAR = (4.5, 1.8, 1.5)


def painted(mesh: trimesh.Trimesh, material: int = BRIGHT) -> trimesh.Trimesh:
    mesh.face_attributes["material"] = np.full(len(mesh.faces), material, np.uint8)
    return mesh


def box(extents: ArrayLike, center: ArrayLike = (0.0, 0.0, 0.0), material: int = BRIGHT) -> trimesh.Trimesh:
    mesh = trimesh.creation.box(extents)
    mesh.apply_translation(center)
    return painted(mesh, material)


def ground(size: float = 400.0, center: tuple[float, float] = (0.0, 0.0)) -> trimesh.Trimesh:
    half = size / 2
    corners = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0]], float)
    corners[:, :2] += center
    return painted(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False))


def box_body(model: str, size: tuple[float, float, float]) -> trimesh.Trimesh:
    return box(size, (0.0, 0.0, size[2] / 2))


def cars(
    rows: ArrayLike, *, time_s: float = 0.0, speed: ArrayLike = 0.0, first_id: int = 1000, size: Sequence[float] = CAR
) -> Actors:
    """Box cars at rows of x, y, yaw on the ground plane."""
    places = np.asarray(rows, float).reshape(-1, 3)
    n = len(places)
    table = np.zeros((n, 7))
    table[:, :2], table[:, 6] = places[:, :2], places[:, 2]
    table[:, 2], table[:, 3:6] = size[2] / 2, size
    along = np.broadcast_to(np.asarray(speed, float), n)
    velocity = np.stack([np.cos(places[:, 2]), np.sin(places[:, 2])], axis=1) * along[:, None]
    boxes = Boxes.from_array(table, object_id=first_id + np.arange(n))
    return Actors(
        time_s=time_s,
        boxes=boxes,
        pitch=np.zeros(n),
        velocity=velocity,
        acceleration=np.zeros((n, 2)),
        model=("box",) * n,
        name=("toy",) * n,
        signals=np.zeros(n, np.int32),
        lane=("",) * n,
    )


def scene_of(static: trimesh.Trimesh | None = None, actors: Actors | None = None) -> RayScene:
    scene = RayScene(static, body_mesh=box_body)
    return scene if actors is None else scene.with_bodies(actors)


def ideal(name: str = "debug-16", **changes: Any) -> LidarSpec:
    """A preset without noise, loss or threshold."""
    import msgspec

    calm = dict(range_noise_m=0.0, dropoff_rate=0.0, dropoff_zero_intensity=0.0, range_10_m=1e4, range_min_m=0.0)
    return msgspec.structs.replace(get_lidar(name), **(calm | changes))


class StraightTraffic:
    """Cars that keep their heading and speed; `gone_at` maps an id to the step at which it leaves."""

    def __init__(self, actors: Actors, step_s: float = 0.1, gone_at: dict[int, int] | None = None) -> None:
        self.step_s = step_s
        self.steps = 0
        self._start = actors
        self._gone_at = gone_at or {}

    @property
    def actors(self) -> Actors:
        elapsed = self.steps * self.step_s
        boxes = self._start.boxes
        center = boxes.center.copy()
        center[:, :2] += self._start.velocity * elapsed
        now = replace(self._start, time_s=self._start.time_s + elapsed, boxes=replace(boxes, center=center))
        stays = [row for row, key in enumerate(boxes.object_id) if self.steps < self._gone_at.get(int(key), 10**9)]
        return rows_of(now, stays)

    def step(self) -> Actors:
        self.steps += 1
        return self.actors

    def close(self) -> None: ...

    def __enter__(self) -> "StraightTraffic":
        return self

    def __exit__(self, *exc: object) -> None: ...


def rows_of(actors: Actors, rows: list[int]) -> Actors:
    return actors[np.array(rows, np.int64)]


def toy_scenario(**rule: Any) -> Scenario:
    rule = {"vehicles": 2, "lidar": "debug-16", **rule}
    return Scenario(name="toy", description="", network=NetworkSpec(), demand=DemandSpec(), agents=AgentRule(**rule))
