"""Pictures of every LiDAR preset over the same street: bird's eye, range image and intensity image.

Usage:
    python -m studies.pictures.lidar_presets --out docs/pictures/lidar
    python -m studies.pictures.lidar_presets --out /tmp/pictures --only vlp-16 hdl-64e-s2 --scenario ingolstadt
"""

import argparse
from pathlib import Path

import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, LogNorm, Normalize, PowerNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from sensors.frame import Frame
from sensors.presets import LIDARS, get_lidar
from sensors.recording.record import Recording, record
from sensors.recording.rig import Rig
from sensors.spec import LidarSpec
from sensors.sweep import STATIC, Sweep
from sim.catalog.load import load_scenario
from sim.geometry import invert, transform_points
from sim.scenario import RoadsideUnit
from sim.traffic.sumo.traffic import SumoTraffic
from sim.world.build import build_world
from studies.look import EMPTY, FAINT, GRID, HIGHLIGHT, INK, colorbar, new_figure, part_of, save, style

MAST_M = 3.0
"""Sensors mounted higher than this stand on the mast of the scenario's first roadside unit, tilted down."""
MAST_PITCH_DEG = 12.0
RANGE = LogNorm(2.0, 120.0), part_of("turbo_r", 0.08, 0.93)
HEIGHT = Normalize(0.0, 8.0), part_of("viridis", 0.35, 1.0)
INTENSITY = PowerNorm(0.5, 0.0, 1.0), part_of("inferno", 0.1, 1.0)
"""Colour scales: logarithmic for near ranges, square root for the weak intensity of asphalt."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the pictures, one PNG per preset")
    parser.add_argument("--only", nargs="+", metavar="NAME", default=list(LIDARS), help="presets; all when left out")
    parser.add_argument("--scenario", default="braunschweig", help="where: the name of a scenario")
    parser.add_argument("--seed", type=int, default=2, help="of traffic and noise")
    options = parser.parse_args()
    specs = [get_lidar(name) for name in options.only]
    scenario = load_scenario(options.scenario)
    with SumoTraffic(scenario, options.seed) as traffic:
        street = record(traffic, build_world(scenario, options.seed), scenario, options.seed, frames=1)
    mast = scenario.agents.roadside[0] if scenario.agents.roadside else None
    for spec in specs:
        path = options.out / f"{spec.name}.png"
        with style():
            save(draw(frame_of(street, spec, mast), spec), path, colors=256)
        print(f"{path}  {path.stat().st_size / 1024:.0f} kB")


def frame_of(street: Recording, spec: LidarSpec, mast: RoadsideUnit | None) -> Frame:
    """Return the first frame of a drive with one agent, which carries `spec`."""
    if spec.mount_xyz_m[2] <= MAST_M or mast is None:
        units, agent_id = (), street.vehicles[0]
    else:
        x, y, _ = mast.xyz_m
        unit = RoadsideUnit(
            xyz_m=(x, y, spec.mount_xyz_m[2]), yaw_deg=mast.yaw_deg, pitch_deg=MAST_PITCH_DEG, lidar=spec.name
        )
        units, agent_id = (unit,), -1
    rule = msgspec.structs.replace(street.rig.scenario.agents, roadside=units)
    scenario = msgspec.structs.replace(street.rig.scenario, agents=rule)
    rig = Rig(scenario, street.rig.scene, street.rig.seed, vehicle_spec=spec)
    return rig.frame(0, [agent_id], street.steps[0], after=street.steps[street.margin])


def draw(frame: Frame, spec: LidarSpec) -> Figure:
    """Return the picture of the only agent's sweep."""
    sweep = frame.agents[0].sweep
    fired = spec.rings * spec.columns
    beams = sweep.ring.astype(np.int64) * spec.columns + sweep.column
    figure = new_figure(
        12.0,
        5.0,
        spec.name,
        f"{len(sweep):,} points; {len(np.unique(beams)) / fired:.0%} of {fired:,} fired beams return"
        f" · {'lines' if spec.prisms else 'rings'}: {spec.rings}, {spec.rate_hz:g} Hz, {spec.range_max_m:g} m,"
        f" returns: {spec.returns}, sub-rays: {spec.subrays}",
    )
    grid = figure.add_gridspec(2, 2, width_ratios=(1.0, 1.55))
    birds_eye(figure.add_subplot(grid[:, 0]), frame, spec)
    ranges, intensities = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
    sensor_image(ranges, sweep, spec, sweep.range, *RANGE)
    sensor_image(intensities, sweep, spec, sweep.intensity, *INTENSITY)
    ranges.set_title("Range image, as seen from the sensor; black: no return")
    intensities.set_title("Intensity image")
    colorbar(ranges, *RANGE, "range, m (log scale)", (2, 5, 10, 20, 50, 100))
    colorbar(intensities, *INTENSITY, "intensity (square-root scale)", (0, 0.05, 0.2, 0.5, 1))
    return figure


def birds_eye(axes: Axes, frame: Frame, spec: LidarSpec) -> None:
    """Draw the points from above, the agent's heading upwards; road users are orange."""
    agent = frame.agents[0]
    body_from_world = invert(agent.world_from_body)
    points = transform_points(body_from_world, agent.sweep.world_points)
    ahead = spec.azimuth_end_deg - spec.azimuth_start_deg < 359.0
    low, high = (-12.0, 88.0) if ahead else (-50.0, 50.0)
    shown = (points[:, 0] > low) & (points[:, 0] < high) & (np.abs(points[:, 1]) < 50.0)
    still = shown & (agent.sweep.object_id == STATIC)
    moving = shown & ~still
    size = 0.4 if len(agent.sweep) > 60_000 else 0.9
    look = {"s": size, "linewidths": 0, "rasterized": True}
    norm, cmap = HEIGHT
    axes.scatter(-points[still, 1], points[still, 0], c=points[still, 2], norm=norm, cmap=cmap, **look)
    axes.scatter(-points[moving, 1], points[moving, 0], c=HIGHLIGHT, **(look | {"s": 2.0 * size}))
    for outline in transform_points(body_from_world, flat_corners(frame)):
        axes.fill(-outline[:, 1], outline[:, 0], fill=False, edgecolor=INK, linewidth=0.5, alpha=0.6)
    axes.scatter([0.0], [0.0], marker="^", s=26, c=INK, linewidths=0)
    axes.set(xlim=(-50.0, 50.0), ylim=(low, high), aspect="equal", xlabel="to the right, m", ylabel="ahead, m")
    axes.grid(visible=True)
    axes.set_title("Bird's eye; road users orange, their true boxes outlined", fontsize=9)
    colorbar(axes, *HEIGHT, "height above the road, m")


def flat_corners(frame: Frame) -> NDArray[np.float64]:
    """Return (N, 4, 3) corners of the true boxes at the height of their centres."""
    polygons = frame.truth.bev_polygons()
    height = np.broadcast_to(frame.truth.center[:, None, 2:3], (*polygons.shape[:2], 1))
    return np.concatenate([polygons, height], axis=-1)


def sensor_image(
    axes: Axes, sweep: Sweep, spec: LidarSpec, value: NDArray[np.float32], norm: Normalize, cmap: Colormap
) -> None:
    """Draw a value of the nearest returns over ring and column, or over the angles where there are no rings."""
    first = sweep.return_number == 1
    axes.set_facecolor(EMPTY)
    axes.grid(visible=False)
    if spec.prisms:
        x, y, z = sweep.points[first].T
        azimuth, elevation = np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(z, np.hypot(x, y)))
        axes.scatter(azimuth, elevation, c=value[first], norm=norm, cmap=cmap, s=0.8, linewidths=0)
        axes.set(xlabel="azimuth, degrees", ylabel="elevation, degrees")
        axes.invert_xaxis()
        return
    column = straightened(sweep.ring[first], sweep.column[first], spec)
    inside = (column >= 0) & (column < spec.columns)
    image = np.full((spec.rings, spec.columns), np.nan, np.float32)
    image[sweep.ring[first][inside], column[inside]] = value[first][inside]
    axes.imshow(image, cmap=cmap, norm=norm, aspect="auto", interpolation="nearest")
    axes.set(xlabel="column, shifted by the azimuth offset of its ring", ylabel="ring (0 = top)")
    axes.tick_params(color=GRID, labelcolor=FAINT)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    if not spec.clockwise:
        axes.invert_xaxis()  # the head turns to the left: later columns are farther left


def straightened(ring: NDArray[np.int16], column: NDArray[np.int32], spec: LidarSpec) -> NDArray[np.int64]:
    """Return (P,) the column of each beam's azimuth: beams of one column are up to 20 degrees apart."""
    turn = np.radians(spec.azimuth_end_deg - spec.azimuth_start_deg)
    shift = np.rint(spec.azimuth_offset / turn * spec.columns * (-1.0 if spec.clockwise else 1.0)).astype(np.int64)
    moved = column + shift[ring]
    return moved % spec.columns if turn > np.radians(359.0) else moved


if __name__ == "__main__":
    main()
