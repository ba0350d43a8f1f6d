"""How fast the LiDAR is, measured against Embree itself.

The unit is R: one call of `EmbreeScene.run(query="DISTANCE")` per sweep, robust, on one thread, over everything as it
stands at one instant, built beforehand and not counted. A complete sweep also makes its rays, moves the vehicles while
it turns, finds owners, materials and intensities, adds noise, loses some points and packs the others.

    python -m benchmarks.lidar            # everything
    python -m benchmarks.lidar --quick    # fewer and shorter samples
    python -m benchmarks.lidar --city     # instead: memory and time in a city of five million triangles
"""

import json
import logging
import os
import platform
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import msgspec
import numpy as np
import trimesh
import tyro
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.city import measure_city
from benchmarks.quiet import Timing, measure
from benchmarks.rivals import Open3DFrame, Rays, open3d_version, trimesh_frame
from benchmarks.street import BENCHMARK_LIDAR, Fleet, baked, fleet, street_world
from sensors.beams import beams_of
from sensors.lidar import Sensor, scan_all
from sensors.raycast import Returns, Shot, Solid
from sensors.scene import RayScene
from sensors.sweep import STATIC, Sweep
from sim.errors import SettingsError
from sim.traffic.base import Actors

GOALS = {
    "ratio_public_1t": 1.35,
    "ratio_fused_1t": 0.35,
    "ratio_fused_2t": 0.19,
    "subrays4_cost": 3.3,
    "update_ms_60": 0.2,
    "update_ms_200": 0.4,
    "realtime_factor": 6.5,
    "city_peak_gb": 2.0,
}
"""The real-time factor at least, the others at most."""

CITY_TRIANGLES = 5_000_000

_FRAME_S = 0.1
_LOADED = 0.1


@dataclass(frozen=True, slots=True)
class Effort:
    """How long to measure: samples of each variant, how many of them count, and the least duration of one, s."""

    rounds: int
    keep: int
    sample_s: float


FULL, QUICK = Effort(21, 9, 0.2), Effort(6, 5, 0.06)


@dataclass(frozen=True, slots=True, eq=False)
class Street:
    """What is measured.

    Attributes:
        static: the streets.
        vehicles: the fleet.
        sensors: of its agents, at time 0.
        rays: of each sensor's sweep, as a sensor without noise fires them.
    """

    static: trimesh.Trimesh
    vehicles: Fleet
    sensors: list[Sensor]
    rays: list[Rays]

    @property
    def agents(self) -> int:
        """Number of sweeps per frame."""
        return len(self.sensors)

    def scene(self, engine: str) -> RayScene:
        """Return the streets without vehicles in one engine."""
        return RayScene(self.static, body_mesh=self.vehicles.body_mesh, engine=engine)


def make_street() -> Street:
    """Return the streets with 60 vehicles and 5 agents."""
    vehicles = fleet(60)
    sensors = vehicles.sensors(0.0, np.random.default_rng(1))
    return Street(street_world(), vehicles, sensors, [rays_of(sensor) for sensor in sensors])


def rays_of(sensor: Sensor) -> Rays:
    """Return the rays of a sweep in the world frame, ring by ring, each from where the sensor is when it fires."""
    axis = beams_of(sensor.spec, sensor.time_s).axis[:, :, : sensor.spec.columns].reshape(3, -1)
    poses = sensor.path.at(sensor.time_s + sensor.spec.time_offset.ravel())
    directions = np.einsum("nij,jn->ni", poses[:, :3, :3], axis)
    return Rays(poses[:, :3, 3].astype(np.float32), directions.astype(np.float32))


def bare_embree(street: Street) -> Callable[[], list[NDArray[np.float32]]]:
    """Return R for one frame: each sweep over the baked scene without the vehicle that carries the sensor."""
    scenes = []
    for row in street.vehicles.agents:
        vertices, faces = baked(street.static, street.vehicles, 0.0, left_out=row)
        scene = EmbreeScene(robust=True)
        TriangleMesh(scene, vertices.astype(np.float32), faces.astype(np.int32))
        # The first ray commits the scene.
        scene.run(np.zeros((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))
        scenes.append(scene)
    reach = BENCHMARK_LIDAR.range_max_m

    def run() -> list[NDArray[np.float32]]:
        return [
            scene.run(rays.origins, rays.directions, dists=reach, query="DISTANCE")
            for scene, rays in zip(scenes, street.rays, strict=True)
        ]

    return run


def complete_frame(scene: RayScene, street: Street, threads: int | None, subrays: int = 1) -> Callable[[], list[Sweep]]:
    """Return a frame from the traffic to the sweeps: the scene's update and a sweep of each agent."""
    now, before, after = _instants(street.vehicles)
    spec = msgspec.structs.replace(BENCHMARK_LIDAR, subrays=subrays)
    sensors = street.vehicles.sensors(0.0, np.random.default_rng(1), spec)
    return lambda: scan_all(scene.with_bodies(now, before, after), sensors, threads=threads)


def scene_update(scene: RayScene, vehicles: Fleet) -> Callable[[], None]:
    """Return the update alone: from the traffic's tables to committed instances that hide each agent's own body."""
    now, before, after = _instants(vehicles)
    hidden = tuple(now.boxes.object_id[list(vehicles.agents)].tolist())

    def run() -> None:
        ready = scene.with_bodies(now, before, after)
        ready.engine.place(ready.bodies, np.zeros(3), hidden)  # type: ignore[attr-defined]

    return run


class _Canned:
    """A scene that answers once and then keeps giving the same answer."""

    def __init__(self, scene: RayScene) -> None:
        self._scene = scene
        self._returns: list[Returns] = []
        self.shots: Sequence[Shot] = ()

    def sweep(self, shots: Sequence[Shot], threads: int = 1) -> list[Returns]:
        if not self._returns:
            self.shots, self._returns = shots, self._scene.sweep(shots, threads)
        return self._returns


def fused_stages(scene: RayScene, street: Street) -> dict[str, Callable[[], object]]:
    """Return parts of a frame of the fused engine on one thread.

    The kernel runs whole, with every beam lost before it is reported, without vehicles, and without any triangle, so
    that differences tell its stages apart. Packets are the same rays cast by the engine without a sensor: what any
    LiDAR made of such packets costs at least.
    """
    now, before, after = _instants(street.vehicles)
    moving = scene.with_bodies(now, before, after)
    canned, lost = _Canned(moving), _Canned(moving)
    scan_all(canned, street.sensors, threads=1)  # type: ignore[arg-type]
    deaf = msgspec.structs.replace(BENCHMARK_LIDAR, dropoff_rate=1.0)
    scan_all(lost, street.vehicles.sensors(0.0, np.random.default_rng(1), deaf), threads=1)  # type: ignore[arg-type]
    void = RayScene(trimesh.Trimesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), process=False), engine="fused")
    reach = np.full(len(street.rays[0].origins), BENCHMARK_LIDAR.range_max_m, np.float32)
    everything = _solid(*baked(street.static, street.vehicles, 0.0))
    streets = _solid(street.static.vertices, street.static.faces)

    def packets(solid: Solid) -> Callable[[], object]:
        return lambda: [scene.engine.cast(solid, rays.origins, rays.directions, reach) for rays in street.rays]

    return {
        "python": lambda: scan_all(canned, street.sensors, threads=1),  # type: ignore[arg-type]
        "kernel": lambda: moving.sweep(canned.shots, 1),
        "kernel_lost": lambda: moving.sweep(lost.shots, 1),
        "kernel_static": lambda: scene.sweep(canned.shots, 1),
        "kernel_void": lambda: void.sweep(canned.shots, 1),
        "packets_static": packets(streets),
        "packets_baked": packets(everything),
    }


def _instants(vehicles: Fleet) -> tuple[Actors, Actors, Actors]:
    """Return the vehicles now, a frame earlier and a frame later, as a drive at 10 Hz knows them."""
    return vehicles.actors(0.0), vehicles.actors(-_FRAME_S), vehicles.actors(_FRAME_S)


def _solid(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> Solid:
    return Solid(
        np.asarray(vertices, np.float32), np.asarray(faces, np.int32), np.zeros(len(faces), np.uint8), np.zeros(3)
    )


def variants_of(street: Street, bare: Callable[[], object], fused: RayScene | None) -> dict[str, Callable[[], object]]:
    """Return everything that takes turns, frames of all agents."""
    reach = BENCHMARK_LIDAR.range_max_m
    variants: dict[str, Callable[[], object]] = {
        "bare": bare,
        "public_1t": complete_frame(street.scene("public"), street, 1),
        "trimesh": lambda: trimesh_frame(street.static, street.vehicles, 0.0, street.rays, reach),
    }
    if open3d_version() is not None:
        open3d = Open3DFrame(street.static)
        variants["open3d"] = lambda: open3d(street.vehicles, 0.0, street.rays, reach)
    if fused is None:
        return variants
    crowd = fleet(200)
    crowded = RayScene(street.static, body_mesh=crowd.body_mesh, engine="fused")
    return variants | {
        "fused_1t": complete_frame(fused, street, 1),
        "fused_2t": complete_frame(fused, street, 2),
        "fused_all": complete_frame(fused, street, None),
        "subrays_4": complete_frame(fused, street, 1, subrays=4),
        "subrays_8": complete_frame(fused, street, 1, subrays=8),
        "update_60": scene_update(fused, street.vehicles),
        "update_200": scene_update(crowded, crowd),
        **fused_stages(fused, street),
    }


def figures_of(timings: dict[str, Timing], agents: int) -> dict[str, float | None]:
    """Return the figures of the JSON line, None for what could not be measured."""

    def ratio(over: str, under: str, factor: float = 1.0) -> float | None:
        if over not in timings or under not in timings:
            return None
        return round(factor * timings[over].wall_s / timings[under].wall_s, 4)

    def ms(name: str, per: int = 1) -> float | None:
        return round(1e3 * timings[name].wall_s / per, 4) if name in timings else None

    return {
        "ratio_public_1t": ratio("public_1t", "bare"),
        "ratio_fused_1t": ratio("fused_1t", "bare"),
        "ratio_fused_2t": ratio("fused_2t", "bare"),
        "update_ms_60": ms("update_60"),
        "update_ms_200": ms("update_200"),
        "realtime_factor": round(_FRAME_S / timings["fused_all"].wall_s, 3) if "fused_all" in timings else None,
        "speedup_trimesh": ratio("trimesh", "fused_all"),
        "speedup_trimesh_1t": ratio("trimesh", "fused_1t"),
        "speedup_open3d": ratio("open3d", "fused_all"),
        "subrays4_cost": ratio("subrays_4", "fused_1t"),
        "subrays8_cost": ratio("subrays_8", "fused_1t"),
        **{f"{name}_sweep_ms": ms(name, agents) for name in _SWEEPS if name in timings},
        **{f"stage_{name}_ms": value for name, value in stage_ms(timings, agents).items()},
    }


_SWEEPS = {
    "bare": "R: bare EmbreeScene.run, distances only, vehicles frozen",
    "public_1t": "public engine, 1 thread",
    "fused_1t": "fused engine, 1 thread",
    "fused_2t": "fused engine, 2 threads",
    "fused_all": "fused engine, all cores",
    "subrays_4": "fused engine, 1 thread, 4 rays per beam",
    "subrays_8": "fused engine, 1 thread, 8 rays per beam",
    "packets_baked": "Embree's packets alone, 1 thread, vehicles frozen",
    "trimesh": "trimesh: joined meshes and its ray caster",
    "open3d": "Open3D: its ray caster, all cores",
}

_STAGES = {
    "update": "update of the scene",
    "python": "poses, tables, noise and Sweep in Python",
    "rays": "ray generation, and misses",
    "static": "tracing and reading the streets",
    "moving": "tracing and reading the vehicles",
    "report": "noise, loss and packing",
    "rest": "not told apart",
}


def stage_ms(timings: dict[str, Timing], agents: int) -> dict[str, float]:
    """Return the stages of a sweep of the fused engine on one thread, ms; they add up to the sweep."""
    if "kernel" not in timings:
        return {}
    ms = {name: 1e3 * timing.wall_s / agents for name, timing in timings.items()}
    report = ms["kernel"] - ms["kernel_lost"]
    stages = {
        "update": ms["update_60"],
        "python": ms["python"],
        "rays": ms["kernel_void"],
        # Without vehicles the streets behind them are reported too: the report is taken to cost the same.
        "static": ms["kernel_static"] - ms["kernel_void"] - report,
        "moving": ms["kernel"] - ms["kernel_static"],
        "report": report,
    }
    stages["rest"] = ms["fused_1t"] - sum(stages.values())
    return {name: round(value, 4) for name, value in stages.items()}


def facts_of(street: Street, timings: dict[str, Timing]) -> dict[str, object]:
    """Return what the figures were measured on."""
    return {
        "cpu": _cpu_name(),
        "cores": _cores(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in ("numpy", "numba", "embreex", "trimesh")}
        | {"open3d": open3d_version()},
        "others_load_cores": round(float(np.median([timing.load for timing in timings.values()])), 2),
        "samples": min(timing.samples for timing in timings.values()),
        "static_triangles": len(street.static.faces),
        "moving_triangles": sum(len(mesh.faces) for mesh in street.vehicles.meshes()),
        "rays_per_sweep": len(street.rays[0].origins),
    }


def _cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.processor())


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def show(console: Console, timings: dict[str, Timing], figures: dict[str, float | None], agents: int) -> None:
    """Print the tables."""
    unit = timings["bare"].wall_s
    table = Table(title=f"One sweep of 64 x 1800 rays, {agents} agents among 60 vehicles", title_justify="left")
    for title in ("what", "ms", "of R", "goal"):
        table.add_column(title, justify="left" if title == "what" else "right")
    for name, label in _SWEEPS.items():
        if name not in timings:
            table.add_row(label, "not installed" if name == "open3d" else "cannot run here", "", "")
            continue
        wall = timings[name].wall_s
        goal = GOALS.get(f"ratio_{name}")
        table.add_row(label, f"{1e3 * wall / agents:.2f}", f"{wall / unit:.3f}", f"<= {goal}" if goal else "")
    console.print(table)
    table = Table(title="Figures", title_justify="left")
    for title in ("what", "measured", "goal"):
        table.add_column(title, justify="left" if title == "what" else "right")
    for key, label in _FIGURES.items():
        value, goal = figures[key], GOALS.get(key)
        sign = ">=" if key == "realtime_factor" else "<="
        table.add_row(label, "-" if value is None else f"{value:.3g}", f"{sign} {goal}" if goal else "")
    console.print(table)
    stages = stage_ms(timings, agents)
    if stages:
        table = Table(title="Where the fused engine's sweep goes, 1 thread", title_justify="left")
        for title in ("stage", "ms", "share"):
            table.add_column(title, justify="left" if title == "stage" else "right")
        whole = sum(stages.values())
        for name, value in stages.items():
            table.add_row(_STAGES[name], f"{value:.2f}", f"{100.0 * value / whole:.0f} %")
        console.print(table)


_FIGURES = {
    "update_ms_60": "update of the scene per frame, 60 vehicles, ms",
    "update_ms_200": "update of the scene per frame, 200 vehicles, ms",
    "realtime_factor": "5 agents at 10 Hz on all cores, times real time",
    "subrays4_cost": "4 rays per beam, times the cost of one",
    "subrays8_cost": "8 rays per beam, times the cost of one",
    "speedup_trimesh": "times as fast as trimesh's ray caster, all cores",
    "speedup_trimesh_1t": "times as fast as trimesh's ray caster, 1 thread",
    "speedup_open3d": "times as fast as Open3D's ray caster, both all cores",
}


def show_contents(console: Console, distances: list[NDArray[np.float32]], sweeps: list[Sweep]) -> None:
    """Say what a sweep holds, so that nobody compares an empty street with a full one."""
    hit = float(np.mean([(distance < BENCHMARK_LIDAR.range_max_m).mean() for distance in distances]))
    points = float(np.mean([len(sweep) for sweep in sweeps]))
    moving = float(np.mean([(sweep.object_id != STATIC).sum() for sweep in sweeps]))
    console.print(f"{100.0 * hit:.1f} % of the rays hit; a sweep has {points:.0f} points, {moving:.0f} on vehicles")


def main(quick: bool = False, city: bool = False) -> None:
    """Measure the LiDAR: tables for people, then one line of JSON.

    Args:
        quick: fewer and shorter samples.
        city: measure memory and time in a city of five million triangles instead.
    """
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    console = Console(width=100, highlight=False)
    if city:
        measured = measure_city(CITY_TRIANGLES)
        for key, value in measured.items():
            console.print(f"{key}: {value:.4g}" + (f" (goal <= {GOALS[key]})" if key in GOALS else ""))
        print(json.dumps({key: round(value, 4) for key, value in measured.items()} | {"cpu": _cpu_name()}))
        return
    street = make_street()
    try:
        fused: RayScene | None = street.scene("fused")
    except SettingsError as error:
        console.print(str(error))
        fused = None
    bare = bare_embree(street)
    show_contents(console, bare(), complete_frame(fused or street.scene("public"), street, None)())
    effort = QUICK if quick else FULL
    timings = measure(
        variants_of(street, bare, fused), rounds=effort.rounds, keep=effort.keep, sample_s=effort.sample_s
    )
    figures = figures_of(timings, street.agents)
    facts = facts_of(street, timings)
    show(console, timings, figures, street.agents)
    if (load := float(np.median([timing.load for timing in timings.values()]))) > _LOADED:
        console.print(f"others kept {load:.1f} cores busy meanwhile: on several threads it is faster than shown here")
    print(json.dumps(figures | facts))


if __name__ == "__main__":
    tyro.cli(main)
