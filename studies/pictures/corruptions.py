"""Pictures of every corruption: one sweep of a busy street, clean and under each family, coloured by fate.

The sweep is that of a 64-beam LiDAR on the vehicle that has most lorries, buses and people around it while it drives.

Usage:
    python -m studies.pictures.corruptions --out docs/pictures/corruptions
    python -m studies.pictures.corruptions --out pictures --only fog snow --severity 5 --scenario ingolstadt
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from dsrc.review.palette import FATE_COLORS, FATE_NAMES, LOST
from sensors.corruptions import CORRUPTIONS, DEFAULT_SEVERITY, FAMILIES, SEVERITIES, corrupt_frame, kinds_of
from sensors.frame import Frame
from sensors.presets import get_lidar
from sensors.recording.record import record
from sensors.recording.rig import Rig
from sensors.sweep import ADDED, MOVED, SCATTERED, Sweep
from sim.boxes import CLASSES
from sim.catalog.load import load_scenario
from sim.geometry import invert, transform_points
from sim.traffic.base import Actors
from sim.traffic.sumo.traffic import SumoTraffic
from sim.world.build import build_world
from studies.look import EMPTY, FAINT, GRID, INK, PAGE, new_figure, save, style

WAS = len(FATE_COLORS)
"""Row in `COLORS` of where a point was that is lost or moved."""
COLORS = np.array([*(FATE_COLORS[fate] for fate in range(WAS)), LOST]) / 255.0
NAMES = (*(FATE_NAMES[fate] for fate in range(WAS)), "was here: now lost or moved")
SHORT = ("untouched", "dimmer", "moved", "added")

LIDAR, STREET, MOTORWAY = "os1-64", "research_junction", "highway"
SEED = 2
AFTER_S, INTERVAL_S = 16.0, 0.1
AROUND_M, MOVING_MPS = 35.0, 7.0
BUSY = ("truck", "bus", "motorcycle", "bicycle", "pedestrian")

SMALL = ("motion_blur", "pose_error", "clock_offset", "point_dropping", "noise")
"""Kinds that are drawn from near: single points are seen."""


@dataclass(frozen=True, slots=True)
class View:
    """Perspective, in the frame of the vehicle.

    Attributes:
        eye: where it is seen from, m.
        target: in the middle of the picture, m.
        half: tangents of half the angles across and up.
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    half: tuple[float, float]


WIDE = View((-24.0, -10.0, 15.0), (5.0, 0.0, 0.0), (0.72, 0.44))
NEAR = View((-5.0, -3.0, 4.5), (2.5, 5.0, 1.0), (0.36, 0.22))
DOT = 0.36
"""Size of a point 10 m away in a picture of one inch, in points of the page."""

EDGES = ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))
"""Edges of a box by its corners."""


@dataclass(frozen=True, slots=True)
class Panel:
    """Part of a picture: title and frame, of which the drawn agent's sweep is shown."""

    title: str
    frame: Frame
    drawn: int

    @property
    def sweep(self) -> Sweep:
        """Drawn sweep."""
        return next(agent.sweep for agent in self.frame.agents if agent.agent_id == self.drawn)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--out", type=Path, required=True, help="folder of the pictures: one per kind, and, of all kinds, all.png"
    )
    parser.add_argument("--only", nargs="+", choices=CORRUPTIONS, default=list(CORRUPTIONS), help="default: all")
    parser.add_argument("--severity", type=int, choices=SEVERITIES, default=DEFAULT_SEVERITY)
    parser.add_argument("--scenario", help=f"default: {STREET}, and {MOTORWAY} for spray, which needs speed")
    options = parser.parse_args()
    places = {kind: options.scenario or (MOTORWAY if kind == "spray" else STREET) for kind in options.only}
    swept = {place: street(place) for place in sorted(set(places.values()))}
    clean = {kind: swept[place] for kind, place in places.items()}
    figures: dict[str, Callable[[], Figure]] = {
        kind: partial(draw, panel, kind, options.severity) for kind, panel in clean.items()
    }
    if options.only == list(CORRUPTIONS):  # the sheet of all is not of some
        figures["all"] = partial(overview, clean, options.severity)
    for name, figure in figures.items():
        path = options.out / f"{name}.png"
        with style():
            save(figure(), path, colors=64, keep=(*map(to_hex, COLORS), PAGE, EMPTY, INK))
        print(f"{path}  {path.stat().st_size / 1024:.0f} kB")


def street(name: str) -> Panel:
    """Return a frame some seconds after the start of a drive, by sensors without random drop-off.

    Its agents are the busiest vehicle, which is drawn, and the vehicle nearest to it, an ego for errors relative to it.
    """
    scenario = load_scenario(name)
    steps = round(AFTER_S / INTERVAL_S)
    with SumoTraffic(scenario, SEED) as traffic:
        drive = record(traffic, build_world(scenario, SEED), scenario, SEED, steps + 1, INTERVAL_S)
    spec = msgspec.structs.replace(get_lidar(LIDAR), dropoff_rate=0.0, dropoff_zero_intensity=0.0)
    rig = Rig(scenario, drive.rig.scene, SEED, vehicle_spec=spec)
    drawn, beside = busiest(drive.steps[drive.frame_steps[steps]])
    frame = replace(drive, rig=rig, vehicles=(beside, drawn)).frame(steps)
    rows = [k for k, agent in enumerate(frame.agents) if agent.agent_id in (beside, drawn)]
    return Panel("clean", frame.of_agents(rows), drawn)


def busiest(actors: Actors) -> tuple[int, int]:
    """Return the ids of the moving car or van with most lorries, buses and people around, and of the car nearest it."""
    label, place = actors.boxes.label, actors.boxes.center[:, :2]
    cars = np.flatnonzero(np.isin(label, [CLASSES.index(name) for name in ("car", "van")]))
    busy = place[np.isin(label, [CLASSES.index(name) for name in BUSY])]
    around = (np.linalg.norm(place[cars, None] - busy, axis=2) < AROUND_M).sum(axis=1)
    moving = np.linalg.norm(actors.velocity[cars], axis=1) > MOVING_MPS
    drawn = cars[np.lexsort((around, moving))[-1]]
    others = cars[cars != drawn]
    beside = others[np.linalg.norm(place[others] - place[drawn], axis=1).argmin()]
    return int(actors.boxes.object_id[drawn]), int(actors.boxes.object_id[beside])


def corrupted(clean: Panel, kind: str, severity: int, family: str, title: str) -> Panel:
    """Return the panel of a corruption; the drawn agent is not the ego."""
    ego = next(agent.agent_id for agent in clean.frame.agents if agent.agent_id != clean.drawn)
    return Panel(title, corrupt_frame(clean.frame, kind, severity, SEED, family, ego_id=ego), clean.drawn)


def draw(clean: Panel, kind: str, severity: int) -> Figure:
    """Return the picture of one kind: perspective and sensor image, clean and under each family."""
    families = [family for family in FAMILIES if kind in kinds_of(family)]
    panels = [clean, *(corrupted(clean, kind, severity, family, family) for family in families)]
    # Sensor images say nothing of points that all moved.
    changed = [panel for panel in panels[1:] if (fates(panel, clean) != MOVED).any()]
    images = [clean, *changed] if changed else []
    title = f"{kind.replace('_', ' ')}, severity {severity}"
    figure = new_figure(4.4 * len(panels) + 0.2, 4.0 + 1.25 * len(images), title, note(clean))
    room_below_note(figure)
    grid = figure.add_gridspec(1 + len(images), len(panels), height_ratios=[2.8, *[1.1] * len(images)])
    for column, panel in enumerate(panels):
        axes = figure.add_subplot(grid[0, column])
        perspective(axes, panel, clean, kind in SMALL)
        axes.set_title(f"{panel.title}\n{counts(panel, clean)}", fontsize=8.5)
    for line, panel in enumerate(images, start=1):
        sensor_image(figure.add_subplot(grid[line, :]), panel, clean)
    legend(figure)
    return figure


def overview(clean: dict[str, Panel], severity: int) -> Figure:
    """Return the picture of all kinds, under their physical models, after the clean sweep of the first."""
    panels = {kind: corrupted(panel, kind, severity, "physical", kind) for kind, panel in clean.items()}
    pairs = [(panel, clean[kind]) for kind, panel in panels.items()]
    first = pairs[0][1]
    columns = 4
    rows = -(-(1 + len(pairs)) // columns)
    figure = new_figure(3.2 * columns, 2.25 * rows + 0.9, f"All corruptions, severity {severity}", note(first))
    room_below_note(figure)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for place, (panel, before) in zip(axes, [(first, first), *pairs], strict=False):
        perspective(place, panel, before, panel.title in SMALL)
        place.set_title(panel.title.replace("_", " "))
    for place in axes[1 + len(pairs) :]:
        place.set_axis_off()
    legend(figure)
    return figure


def room_below_note(figure: Figure) -> None:
    """Reserve room below the figure's note for panel titles of two lines."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.set(rect=(0.0, 0.0, 1.0, 1.0 - 0.12 / figure.get_figheight()))


def note(clean: Panel) -> str:
    """Return the line below the title."""
    agent = next(agent for agent in clean.frame.agents if agent.agent_id == clean.drawn)
    return f"one sweep of the LiDAR {LIDAR} on a vehicle at {3.6 * agent.speed:.0f} km/h"


def counts(panel: Panel, clean: Panel) -> str:
    """Return the number of points per fate, as text."""
    found = np.bincount(fates(panel, clean), minlength=WAS)
    said = [f"{count:,} {name}" for count, name in zip(found, SHORT, strict=True) if count]
    return ", ".join(said + [f"{panel.sweep.lost:,} lost"] * (panel.sweep.lost > 0))


def fates(panel: Panel, clean: Panel) -> NDArray[np.uint8]:
    """Return (P,) the fates of the drawn points; those of a wrong pose have moved."""
    sweep = panel.sweep
    mistaken = not np.array_equal(sweep.world_from_lidar, clean.sweep.world_from_lidar)
    return np.full(len(sweep), MOVED, np.uint8) if mistaken else sweep.fate


def lost_points(panel: Panel, clean: Panel) -> Sweep:
    """Return the lost points of the clean sweep."""
    left = panel.sweep[panel.sweep.object_id != ADDED]
    return clean.sweep[~np.isin(beam_of(clean.sweep), beam_of(left))]


def beam_of(sweep: Sweep) -> NDArray[np.int64]:
    """Return (P,) keys of ring, column and return number."""
    return (sweep.ring.astype(np.int64) << 32) + (sweep.column.astype(np.int64) << 3) + sweep.return_number


def perspective(axes: Axes, panel: Panel, clean: Panel, near: bool) -> None:
    """Draw a sweep and the true boxes as seen from behind the vehicle; points that moved over where they were."""
    agent = next(agent for agent in clean.frame.agents if agent.agent_id == clean.drawn)
    body_from_world = invert(agent.world_from_body)
    sweep, view, fate = panel.sweep, NEAR if near else WIDE, fates(panel, clean)
    was = clean.sweep if (fate == MOVED).any() else lost_points(panel, clean)
    size = DOT * axes.get_position().width * axes.figure.get_figwidth()
    for points, color in ((was.world_points, np.full(len(was), WAS)), (sweep.world_points, fate)):
        place, depth = project(transform_points(body_from_world, points), view)
        order = np.argsort(-depth, kind="stable")
        order = order[depth[order] > 1.0]
        # Single points far away are still seen, above all those that no surface has reflected.
        least = np.where(color == SCATTERED, 1.0, 0.45)
        sizes = (size * np.maximum(10.0 / depth[order], least[order])) ** 2
        axes.scatter(*place[order].T, s=sizes, c=COLORS[color[order]], linewidths=0, rasterized=True)
    corners = transform_points(body_from_world, clean.frame.truth.corners().reshape(-1, 3))
    place, depth = (part.reshape(-1, 8, *part.shape[1:]) for part in project(corners, view))
    lines = place[depth.min(axis=1) > 1.0][:, EDGES].reshape(-1, 2, 2)
    axes.add_collection(LineCollection(list(lines), colors=INK, linewidths=0.45, alpha=0.75))
    axes.set_facecolor(EMPTY)
    (wide, high) = view.half
    axes.set(xlim=(-wide, wide), ylim=(-high, high), aspect="equal", xticks=[], yticks=[])


def project(points: NDArray[np.float64], view: View) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (N, 2) places on the picture plane, tangents, and (N,) depths, m, of points seen from an eye."""
    eye, target = np.array(view.eye), np.array(view.target)
    ahead = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    depth = (points - eye) @ ahead
    across = (points - eye) @ np.stack([right, np.cross(right, ahead)], axis=1)
    return across / np.maximum(depth, 1e-3)[:, None], depth


def sensor_image(axes: Axes, panel: Panel, clean: Panel) -> None:
    """Draw the fates of the nearest returns over ring and column, brighter when near."""
    sweep, spec = panel.sweep, get_lidar(LIDAR)
    image = np.full((spec.rings, spec.columns, 3), to_rgb(EMPTY))
    gone = lost_points(panel, clean)
    image[gone.ring, gone.column] = 0.75 * COLORS[WAS]
    order = np.argsort(-sweep.range, kind="stable")
    shade = np.clip(1.2 - 0.35 * np.log10(np.maximum(sweep.range, 1.0)), 0.5, 1.0)
    shade[sweep.fate == SCATTERED] = 1.0
    image[sweep.ring[order], sweep.column[order]] = (COLORS[sweep.fate] * shade[:, None])[order]
    axes.imshow(image, aspect="auto", interpolation="nearest")
    if not spec.clockwise:
        axes.invert_xaxis()
    axes.set_ylabel(f"{panel.title}: ring", fontsize=8.5)
    axes.tick_params(color=GRID, labelcolor=FAINT)


def legend(figure: Figure) -> None:
    """Draw the legend of the colours below the picture."""
    marks = [
        Line2D([], [], marker="o", linestyle="", markersize=5, color=color, label=name)
        for color, name in zip(COLORS, NAMES, strict=True)
    ]
    figure.legend(handles=marks, loc="outside lower left", ncols=len(marks))


if __name__ == "__main__":
    main()
