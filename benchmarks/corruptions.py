"""How fast the corruptions are, beside the implementations that they replace.

Every kind corrupts one sweep of 120,000 points of the benchmark's street, in both families where there are two, and as
an array that knows no sensor and no rings, as other data sets have it (`array_...`). The times of the references were
measured once, on a sweep of 120,268 points (KITTI 000001) on a machine of two cores: most of them ship without a
licence to take them along, or without what they need to run. So a ratio compares machines, too. LidarAug, the one on
PyPI, is timed in the same run where it is installed. MultiCorrupt's times are those that a user of it stated.

    python -m benchmarks.corruptions            # everything
    python -m benchmarks.corruptions --quick    # fewer and shorter samples
"""

import importlib.util
import json
import os
import sys
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import tyro
from numpy.typing import NDArray
from rich.console import Console

from dsrc.tables.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.frames import FRAME_S
from benchmarks.quiet import Timing, measure
from benchmarks.street import BENCHMARK_LIDAR, fleet, street_world
from dsrc.data.clouds.corrupt import corrupt as corrupt_array
from sensors.corruptions import CORRUPTIONS, FAMILIES, Family, corrupt
from sensors.corruptions.fog import VISIBILITY_M
from sensors.corruptions.physics.rings import estimate_rings
from sensors.frame import AgentFrame, Frame, count_points
from sensors.scan.lidar import scan_all
from sensors.scan.scene import RayScene

POINTS = 120_000
"""Of the sweep."""

REFERENCES: dict[str, tuple[str, float]] = {
    "rings": ("LiDAR-Distillation, k-means", 2.7),
    "beam_missing": ("DSRC", 0.0097),
    "motion_blur": ("DSRC", 0.026),
    "fog": ("DSRC and Robo3D", 1.05),
    "snow": ("DSRC, light snow, two processes", 67.0),
    "crosstalk": ("DSRC", 0.0016),
    "cross_sensor": ("DSRC", 0.0073),
    "wet_ground": ("Hahner", 0.035),
    "rain": ("LISA", 6.9),
    "point_dropping": ("3D_Corruptions_AD, density", 0.0025),
    "field_of_view": ("3D_Corruptions_AD", 0.0020),
    "noise": ("3D_Corruptions_AD, Gaussian", 0.0095),
}
"""What each kind replaces and the seconds that it took."""

STATED = {"array_fog": 0.5 * 3600 * 32 / 6019, "array_snow": 12 * 3600 * 32 / 6019}
"""CPU seconds of one of nuScenes' 6019 scans of 34,700 points in MultiCorrupt: 0.5 and 12 hours of 32 CPUs, as a user
says in its issue 12, with the sweeps between the scans if these were made."""

GOALS = {"fog": 0.05, "snow": 0.6, "rain": 0.2, "peak_mb": 300.0}
"""At most; every other kind of the physical family at most its reference."""

_SEED = 1


@dataclass(frozen=True, slots=True)
class Effort:
    """How long to measure: samples of each, how many of them count, and the least duration of one, s."""

    rounds: int
    keep: int
    sample_s: float


FULL, QUICK = Effort(15, 7, 0.1), Effort(3, 2, 0.02)


def make_frame() -> Frame:
    """Return a frame of one agent with a sweep of `POINTS` points, among the vehicles of the benchmark's street."""
    vehicles = fleet(60)
    now, before, after = (vehicles.actors(time_s) for time_s in (0.0, -FRAME_S, FRAME_S))
    spec = msgspec.structs.replace(BENCHMARK_LIDAR, columns=2048, dropoff_rate=0.0, dropoff_zero_intensity=0.0)
    sensor = vehicles.sensors(0.0, np.random.default_rng(_SEED), spec)[0]
    scene = RayScene(street_world(), body_mesh=vehicles.body_mesh).with_bodies(now, before, after)
    sweep = scan_all(scene, [sensor])[0][:POINTS]
    row = vehicles.agents[0]
    own = int(now.boxes.object_id[row])
    return Frame(
        index=0,
        time_s=now.time_s,
        agents=(AgentFrame(own, "vehicle", now.world_from_body()[row], 0.0, sweep),),
        truth=now.boxes,
        velocity=now.velocity,
        points_on=count_points(sweep, now.boxes.object_id)[None],
    )


def variants_of(frame: Frame, severity: int) -> dict[str, Callable[[], object]]:
    """Return what is timed, by name: kinds of the physical family bare, others with a prefix or a suffix."""
    sweep = frame.agents[0].sweep
    variants: dict[str, Callable[[], object]] = {}
    for kind, corruption in CORRUPTIONS.items():
        if corruption.apply is not None:
            variants[kind] = _on_sweep(frame, kind, severity, "physical")
        if corruption.in_frame is not None:
            settings = corruption.settings.severity(severity)
            name = kind if corruption.apply is None else f"{kind}_in_frame"
            variants[name] = _in_frame(frame, corruption.in_frame, settings)
    variants["rings"] = partial(estimate_rings, sweep.points)
    cloud = np.column_stack([sweep.points, sweep.intensity])
    for kind, corruption in CORRUPTIONS.items():
        if corruption.apply is not None and not corruption.of_objects:
            variants[f"array_{kind}"] = partial(corrupt_array, cloud, kind, severity, _SEED)
    variants |= lidar_aug_variants(cloud, severity)
    for kind, corruption in CORRUPTIONS.items():
        if corruption.paper_apply is not None:
            variants[f"paper_{kind}"] = _on_sweep(frame, kind, severity, "paper")
    return variants


def lidar_aug_variants(cloud: NDArray[np.float32], severity: int) -> dict[str, Callable[[], object]]:
    """Return the fog of LidarAug (Teufel et al. 2023) on the same cloud, nothing where it is not installed."""
    if importlib.util.find_spec("lidar_aug") is None:
        return {}
    import torch
    from lidar_aug.weather_simulations import FogParameter, fog

    points = torch.frombuffer(bytearray(cloud.tobytes()), dtype=torch.float32).reshape(-1, 4)
    torch.set_num_threads(1)
    return {"lidar_aug_fog": lambda: fog(points, FogParameter.DIST, VISIBILITY_M[severity - 1])}


def _on_sweep(frame: Frame, kind: str, severity: int, family: Family) -> Callable[[], object]:
    sweep = frame.agents[0].sweep
    return lambda: corrupt(sweep, kind, severity, np.random.default_rng(_SEED), family)


def _in_frame(frame: Frame, apply: Callable[..., object], settings: object) -> Callable[[], object]:
    return lambda: apply(frame, 0, settings, np.random.default_rng(_SEED))


def peak_mb(run: Callable[[], object]) -> float:
    """Return the most memory that one call, tables that it makes included, holds beyond what was there, MB."""
    tracemalloc.start()
    try:
        run()
        return tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()


def reference_of(name: str) -> tuple[str, float] | None:
    """Return what a variant replaces, None when nothing like it was published with a time."""
    kind = name.removeprefix("paper_").removeprefix("array_").removesuffix("_in_frame")
    return REFERENCES.get(kind)


def goal_of(name: str) -> float | None:
    """Return the most seconds that a variant may take, None where there is no goal."""
    if name in GOALS:
        return GOALS[name]
    reference = reference_of(name)
    return reference[1] if reference is not None and name in CORRUPTIONS else None


def show(console: Console, timings: dict[str, Timing], memory: dict[str, float], points: int) -> None:
    """Print the table."""
    rows = []
    for name, timing in timings.items():
        reference, goal = reference_of(name), goal_of(name)
        missed = "" if goal is None or timing.wall_s <= goal else " missed"
        peer = ("", "", "") if reference is None else (*reference, f"{reference[1] / timing.wall_s:.3g}")
        own = f"{timing.wall_s:.4f}", f"{timing.cpu_s:.4f}", f"{memory[name]:.0f}"
        rows.append((name, peer[0], *own, *peer[1:], "" if goal is None else f"<= {goal:g}{missed}"))
    head = ("what", "replaces", "s", "CPU s", "MB", "its s", "times faster", "goal")
    console.print(Table.of(head, rows, 2, title=f"One sweep of {points} points on one core"))


def main(quick: bool = False, severity: int = 3) -> None:
    """Time every corruption: a table for people, then one line of JSON.

    Args:
        quick: fewer and shorter samples.
        severity: of all kinds, 1 to 5.
    """
    console = Console(width=140, highlight=False)
    frame = make_frame()
    points = len(frame.agents[0].sweep)
    variants = variants_of(frame, severity)
    memory = {name: peak_mb(run) for name, run in variants.items()}
    effort = QUICK if quick else FULL
    timings = measure(variants, rounds=effort.rounds, keep=effort.keep, sample_s=effort.sample_s)
    show(console, timings, memory, points)
    others = float(np.median([timing.load for timing in timings.values()]))
    if others > 0.1:
        console.print(f"Others kept {others:.1f} cores busy meanwhile: CPU seconds are the figure to trust.")
    figures: dict[str, object] = {name: round(timing.wall_s, 5) for name, timing in timings.items()}
    figures |= {f"{name}_cpu": round(timing.cpu_s, 5) for name, timing in timings.items()}
    ratios = {name: reference[1] / timings[name].wall_s for name in timings if (reference := reference_of(name))}
    print(
        json.dumps(
            figures
            | {"peak_mb": round(max(memory.values()), 1)}
            | {"ratios": {name: round(ratio, 2) for name, ratio in ratios.items()}}
            | {"ratios_stated": {name: round(time_s / timings[name].cpu_s) for name, time_s in STATED.items()}}
            | {"points": points, "severity": severity, "families": list(FAMILIES), "cores": os.cpu_count()}
            | {"others_load_cores": round(others, 2)}
        )
    )


if __name__ == "__main__":
    tyro.cli(main)
