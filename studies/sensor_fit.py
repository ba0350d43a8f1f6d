"""What a sensor reports in a data set beside what its preset reports: intensities by class, returns by beams.

The presets `hdl-64e-kitti` and `vlp-32c-av2` were fitted by these tables: the curve of intensities so that medians of
ground, vehicles and what stands agree, the range at which they fade, the sectors that the carrier hides, and the loss
from the holes of single beams in rings.

Real sweeps are those of a folder that `DSRC_REAL_FRAMES` names, NAME.npz with `points` (N, 4: x, y, z, intensity of 0
to 1, in the sensor's frame), `boxes` (M, 7), `kind` (M: vehicle or another) and `ring`, which is empty where the order
of the points tells it. Without it nothing is printed.

Usage:
    DSRC_REAL_FRAMES=frames python -m studies.sensor_fit --names "kitti_*"
    DSRC_REAL_FRAMES=frames python -m studies.sensor_fit --names "kitti_*" --simulated data/kitti-like
"""

import argparse
import os
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dsrc.data.points_in_boxes import points_in_boxes
from dsrc.realism.figures import Samples, figures_of
from dsrc.realism.gauge import measure
from dsrc.tables.table import Table
from sensors.corruptions.physics.rings import measured_elevation
from sensors.sweep import Sweep, make_sweep
from sim.boxes import Boxes

VARIABLE = "DSRC_REAL_FRAMES"
RANGES_M = (2.0, 5.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0, 80.0)
SECTOR_DEG = 5
FEW, SOME = 0.25, 0.65
"""Shares of the fullest sector's points below which one is drawn as hidden, and as partly hidden."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--names", default="*", help="pattern of the frames' names")
    parser.add_argument("--simulated", type=Path, nargs="*", default=[], help="drives of the preset")
    options = parser.parse_args()
    folder = os.environ.get(VARIABLE)
    if folder is None:
        print(f"{VARIABLE}: no folder of real sweeps")
        return
    frames = [read_frame(path) for path in sorted(Path(folder).glob(f"{options.names}.npz"))]
    simulated = measure(options.simulated, frames=4) if options.simulated else []
    print(medians_table([figures_of(*frame) for frame in frames], simulated).text(120))
    print(range_table(frames).text(120))
    print("\n".join(hidden_sectors([sweep for sweep, _ in frames])))


def read_frame(path: Path) -> tuple[Sweep, Boxes]:
    """Return a sweep and the boxes of its vehicles."""
    with np.load(path, allow_pickle=False) as frame:
        points, ring = frame["points"], frame["ring"].astype(np.int16)
        boxes = Boxes.from_array(frame["boxes"].reshape(-1, 7)[frame["kind"] == "vehicle"].astype(np.float64))
    ring = _from_top(points, ring if len(ring) else _turns(points))
    return make_sweep(points[:, :3].astype(np.float32), intensity=points[:, 3], ring=ring), boxes


def medians_table(real: Sequence[Samples], simulated: Sequence[Samples]) -> Table:
    """Table of the least and greatest median of each figure of intensity and of returns."""
    names = [name for name in real[0] if name.startswith(("intensity", "returns"))]
    rows = [(name, *_span(real, name), *_span(simulated, name)) for name in names]
    columns = ("figure", "real from", "real to", "simulated from", "simulated to")
    return Table.of(columns, rows, name="medians", title="Medians of sweeps")


def range_table(frames: Sequence[tuple[Sweep, Boxes]]) -> Table:
    """Table of the median intensity over the range, of vehicles and of all else."""
    groups: dict[tuple[float, float], list[list[float]]] = {span: [[], []] for span in pairwise(RANGES_M)}
    for sweep, boxes in frames:
        on_vehicle = np.zeros(len(sweep), bool)
        on_vehicle[points_in_boxes(boxes, sweep.points)[0]] = True
        for (low, high), lists in groups.items():
            band = (sweep.range >= low) & (sweep.range < high)
            for values, among in zip(lists, (on_vehicle, ~on_vehicle), strict=True):
                values.extend(sweep.intensity[band & among].tolist())
    rows = [
        (f"{low:.0f}-{high:.0f} m", *(float(np.median(values)) if values else float("nan") for values in lists))
        for (low, high), lists in groups.items()
    ]
    return Table.of(("range", "vehicles", "all else"), rows, name="range", title="Median intensity")


def hidden_sectors(sweeps: Sequence[Sweep]) -> list[str]:
    """Return a line per ring: its sectors from -180 degrees on, # where hardly any sweep has a point, + where few."""
    count = 1 + max(int(sweep.ring.max()) for sweep in sweeps)
    edges = np.arange(-180, 181, SECTOR_DEG)
    most = np.zeros((count, len(edges) - 1))
    for sweep in sweeps:
        azimuth = np.degrees(np.arctan2(sweep.points[:, 1], sweep.points[:, 0]))
        most = np.maximum(most, np.histogram2d(sweep.ring, azimuth, (np.arange(count + 1) - 0.5, edges))[0])
    share = most / max(most.max(), 1.0)
    return [
        f"{ring:3d} " + "".join("#" if s < FEW else "+" if s < SOME else "." for s in row)
        for ring, row in enumerate(share)
    ]


def _turns(points: NDArray[np.floating]) -> NDArray[np.int16]:
    """Return (P,) rings of points that are listed ring by ring, each counter-clockwise from straight ahead."""
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0])) % 360.0
    return np.concatenate([[0], np.cumsum(np.diff(azimuth) < -180.0)]).astype(np.int16)


def _from_top(points: NDArray[np.floating], ring: NDArray[np.int16]) -> NDArray[np.int16]:
    """Return (P,) rings in the order of their elevations, the highest 0: data sets number lasers as they fire."""
    count = int(ring.max(initial=0)) + 1
    order = np.argsort(-measured_elevation(points, ring, count), kind="stable")
    return np.argsort(order)[ring].astype(np.int16)


def _span(sweeps: Sequence[Samples], name: str) -> tuple[float, float]:
    medians = [float(np.median(sweep[name])) for sweep in sweeps if name in sweep]
    return (min(medians), max(medians)) if medians else (float("nan"), float("nan"))


if __name__ == "__main__":
    main()
