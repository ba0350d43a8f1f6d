"""Pictures of every corruption: one sweep, clean and under each family, coloured by fate.

Usage:
    python examples/corruptions.py --out docs/pictures/corruptions
    python examples/corruptions.py --out pictures --only fog snow --severity 5 --scenario ingolstadt
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
from look import COLORS, EMPTY, FAINT, GRID, INK, PAGE, new_figure, save, style
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from sensors.corruptions import CORRUPTIONS, DEFAULT_SEVERITY, FAMILIES, SEVERITIES, Family, corrupt_frame, kinds_of
from sensors.frame import Frame
from sensors.recording.record import record
from sensors.recording.rig import Rig
from sensors.sweep import ADDED, ATTENUATED, KEPT, MOVED, SCATTERED, Sweep
from sim.catalog.load import load_scenario
from sim.geometry import invert, transform_points
from sim.traffic.sumo.traffic import SumoTraffic
from sim.world.build import build_world

LOST, BEFORE, BELIEVED = "lost: where it was", "where it was before", "where a wrong pose puts it"
FATES = {KEPT: "kept", ATTENUATED: "dimmer", MOVED: "moved", SCATTERED: "added"}
COLOR = {
    "kept": "#7C8AA0",
    "dimmer": COLORS[0],
    "moved": COLORS[4],
    "added": "#FF8A3D",
    LOST: "#E0304A",
    BEFORE: "#4A5566",
    BELIEVED: "#F2E96B",
}
"""Colours by fate of the points."""

RADIUS_M = {
    "motion_blur": 20.0,
    "crosstalk": 30.0,
    "incomplete_echo": 32.0,
    "pose_error": 14.0,
    "clock_offset": 25.0,
    "noise": 12.0,
}
"""Half widths of views from above other than `WIDE_M`, for small displacements, m."""
WIDE_M = 45.0
FAST = ("motion_blur", "clock_offset", "spray")
"""Kinds drawn on a motorway: they show at speed."""
SEVERITY = {"pose_error": 5}
"""Severities other than 3, for kinds that are invisible at 3."""

SEED = 2
AFTER_S, INTERVAL_S = 12.0, 0.1


@dataclass(frozen=True, slots=True)
class Panel:
    """Column of a picture: title and frame, whose last agent's sweep is drawn."""

    title: str
    frame: Frame

    @property
    def sweep(self) -> Sweep:
        """Drawn sweep."""
        return self.frame.agents[-1].sweep


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--out", type=Path, required=True, help="folder of the pictures: one per kind, and, of all kinds, all.png"
    )
    parser.add_argument("--only", nargs="+", choices=CORRUPTIONS, default=list(CORRUPTIONS), help="default: all")
    parser.add_argument("--severity", type=int, choices=SEVERITIES, help="default: 3, 5 for pose_error")
    parser.add_argument("--scenario", help="default: braunschweig, or highway for kinds that show at speed")
    options = parser.parse_args()
    places = {kind: options.scenario or ("highway" if kind in FAST else "braunschweig") for kind in options.only}
    streets = {place: street(place) for place in sorted(set(places.values()))}
    frames = {kind: shown(streets[place], kind) for kind, place in places.items()}
    figures: dict[str, Callable[[], Figure]] = {
        kind: partial(draw, frame, kind, options.severity) for kind, frame in frames.items()
    }
    if list(frames) == list(CORRUPTIONS):  # the sheet of all is not of some
        figures["all"] = partial(overview, frames, options.severity)
    for name, figure in figures.items():
        path = options.out / f"{name}.png"
        with style():
            save(figure(), path, colors=96, keep=(*COLOR.values(), PAGE, INK))
        print(f"{path}  {path.stat().st_size / 1024:.0f} kB")


def street(name: str) -> Frame:
    """Return one frame of a drive some seconds after its start, by sensors without random drop-off."""
    scenario = load_scenario(name)
    steps = round(AFTER_S / INTERVAL_S)
    with SumoTraffic(scenario, SEED) as traffic:
        drive = record(traffic, build_world(scenario, SEED), scenario, SEED, steps + 1, INTERVAL_S)
    spec = msgspec.structs.replace(drive.rig.vehicle_spec, dropoff_rate=0.0, dropoff_zero_intensity=0.0)
    rig = Rig(scenario, drive.rig.scene, SEED, vehicle_spec=spec)
    return replace(drive, rig=rig).frame(steps)


def draw(clean: Frame, kind: str, severity: int | None) -> Figure:
    """Return the picture of one kind: view from above and sensor image, clean and under each family."""
    level = severity or SEVERITY.get(kind, DEFAULT_SEVERITY)
    before = Panel("clean", clean)
    families: list[Family] = [family for family in FAMILIES if kind in kinds_of(family)]
    panels = [before, *(Panel(f, corrupt_frame(clean, kind, level, SEED, f)) for f in families)]
    # Errors of pose and clock leave the sensor image unchanged.
    images = [] if CORRUPTIONS[kind].spares_ego else panels
    figure = new_figure(
        4.1 * len(panels) + 0.2,
        5.3 + 1.35 * len(images),
        f"{kind.replace('_', ' ')}, severity {level}",
        note(clean),
    )
    room_below_note(figure)
    grid = figure.add_gridspec(1 + len(images), len(panels), height_ratios=[4.2, *[1.25] * len(images)])
    for column, panel in enumerate(panels):
        above = figure.add_subplot(grid[0, column])
        birds_eye(above, panel, before, RADIUS_M.get(kind, WIDE_M))
        above.set_title(f"{panel.title}\n{counts(panel.sweep)}", fontsize=8.5)
    for line, panel in enumerate(images, start=1):
        sensor_image(figure.add_subplot(grid[line, :]), panel, before)
    legend(figure)
    return figure


def overview(frames: dict[str, Frame], severity: int | None) -> Figure:
    """Return the picture of all kinds from above, under their physical models."""
    columns = min(4, len(frames))
    rows = -(-len(frames) // columns)
    size = (3.0 * columns + 0.1, 3.15 * rows + 0.9)
    figure = new_figure(*size, "All corruptions", "from above, by the physical models, with their severity")
    room_below_note(figure)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for place, (kind, clean) in zip(axes, frames.items(), strict=False):
        level = severity or SEVERITY.get(kind, DEFAULT_SEVERITY)
        after = Panel(kind, corrupt_frame(clean, kind, level, SEED))
        birds_eye(place, after, Panel("clean", clean), RADIUS_M.get(kind, WIDE_M))
        place.set_title(f"{kind.replace('_', ' ')}, {level}")
        place.set(xticklabels=[], yticklabels=[], xlabel="", ylabel="")
    for place in axes[len(frames) :]:
        place.set_axis_off()
    legend(figure)
    return figure


def room_below_note(figure: Figure) -> None:
    """Reserve room below the figure's note for panel titles of two lines."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.set(rect=(0.0, 0.0, 1.0, 1.0 - 0.12 / figure.get_figheight()))


def shown(frame: Frame, kind: str) -> Frame:
    """Return the frame with the drawn agent as its last one: the fastest vehicle.

    For kinds that spare the ego: the fastest other one, after the ego.
    """
    vehicles = [row for row, agent in enumerate(frame.agents) if agent.kind == "vehicle"]
    kept = vehicles[:1] if CORRUPTIONS[kind].spares_ego and len(vehicles) > 1 else []
    rows = [*kept, max(vehicles[len(kept) :], key=lambda row: frame.agents[row].speed)]
    return frame.of_agents(rows)


def note(clean: Frame) -> str:
    """Return the line below the title."""
    agent = clean.agents[-1]
    rings = agent.sweep.spec.rings if agent.sweep.spec is not None else 0
    return f"one sweep of a LiDAR with {rings} rings on a vehicle at {3.6 * agent.speed:.0f} km/h"


def counts(sweep: Sweep) -> str:
    """Return the number of points per fate, as text."""
    said = [f"{n:,} {name}" for fate, name in FATES.items() if (n := np.count_nonzero(sweep.fate == fate))]
    return ", ".join(said + [f"{sweep.lost:,} lost"] * (sweep.lost > 0))


def lost_points(panel: Panel, clean: Panel) -> Sweep:
    """Return the lost points of the clean sweep."""
    left = panel.sweep[panel.sweep.object_id != ADDED]
    return clean.sweep[~np.isin(beam_of(clean.sweep), beam_of(left))]


def beam_of(sweep: Sweep) -> NDArray[np.int64]:
    """Return (P,) keys of ring, column and return number."""
    return (sweep.ring.astype(np.int64) << 32) + (sweep.column.astype(np.int64) << 3) + sweep.return_number


def birds_eye(axes: Axes, panel: Panel, clean: Panel, radius_m: float) -> None:
    """Draw a sweep from above, true heading upwards, with the true boxes; close views over the clean sweep."""
    body_from_world = invert(clean.frame.agents[-1].world_from_body)
    axes.set_facecolor(EMPTY)
    size = 0.35 if radius_m >= WIDE_M else 1.2
    if radius_m < WIDE_M and panel.sweep is not clean.sweep and not panel.sweep.lost:
        dots(axes, clean.sweep, body_from_world, BEFORE, size)
    dots(axes, lost_points(panel, clean), body_from_world, LOST, 0.6 * size)
    mistaken = not np.array_equal(panel.sweep.world_from_lidar, clean.sweep.world_from_lidar)
    for fate, name in FATES.items():
        part = panel.sweep[panel.sweep.fate == fate]
        dots(axes, part, body_from_world, BELIEVED if mistaken else name, 2.0 * size if fate == SCATTERED else size)
    polygons = clean.frame.truth.bev_polygons()
    height = np.broadcast_to(clean.frame.truth.center[:, None, 2:3], (*polygons.shape[:2], 1))
    for outline in transform_points(body_from_world, np.concatenate([polygons, height], axis=-1)):
        axes.fill(-outline[:, 1], outline[:, 0], fill=False, edgecolor=INK, linewidth=0.6, alpha=0.8)
    axes.scatter([0.0], [0.0], marker="^", s=24, c=INK, linewidths=0)
    axes.set(xlim=(-radius_m, radius_m), ylim=(-radius_m, radius_m), aspect="equal")
    axes.tick_params(color=GRID, labelcolor=FAINT)
    axes.set_xlabel("to the right, m")
    axes.set_ylabel("ahead, m")


def dots(axes: Axes, sweep: Sweep, body_from_world: NDArray[np.float64], name: str, size: float) -> None:
    """Draw points at their reported places, in the colour of a name."""
    if len(sweep) == 0:
        return
    points = transform_points(body_from_world, sweep.world_points)
    markers = {"s": size, "c": COLOR[name], "alpha": 0.9, "linewidths": 0, "rasterized": True}
    axes.scatter(-points[:, 1], points[:, 0], label=name, **markers)


def sensor_image(axes: Axes, panel: Panel, clean: Panel) -> None:
    """Draw the fates of the nearest returns over ring and column, brighter when near."""
    sweep = panel.sweep
    spec = clean.sweep.spec
    if spec is None:
        raise ValueError("a simulated sweep knows its sensor")
    image = np.full((spec.rings, spec.columns, 3), to_rgb(EMPTY))
    table = np.array([to_rgb(COLOR[FATES[fate]]) for fate in sorted(FATES)])
    gone = lost_points(panel, clean)
    image[gone.ring, gone.column] = 0.6 * np.array(to_rgb(COLOR[LOST]))
    order = np.argsort(-sweep.range, kind="stable")
    shade = np.clip(1.15 - 0.35 * np.log10(np.maximum(sweep.range, 1.0)), 0.35, 1.0)
    image[sweep.ring[order], sweep.column[order]] = (table[sweep.fate] * shade[:, None])[order]
    axes.imshow(image, aspect="auto", interpolation="antialiased")
    if not spec.clockwise:
        axes.invert_xaxis()
    axes.set_ylabel(f"{panel.title}: ring", fontsize=8.5)
    axes.tick_params(color=GRID, labelcolor=FAINT)


def legend(figure: Figure) -> None:
    """Draw the legend of the colours in the picture below it."""
    drawn = {name for axes in figure.axes for name in axes.get_legend_handles_labels()[1]}
    marks = [
        Line2D([], [], marker="o", linestyle="", markersize=5, color=color, label=name)
        for name, color in COLOR.items()
        if name in drawn
    ]
    figure.legend(handles=marks, loc="outside lower left", ncols=len(marks))


if __name__ == "__main__":
    main()
