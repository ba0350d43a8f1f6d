"""Pictures of the places, from above and from the ego's driver's seat, a few seconds into a drive.

Usage:
    python -m studies.pictures.places --out docs/pictures/scenarios
    python -m studies.pictures.places --out /tmp/pictures --only helsinki my/folder/scenario.toml
"""

import argparse
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image

from sensors.scan.scene import RayScene
from sim.bodies.choice import body_mesh
from sim.boxes import CLASSES
from sim.catalog.load import list_scenarios, load_scenario
from sim.errors import ScenarioError
from sim.mesh.materials import MATERIALS
from sim.scenario import Scenario
from sim.traffic.base import Actors
from sim.traffic.open import open_traffic
from sim.traffic.staying import CARRIERS
from sim.world.build import build_world

SIZE = (880, 500)
SKY = np.array([[196, 214, 232], [150, 184, 220]], np.float64)
SUN = np.array([0.45, -0.35, 0.82]) / np.linalg.norm([0.45, -0.35, 0.82])
REACH_M = 900.0
MIDDLES_M = {
    "highway_env_merge": (290.0, -4.0),
    "highway_env_roundabout": (0.0, 0.0),
    "highway_env_intersection": (0.0, 0.0),
    "highway_env_racetrack": (70.0, 20.0),
}
"""What the picture from above shows of scenarios whose roads are one junction; elsewhere its middle is the ego."""

SHADE = 0.55
"""Ambient light of faces turned away from the sun."""


@dataclass(frozen=True)
class Stage:
    """Scene as triangles.

    Attributes:
        scene: ray casting scene.
        normal: (F, 3) normals of the triangles.
        rgb: (F, 3) colours of the triangles.
    """

    scene: RayScene
    normal: NDArray[np.float64]
    rgb: NDArray[np.float64]

    @classmethod
    def of(cls, mesh: trimesh.Trimesh) -> "Stage":
        """Return the scene of a mesh with the materials of the world."""
        corners = mesh.vertices[mesh.faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        rgb = np.array([material.rgb for material in MATERIALS], np.float64)[mesh.face_attributes["material"]]
        return cls(RayScene(mesh), normal, rgb)


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the pictures")
    parser.add_argument("--only", nargs="+", help="names or paths of scenarios; default: every place")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    for name in arguments.only or places():
        try:
            for path in draw(load_scenario(name), arguments.seed, arguments.out):
                print(path)
        except ScenarioError as error:
            print(f"{name}: left out: {error}")


def places() -> list[str]:
    """Return the names of the scenarios without an encounter."""
    return [name for name in list_scenarios() if load_scenario(name).conflict is None]


def draw(scenario: Scenario, seed: int, out: Path) -> list[Path]:
    """Draw a scenario twice and return the files."""
    with open_traffic(scenario, seed) as traffic:
        now = traffic.actors
    ego = _on_the_way(now, scenario)
    world = build_world(scenario, seed)
    without_ego, with_ego = (Stage.of(everything(world, now, hidden)) for hidden in (ego, -1))
    row = now.row(ego)
    center, yaw = now.boxes.center[row], float(now.boxes.yaw[row])
    ground = center[2] - 0.5 * now.boxes.size[row, 2]
    ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    eye = np.array([center[0], center[1], ground + 1.55]) + 0.3 * ahead
    from_seat = picture(without_ego, eye, eye + ahead + [0.0, 0.0, -0.03], 78.0)
    middle, back, up = center + 12.0 * ahead, 62.0 * ahead, 58.0
    if scenario.name in MIDDLES_M:
        middle, back, up = np.array([*MIDDLES_M[scenario.name], ground]), np.array([-25.0, 70.0, 0.0]), 75.0
    far = np.array([middle[0], middle[1], ground]) - back + [0.0, 0.0, up]
    from_above = picture(with_ego, far, middle, 52.0)
    files = [out / f"{scenario.name}_above.png", out / f"{scenario.name}_ego.png"]
    out.mkdir(parents=True, exist_ok=True)
    for file, pixels in zip(files, (from_above, from_seat), strict=True):
        image = Image.fromarray(pixels).quantize(128, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
        image.save(file, optimize=True)
    return files


def _on_the_way(now: Actors, scenario: Scenario) -> int:
    """Return the id of a car or van that approaches the centre of the area."""
    xy = now.boxes.center[:, :2]
    area = np.array(scenario.network.area_m or (*xy.min(axis=0), *xy.max(axis=0)))
    to_focus = np.array(scenario.demand.focus_m or 0.5 * (area[:2] + area[2:])) - xy
    away = np.hypot(*to_focus.T)
    heading = np.column_stack([np.cos(now.boxes.yaw), np.sin(now.boxes.yaw)])
    towards = (heading * to_focus).sum(axis=1) / np.maximum(away, 1e-9)
    moving = np.hypot(*now.velocity.T) > 2.0
    can = np.isin(now.boxes.label, [CLASSES.index(name) for name in CARRIERS]) & ~now.parked()
    cost = np.abs(away - 40.0) + 40.0 * (towards < 0.7) + 30.0 * ~moving + 1e9 * ~can
    return int(now.boxes.object_id[np.argmin(cost)])


def everything(world: trimesh.Trimesh, now: Actors, hidden: int) -> trimesh.Trimesh:
    """Return the world and all bodies but the hidden one as one mesh, which is no wider than the world."""
    low, high = world.bounds
    vertices, faces, material = [world.vertices], [world.faces], [world.face_attributes["material"]]
    count = len(world.vertices)
    poses = now.world_from_body()
    for row, object_id in enumerate(now.boxes.object_id.tolist()):
        if object_id == hidden or not (low < now.boxes.center[row]).all() or not (now.boxes.center[row] < high).all():
            continue
        length, width, height = now.boxes.size[row].round(3).tolist()
        body = body_mesh(now.model[row], (length, width, height))
        vertices.append(body.vertices @ poses[row, :3, :3].T + poses[row, :3, 3])
        faces.append(body.faces + count)
        material.append(body.face_attributes["material"])
        count += len(body.vertices)
    return trimesh.Trimesh(
        vertices=np.concatenate(vertices),
        faces=np.concatenate(faces),
        face_attributes={"material": np.concatenate(material)},
        process=False,
    )


def picture(
    stage: Stage, eye: NDArray, target: NDArray, field_of_view_deg: float, size: tuple[int, int] = SIZE
) -> NDArray[np.uint8]:
    """Return (H, W, 3) pixels seen by a camera, with the sun's shadows, each the mean of four rays.

    Args:
        stage: scene.
        eye: (3,) position of the camera, m.
        target: (3,) centre of the picture, m.
        field_of_view_deg: horizontal field of view.
        size: width and height, pixels.
    """
    width, height = size[0] * 2, size[1] * 2
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    half = np.tan(np.radians(0.5 * field_of_view_deg))
    x = (np.arange(width) + 0.5) / width * 2.0 - 1.0
    y = (1.0 - (np.arange(height) + 0.5) / height * 2.0) * height / width
    rays = forward + half * (x[None, :, None] * right + y[:, None, None] * up)
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).reshape(-1, 3)
    bands = np.array_split(rays, 8)
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        colour = np.concatenate(list(pool.map(lambda band: _colour(stage, eye, band), bands)))
    pixels = colour.reshape(size[1], 2, size[0], 2, 3).mean(axis=(1, 3))
    return np.clip(pixels, 0, 255).astype(np.uint8)


def _colour(stage: Stage, eye: NDArray, rays: NDArray) -> NDArray[np.float64]:
    """Return (N, 3) colours of rays."""
    share = np.clip(3.0 * rays[:, 2:], 0.0, 1.0)
    colour = SKY[0] * (1.0 - share) + SKY[1] * share
    hits = stage.scene.cast(np.broadcast_to(eye, rays.shape), rays, REACH_M)
    seen = np.flatnonzero(hits.face >= 0)
    face, distance = hits.face[seen], hits.distance[seen].astype(np.float64)
    paint = stage.rgb[face]
    facing = stage.normal[face]
    facing *= np.where((facing * rays[seen]).sum(axis=1, keepdims=True) > 0.0, -1.0, 1.0)
    sun = np.clip(facing @ SUN, 0.0, 1.0)
    start = eye + distance[:, None] * rays[seen] + 0.02 * facing
    lit = np.flatnonzero(sun > 0.0)
    shadow = stage.scene.cast(start[lit], np.tile(SUN, (len(lit), 1)), 120.0).face >= 0
    sun[lit[shadow]] = 0.0
    light = SHADE + 0.25 * np.clip(facing[:, 2], 0.0, 1.0) + 0.45 * sun
    haze = np.exp(-distance / 600.0)[:, None]
    colour[seen] = paint * light[:, None] * haze + SKY[0] * (1.0 - haze)
    return colour


if __name__ == "__main__":
    main()
