"""Sweeps of an HDL-64E in worlds of version 2, with rows of parked cars, coloured by height above the ground.

Usage:
    python -m studies.pictures.sweeps --out docs/pictures/reality
    python -m studies.pictures.sweeps --out /tmp/pictures --only four_way helsinki
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize

from dsrc.data.changes import in_world, parked_along, with_sensors
from dsrc.data.write import simulate_frames
from dsrc.ops.ground import fit_ground
from dsrc.realism.figures import sweeps_of
from sensors.sweep import Sweep
from sim.boxes import Boxes
from sim.catalog.load import load_scenario
from sim.errors import ScenarioError
from studies.look import FAINT, INK, new_figure, part_of, save, style

PLACES = (
    *("berlin", "braunschweig", "helsinki", "ingolstadt", "koenigs_wusterhausen", "research_junction"),
    *("resco_cologne1", "resco_cologne8", "resco_ingolstadt21", "rilsa_1", "rilsa_3", "motorway_a10"),
)
LIDAR, PARKED_PER_KM = "hdl-64e-kitti", 110.0
REACH_M = (40.0, 20.0)
TALL_M = 4.0
"""Height above the ground at which the colours end."""
_STANDING_M = 0.3


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the picture")
    parser.add_argument("--only", nargs="+", default=PLACES, help="scenarios; default: twelve places")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    columns = min(2, len(options.only))
    rows = -(-len(options.only) // columns)
    with style():
        size = f"{2 * REACH_M[0]:.0f} m x {2 * REACH_M[1]:.0f} m"
        note = f"{LIDAR}, {size}; grey: ground, colours: up to {TALL_M:.0f} m above it"
        figure = new_figure(4.6 * columns, 2.5 * rows + 0.7, "Sweeps in worlds of version 2", note)
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for panel, name in zip(axes, options.only, strict=False):
            try:
                draw(panel, name, *sweep_in(name, options.seed))
            except ScenarioError as error:
                parser.error(str(error))
        for panel in axes[len(options.only) :]:
            panel.set_visible(False)
        options.out.mkdir(parents=True, exist_ok=True)
        print(save(figure, options.out / "sweeps.png", colors=96))


def sweep_in(name: str, seed: int) -> tuple[Sweep, Boxes]:
    """Return the first vehicle's sweep at a place, and the boxes of all others in its sensor's frame."""
    scenario = with_sensors(load_scenario(name), vehicles=1, lidar=LIDAR, roadside=False)
    frame = next(simulate_frames(parked_along(in_world(scenario, 2), PARKED_PER_KM), frames=1, seed=seed))
    return sweeps_of(frame)[0]


def draw(panel: Axes, name: str, sweep: Sweep, boxes: Boxes) -> None:
    """Draw a sweep from above, upright boxes as outlines."""
    points = sweep.points.astype(np.float64)
    height = points[:, 2] - fit_ground(points).at(points)
    stands = height > _STANDING_M
    panel.scatter(*points[~stands, :2].T, c=FAINT, s=0.15, linewidths=0, alpha=0.5)
    order = np.flatnonzero(stands)[np.argsort(height[stands])]
    panel.scatter(
        *points[order, :2].T,
        c=height[order],
        s=0.6,
        linewidths=0,
        cmap=part_of("viridis", 0.25, 1.0),
        norm=Normalize(0.0, TALL_M),
    )
    for corners in boxes.bev_polygons()[:, [0, 1, 2, 3, 0]]:
        panel.plot(*corners.T, color=INK, linewidth=0.7)
    panel.set(xlim=(-REACH_M[0], REACH_M[0]), ylim=(-REACH_M[1], REACH_M[1]), aspect="equal", title=name)
    panel.set_xticks([])
    panel.set_yticks([])


if __name__ == "__main__":
    main()
