"""Figures of sweeps on the empty streets of worlds of version 2, at twelve places of each area, or of drives: medians.

Beside them the least and the greatest of real sweeps, NAME.npz as `studies.sensor_fit` reads them.

Usage:
    python -m studies.empty_streets
    python -m studies.empty_streets helsinki --lidars vlp-32c-av2 --world 1
    python -m studies.empty_streets --drives dsrc-sim-2/train/braunschweig_511_hdl-64e-kitti
    DSRC_REAL_FRAMES=frames python -m studies.empty_streets --lidars hdl-64e-kitti --names "kitti_*"
"""

import argparse
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from dsrc.data.changes import in_world
from dsrc.data.drives import open_drive
from dsrc.realism.figures import figures_of, sweeps_of
from dsrc.tables.table import Table
from sensors.presets import get_lidar
from sensors.scan.lidar import scan
from sensors.scan.scene import RayScene
from sensors.spec import LidarSpec
from sensors.sweep import Sweep
from sim.boxes import Boxes
from sim.catalog.load import load_scenario
from sim.errors import DataError, ScenarioError
from sim.geometry import pose_matrix
from sim.world.build import build_world
from sim.world.ground import streets_of
from sim.world.roads.streets import Streets
from studies.sensor_fit import VARIABLE, read_frame

AREAS = ("four_way", "ingolstadt", "helsinki", "braunschweig")
LIDARS = ("hdl-64e-kitti", "vlp-32c-av2", "hdl-32e")
FIGURES = (
    ("standing_5", 0.5, "share that stands, 5 to 15 m"),
    ("standing_15", 0.5, "the same, 15 to 30 m"),
    ("scattered", 0.5, "leaf-like share of it, 5 to 30 m"),
    ("residual", 0.5, "residual of the ground, m"),
    ("slope", 0.5, "slope of it, median"),
    ("slope", 0.9, "the same, 90 %"),
    ("intensity_ground", 0.5, "intensity of the ground, median"),
    ("intensity_vehicle", 0.5, "of vehicles, median"),
    *((f"returns_{k}", 0.5, f"returns, beams {k + 1}/8 from the top") for k in range(8)),
)
"""Figures of a sweep, the quantile of each that is told, and titles."""
PLACES, SWEEPS = 12, 8
_FROM_END_M = 5.0


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("areas", nargs="*", default=AREAS, help="scenarios; default: four areas")
    parser.add_argument("--lidars", nargs="+", default=LIDARS, help="presets; default: three of data sets")
    parser.add_argument("--world", type=int, choices=(1, 2), default=2, help="version of the world")
    parser.add_argument("--seed", type=int, default=1, help="of the world and the places")
    parser.add_argument("--drives", nargs="+", type=Path, help="drives, whose first sweeps are measured, no areas")
    parser.add_argument("--names", default="*", help=f"pattern of the real sweeps' names in the folder {VARIABLE}")
    options = parser.parse_args()
    folder = os.environ.get(VARIABLE)
    real = [read_frame(path) for path in sorted(Path(folder).glob(f"{options.names}.npz"))] if folder else []
    beside = {f"{len(real)} real": spans(figures_in(real))} if real else {}
    try:
        if options.drives:
            print(table({folder.name: medians(figures_in(sweeps_in(folder))) for folder in options.drives} | beside))
            return
        specs = [get_lidar(name) for name in options.lidars]
        found = {name: on_streets(name, options.world, specs, options.seed) for name in options.areas}
    except (DataError, ScenarioError) as error:
        parser.error(str(error))
    for row, spec in enumerate(specs):
        print(f"{spec.name}\n\n{table({name: area[row] for name, area in found.items()} | beside)}")


def table(columns: Mapping[str, Sequence[str]]) -> str:
    """Return a Markdown table of figures that at least one column has."""
    rows = zip((title for _, _, title in FIGURES), *columns.values(), strict=True)
    return Table.of(["", *columns], [row for row in rows if any(row[1:])], 1).markdown()


def on_streets(name: str, world: Literal[1, 2], specs: Sequence[LidarSpec], seed: int) -> list[list[str]]:
    """Return the medians of each sensor's figures at the places of an area."""
    scenario = in_world(load_scenario(name), world)
    streets, scene = streets_of(scenario, seed), RayScene(build_world(scenario, seed))
    where = places(streets, seed)
    return [
        medians(figures_in([(sweep_at(scene, streets, spec, place, seed), Boxes.zeros()) for place in where]))
        for spec in specs
    ]


def sweeps_in(folder: Path) -> list[tuple[Sweep, Boxes]]:
    """Return the sweeps of the first vehicle in the first frames of a drive, and the boxes around it."""
    drive = open_drive(folder)
    return [sweeps_of(drive.read(frame))[0] for frame in range(min(SWEEPS, len(drive)))]


def figures_in(sweeps: Sequence[tuple[Sweep, Boxes]]) -> list[NDArray[np.float64]]:
    """Return each of `FIGURES` of the sweeps that have it, with the boxes of their road users."""
    samples = [figures_of(*one) for one in sweeps]
    return [np.array([np.quantile(one[name], share) for one in samples if name in one]) for name, share, _ in FIGURES]


def medians(figures: Sequence[NDArray[np.float64]]) -> list[str]:
    """Return the median of each figure, in three decimals; "" where no sweep has it."""
    return [f"{np.median(values):.3f}" if len(values) else "" for values in figures]


def spans(figures: Sequence[NDArray[np.float64]]) -> list[str]:
    """Return the least and the greatest of each figure, in three decimals; "" where no sweep has it."""
    return [f"{values.min():.3f}–{values.max():.3f}" if len(values) else "" for values in figures]


def places(streets: Streets, seed: int) -> list[tuple[float, float, float]]:
    """Return x, y and yaw of random places on the lanes of an area, evenly over their length."""
    rng = np.random.default_rng(seed)
    lines = [shapely.LineString(lane.line) for lane in streets.lanes if lane.kind == "road" and not lane.internal]
    lines = [line for line in lines if line.length > 2.0 * _FROM_END_M]
    share = np.array([line.length for line in lines])
    frame = shapely.box(*streets.area)
    found: list[tuple[float, float, float]] = []
    while len(found) < PLACES:
        line = lines[int(rng.choice(len(lines), p=share / share.sum()))]
        at = float(rng.uniform(_FROM_END_M, line.length - _FROM_END_M))
        (x, y), (ahead_x, ahead_y) = (line.interpolate(at + step).coords[0] for step in (0.0, 0.5))
        if frame.contains(shapely.Point(x, y)):
            found.append((x, y, float(np.arctan2(ahead_y - y, ahead_x - x))))
    return found


def sweep_at(scene: RayScene, streets: Streets, spec: LidarSpec, place: tuple[float, float, float], seed: int) -> Sweep:
    """Return the sweep of an upright sensor at the height of its mount above a place."""
    x, y, yaw = place
    z = float(streets.height(np.array([[x, y]]))[0]) + spec.mount_xyz_m[2]
    pose = pose_matrix([x, y, z], yaw)
    return scan(scene, spec, pose, pose, 0.0, np.random.default_rng(seed))


if __name__ == "__main__":
    main()
