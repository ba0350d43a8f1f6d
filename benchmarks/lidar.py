"""How fast the LiDAR is, measured against Embree itself.

The unit is R: one call of `EmbreeScene.run(query="DISTANCE")` per sweep, robust, on one thread, over everything as it
stands at one instant, built beforehand and not counted. A complete sweep also makes its rays, moves the vehicles while
it turns, finds owners, materials and intensities, adds noise, loses some points and packs the others.

    python -m benchmarks.lidar            # everything
    python -m benchmarks.lidar --quick    # under 50 s: fewer and shorter samples
    python -m benchmarks.lidar --city     # instead: memory and time in a city of five million triangles
"""

import json
import logging
import math
import platform
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console

from dsrc.tables.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.city import measure_city
from benchmarks.frames import (
    FRAME_S,
    Street,
    bare_embree,
    complete_frame,
    fused_parts,
    make_street,
    scene_update,
)
from benchmarks.quiet import Timing, measure
from benchmarks.rivals import MujocoFrame, Open3DFrame, mujoco_lidar_version, open3d_version, trimesh_frame
from benchmarks.street import BENCHMARK_LIDAR, fleet
from sensors.scan.scene import RayScene
from sensors.sweep import STATIC, Sweep
from sim.errors import SettingsError
from sim.machine import core_count

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

_LOADED = 0.1

_SWEEPS = {
    "bare": "R: bare EmbreeScene.run, distances only, vehicles frozen",
    "public_1t": "public engine, 1 thread",
    "fused_1t": "fused engine, 1 thread",
    "fused_2t": "fused engine, 2 threads",
    "fused_all": "fused engine, all cores",
    "subrays_4": "fused engine, 1 thread, 4 rays per beam",
    "subrays_8": "fused engine, 1 thread, 8 rays per beam",
    "packets_static": "bare packets, 1 thread, streets only",
    "packets_baked": "bare packets, 1 thread, vehicles frozen",
    "trimesh": "trimesh: joined meshes and its ray caster",
    "open3d": "Open3D: its ray caster, all cores",
    "mujoco": "mujoco-lidar: MuJoCo's ray caster, 1 thread",
}

_FIGURES = {
    "update_ms_60": "update of the scene per frame, 60 vehicles, ms",
    "update_ms_200": "update of the scene per frame, 200 vehicles, ms",
    "realtime_factor": "5 agents at 10 Hz on all cores, times real time",
    "subrays4_cost": "4 rays per beam, times the cost of one",
    "subrays8_cost": "8 rays per beam, times the cost of one",
    "speedup_trimesh": "times as fast as trimesh's ray caster, all cores",
    "speedup_trimesh_1t": "times as fast as trimesh's ray caster, 1 thread",
    "speedup_open3d": "times as fast as Open3D's ray caster, both all cores",
    "speedup_mujoco_1t": "times as fast as mujoco-lidar's ray caster, 1 thread",
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


@dataclass(frozen=True, slots=True)
class Effort:
    """How long to measure: see `measure`."""

    rounds: int
    keep: int
    sample_s: float
    most_s: float


FULL, QUICK = Effort(21, 9, 0.2, math.inf), Effort(6, 5, 0.05, 2.0)


def variants_of(
    street: Street, bare: Callable[[], object], fused: RayScene | None, quick: bool
) -> dict[str, Callable[[], object]]:
    """Return everything that takes turns; what cannot run here is left out."""
    reach = BENCHMARK_LIDAR.range_max_m
    variants: dict[str, Callable[[], object]] = {
        "bare": bare,
        "public_1t": complete_frame(street.scene("public"), street, 1),
        "trimesh": lambda: trimesh_frame(street.static, street.vehicles, 0.0, street.rays, reach),
    }
    if open3d_version() is not None:
        open3d = Open3DFrame(street.static)
        variants["open3d"] = lambda: open3d(street.vehicles, 0.0, street.rays, reach)
    if mujoco_lidar_version() is not None:
        mujoco = MujocoFrame(street.static, street.vehicles, street.rays, reach)
        variants["mujoco"] = lambda: mujoco(street.vehicles, 0.0)
    if fused is None:
        return variants
    variants["fused_1t"] = complete_frame(fused, street, 1)
    variants["fused_2t"] = complete_frame(fused, street, 2)
    if core_count() != 2:
        variants["fused_all"] = complete_frame(fused, street, None)
    variants["subrays_4"] = complete_frame(fused, street, 1, subrays=4)
    if not quick:
        variants["subrays_8"] = complete_frame(fused, street, 1, subrays=8)
    crowd = fleet(200)
    crowded = RayScene(street.static, body_mesh=crowd.body_mesh, engine="fused")
    return variants | {
        "update_60": scene_update(fused, street.vehicles),
        "update_200": scene_update(crowded, crowd),
        **fused_parts(fused, street),
    }


def figures_of(timings: dict[str, Timing], agents: int) -> dict[str, float | None]:
    """Return the figures of the JSON line, None for what was not measured."""
    ms = {name: 1e3 * timing.wall_s for name, timing in timings.items()}

    def ratio(over: str, under: str) -> float | None:
        return ms[over] / ms[under] if over in ms and under in ms else None

    cpu = {name: timing.cpu_s / timings["bare"].cpu_s for name, timing in timings.items()}
    figures: dict[str, float | None] = {
        "ratio_public_1t": ratio("public_1t", "bare"),
        "ratio_fused_1t": ratio("fused_1t", "bare"),
        "ratio_fused_2t": ratio("fused_2t", "bare"),
        "ratio_public_1t_cpu": cpu.get("public_1t"),
        "ratio_fused_1t_cpu": cpu.get("fused_1t"),
        "update_ms_60": ms.get("update_60"),
        "update_ms_200": ms.get("update_200"),
        "realtime_factor": 1e3 * FRAME_S / ms["fused_all"] if "fused_all" in ms else None,
        "speedup_trimesh": ratio("trimesh", "fused_all"),
        "speedup_trimesh_1t": ratio("trimesh", "fused_1t"),
        "speedup_open3d": ratio("open3d", "fused_all"),
        "speedup_mujoco_1t": ratio("mujoco", "fused_1t"),
        "subrays4_cost": ratio("subrays_4", "fused_1t"),
        "subrays8_cost": ratio("subrays_8", "fused_1t"),
        **{f"{name}_sweep_ms": ms[name] / agents for name in _SWEEPS if name in ms},
        **{f"stage_{name}_ms": value for name, value in stage_ms(timings, agents).items()},
    }
    return {name: None if value is None else round(value, 4) for name, value in figures.items()}


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
        # Without vehicles the streets behind them are reported instead.
        "static": ms["kernel_static"] - ms["kernel_void"] - report,
        "moving": ms["kernel"] - ms["kernel_static"],
        "report": report,
    }
    stages["rest"] = ms["fused_1t"] - sum(stages.values())
    return stages


def facts_of(street: Street, timings: dict[str, Timing]) -> dict[str, object]:
    """Return what the figures were measured on."""
    return {
        "cpu": _cpu_name(),
        "cores": core_count(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in ("numpy", "numba", "embreex", "trimesh")}
        | {"open3d": open3d_version(), "mujoco-lidar": mujoco_lidar_version()},
        "others_load_cores": round(_load(timings), 2),
        "samples": min(timing.samples for timing in timings.values()),
        "static_triangles": len(street.static.faces),
        "moving_triangles": sum(len(mesh.faces) for mesh in street.vehicles.meshes()),
        "rays_per_sweep": len(street.rays[0].origins),
    }


def _load(timings: dict[str, Timing]) -> float:
    return float(np.median([timing.load for timing in timings.values()]))


def _cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.processor())


def show_contents(console: Console, distances: list[NDArray[np.float32]], sweeps: list[Sweep]) -> None:
    """Print the contents of a sweep, so that an empty street is not compared with a full one."""
    hit = float(np.mean([(distance < BENCHMARK_LIDAR.range_max_m).mean() for distance in distances]))
    points = float(np.mean([len(sweep) for sweep in sweeps]))
    moving = float(np.mean([(sweep.object_id != STATIC).sum() for sweep in sweeps]))
    console.print(f"{100.0 * hit:.1f} % of the rays hit; a sweep has {points:.0f} points, {moving:.0f} on vehicles")


def show(console: Console, timings: dict[str, Timing], figures: dict[str, float | None], agents: int) -> None:
    """Print the tables."""
    bare = timings["bare"]
    rows: list[tuple[str, ...]] = []
    for name, label in _SWEEPS.items():
        if name in timings:
            timing, goal = timings[name], GOALS.get(f"ratio_{name}")
            share, cpu = timing.wall_s / bare.wall_s, timing.cpu_s / bare.cpu_s
            ms = 1e3 * timing.wall_s / agents
            rows.append((label, f"{ms:.2f}", f"{share:.3f}", f"<= {goal}" if goal else "", f"{cpu:.3f}"))
        else:
            rows.append((label, "not installed" if name in ("open3d", "mujoco") else "not measured", "", "", ""))
    title = f"One sweep of 64 x 1800 rays, {agents} agents among 60 vehicles"
    console.print(Table.of(("what", "ms", "of R", "goal", "CPU of R"), rows, title=title))
    rows = []
    for key, label in _FIGURES.items():
        value, goal = figures[key], GOALS.get(key)
        sign = ">=" if key == "realtime_factor" else "<="
        rows.append((label, "-" if value is None else f"{value:.3g}", f"{sign} {goal}" if goal else ""))
    console.print(Table.of(("what", "measured", "goal"), rows, title="Figures"))
    if stages := stage_ms(timings, agents):
        total = sum(stages.values())
        rows = [(_STAGES[name], f"{ms:.2f}", f"{100.0 * ms / total:.0f} %") for name, ms in stages.items()]
        title = "Where a sweep of the fused engine goes, 1 thread"
        console.print(Table.of(("stage", "ms", "share"), rows, title=title))
    if (load := _load(timings)) > _LOADED:
        console.print(f"Others kept {load:.1f} cores busy meanwhile: a quiet machine is faster on several threads.")


def show_city(console: Console) -> None:
    """Measure the city and print what it took."""
    measured = measure_city(CITY_TRIANGLES)
    rows = ((key, f"{value:.4g}", f"<= {GOALS[key]}" if key in GOALS else "") for key, value in measured.items())
    title = "Five agents through every district of a city"
    console.print(Table.of(("what", "measured", "goal"), rows, title=title))
    print(json.dumps({key: round(value, 4) for key, value in measured.items()} | {"cpu": _cpu_name()}))


def main(quick: bool = False, city: bool = False) -> None:
    """Measure the LiDAR: tables for people, then one line of JSON.

    Args:
        quick: fewer and shorter samples.
        city: measure memory and time in a city of five million triangles instead.
    """
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    console = Console(width=100, highlight=False)
    if city:
        show_city(console)
        return
    street = make_street()
    fused: RayScene | None = None
    try:
        fused = street.scene("fused")
    except SettingsError as error:
        console.print(str(error))
    bare = bare_embree(street)
    show_contents(console, bare(), complete_frame(fused or street.scene("public"), street, None)())
    effort = QUICK if quick else FULL
    variants = variants_of(street, bare, fused, quick)
    timings = measure(variants, **asdict(effort))
    if core_count() == 2 and "fused_2t" in timings:
        timings["fused_all"] = timings["fused_2t"]
    figures = figures_of(timings, street.agents)
    show(console, timings, figures, street.agents)
    print(json.dumps(figures | facts_of(street, timings)))


if __name__ == "__main__":
    tyro.cli(main)
