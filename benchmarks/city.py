"""Memory and time of the LiDAR in a city of millions of triangles, of which only what is around the sensors is held."""

import os
import resource
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.street import BENCHMARK_LIDAR, SIDE_M, Fleet, city, fleet
from sensors.scan.lidar import scan_all
from sensors.scan.scene import RayScene

_STEADY = 5


def measure_city(triangles: int) -> dict[str, float]:
    """Drive five agents through every district of a city and return what it took.

    Returns:
        `city_triangles`; `city_open_s`, to cut the mesh into tiles; `city_arrive_ms` and `city_arrive_worst_ms`, the
        first frame in a district, which joins its tiles and builds their hierarchy; `city_frame_ms`, the frames after
        it; `city_start_gb`, `city_open_gb`, `city_end_gb` of memory before, with the scene open and at the end;
        `city_peak_gb`, the most that the process ever held, the making of the mesh included.
    """
    vehicles = fleet(60)
    start_gb = _resident_gb()
    mesh = city(triangles)
    count = len(mesh.faces)
    centres = _districts(mesh.bounds)
    begin = time.perf_counter()
    scene = RayScene(mesh, body_mesh=vehicles.body_mesh)
    open_s = time.perf_counter() - begin
    del mesh
    open_gb = _resident_gb()
    arrive, steady = [], []
    for district, centre in enumerate(centres):
        here = _moved(vehicles, centre)
        durations = [_frame_s(scene, here, district) for _ in range(1 + _STEADY)]
        arrive.append(durations[0])
        steady.append(float(np.median(durations[1:])))
    return {
        "city_triangles": count,
        "city_open_s": open_s,
        "city_arrive_ms": 1e3 * float(np.median(arrive)),
        "city_arrive_worst_ms": 1e3 * max(arrive),
        "city_frame_ms": 1e3 * float(np.median(steady)),
        "city_start_gb": start_gb,
        "city_open_gb": open_gb,
        "city_end_gb": _resident_gb(),
        "city_peak_gb": _peak_gb(),
    }


def _districts(bounds: np.ndarray) -> list[tuple[float, float]]:
    """Return the centres of the districts of `city`, row by row."""
    columns, rows = np.rint((bounds[1] - bounds[0])[:2] / SIDE_M).astype(int)
    return [(SIDE_M * column, SIDE_M * row) for row in range(rows) for column in range(columns)]


def _moved(vehicles: Fleet, centre: tuple[float, float]) -> Fleet:
    start = vehicles.start
    boxes = replace(start.boxes, center=start.boxes.center + np.array([*centre, 0.0]))
    return replace(vehicles, start=replace(start, boxes=boxes))


def _frame_s(scene: RayScene, vehicles: Fleet, seed: int) -> float:
    begin = time.perf_counter()
    sensors = vehicles.sensors(0.0, np.random.default_rng(seed), BENCHMARK_LIDAR)
    scan_all(scene.with_bodies(vehicles.actors(0.0), vehicles.actors(-0.1), vehicles.actors(0.1)), sensors)
    return time.perf_counter() - begin


def _peak_gb() -> float:
    # Linux counts in KiB, macOS in bytes.
    unit = 1.0 if sys.platform == "darwin" else 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


def _resident_gb() -> float:
    statm = Path("/proc/self/statm")
    if not statm.exists():
        return float("nan")
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e9
