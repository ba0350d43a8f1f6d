"""Picture of an episode from above at its end: roads, road users, the ways of the ego and of whom it met."""

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from numpy.typing import NDArray

from dsrc.closed_loop.causes.cause import Cause
from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.types import Tick
from dsrc.tables.figure import COLORS, INK, figure_style, panels
from sim.encounters import encounter_of, network_file
from sim.roads.networks import names_network, read_network
from sim.scenario import Scenario

_HALF_M = 38.0
"""Half the width of the picture, m."""
_ROAD, _BUILT, _OTHER = "#E4E7EB", "#B9A68F", "#9AA3AD"
_EGO, _MET, _TRACK = COLORS[0], COLORS[1], COLORS[2]
_EVENTS = {"sight_s": "sight", "seen_s": "box", "tracked_s": "track", "chance_s": "last chance", "braked_s": "brake"}


def picture(log: EpisodeLog, cause: Cause | None = None) -> Figure:
    """Draw the last step of an episode from above, north up.

    Ego and whom it touched have their ways of the last seconds; dashed outlines are tracks. On the ego's way are the
    instants of a cause.

    Raises:
        ValueError: the episode has no step.
    """
    if not log.ticks:
        raise ValueError("expected an episode of at least one step, found none")
    last, settings = log.ticks[-1], log.settings
    middle = last.ego.box.center[0, :2]
    with figure_style():
        figure, (axes,) = panels(4.2, 4.2)
        low, high = middle - _HALF_M, middle + _HALF_M
        _draw_world(axes, settings.scenario, settings.seed, shapely.box(*low, *high))
        met = log.contact.other_id if log.contact is not None else -1
        for row, outline in enumerate(last.actors.boxes.bev_polygons()):
            object_id = int(last.actors.boxes.object_id[row])
            fill = _EGO if object_id == settings.ego_id else _MET if object_id == met else _OTHER
            axes.add_patch(Polygon(outline, facecolor=fill, edgecolor=INK, linewidth=0.5, zorder=3))
        for outline in last.tracks.boxes.bev_polygons():
            axes.add_patch(Polygon(outline, fill=False, edgecolor=_TRACK, linestyle="--", linewidth=1.0, zorder=4))
        for claimed in last.claims.values():
            for outline in claimed.boxes.bev_polygons():
                axes.add_patch(Polygon(outline, fill=False, edgecolor=_MET, linestyle=":", linewidth=1.0, zorder=4))
        for object_id, color in ((settings.ego_id, _EGO), (met, _MET)):
            axes.plot(*_way(log, object_id).T, color=color, linewidth=1.5, zorder=2)
        if cause is not None:
            _mark(axes, log, cause)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xticks=[], yticks=[], aspect="equal")
        axes.grid(visible=False)
        axes.spines[:].set_visible(False)
    return figure


def _draw_world(axes: Axes, scenario: Scenario, seed: int, window: shapely.Polygon) -> None:
    """Draw the lanes and the structures of an encounter that lie in a window."""
    if scenario.network.highway_env or not (scenario.conflict or names_network(scenario)):
        return
    for edge in read_network(network_file(scenario, seed)).getEdges():
        for lane in edge.getLanes():
            line = shapely.LineString([place[:2] for place in lane.getShape()])
            if line.intersects(window):
                ground = line.buffer(0.5 * lane.getWidth(), cap_style="flat").exterior
                axes.add_patch(Polygon(np.asarray(ground.coords), facecolor=_ROAD, linewidth=0, zorder=0))
    if scenario.conflict is not None:
        for structure in encounter_of(scenario, seed).layout.structures:
            outline = np.asarray(structure.outline.exterior.coords)
            axes.add_patch(Polygon(outline, facecolor=_BUILT, edgecolor=INK, linewidth=0.5, zorder=1))


def _way(log: EpisodeLog, object_id: int) -> NDArray[np.float64]:
    """Return the (K, 2) places of a road user, m."""
    here = [tick.actors for tick in log.ticks if object_id in tick.actors.boxes.object_id]
    return np.array([one.boxes.center[one.row(object_id), :2] for one in here]).reshape(-1, 2)


def _mark(axes: Axes, log: EpisodeLog, cause: Cause) -> None:
    """Name the instants of a cause on the ego's way; those of one step share a line."""
    named: dict[int, list[str]] = {}
    end_s = log.ticks[-1].actors.time_s
    for field, name in _EVENTS.items():
        if (before_s := getattr(cause, field)) is not None:
            steps = [abs(end_s - tick.actors.time_s - before_s) for tick in log.ticks]
            named.setdefault(int(np.argmin(steps)), []).append(name)
    for number, (step, names) in enumerate(sorted(named.items())):
        tick: Tick = log.ticks[step]
        place = tick.ego.box.center[0, :2]
        axes.plot(*place, "o", color=INK, markersize=3.5, zorder=5)
        axes.annotate(
            ", ".join(names), (place[0], place[1]), xytext=(14, 10 * number - 24), textcoords="offset points",
            fontsize=7, va="center", zorder=6, annotation_clip=True,
            arrowprops={"arrowstyle": "-", "color": _OTHER, "linewidth": 0.6},
        )  # fmt: skip
