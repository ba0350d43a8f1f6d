"""Drawing of points, boxes and agents, from above and in 3D."""

from collections.abc import Callable, Iterable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from numpy.typing import NDArray

from dsrc.data.sample import Sample
from dsrc.ops.grid import GridSpec
from dsrc.tables.figure import COLORS
from sim.boxes import Boxes
from studies.dsrc_paper.frames import only_helpers_see

TRUTH, HELPED, FOUND, AGENT, POINT = COLORS[0], COLORS[2], COLORS[1], "#000000", "#7B848E"
"""Blue, green and orange, distinct with any colour vision; in grey the filling marks true boxes."""
_SHOWN_POINTS = 12_000
GRID_M = 20.0
_RING = np.array([(0, 1), (1, 2), (2, 3), (3, 0)])
_EDGES = np.concatenate([_RING, _RING + 4, [(corner, corner + 4) for corner in range(4)]])
"""Edges of a box: pairs of its corners, in the order of `Boxes.corners`."""


def project(points: NDArray[np.floating], eye: NDArray[np.float64], aim: NDArray[np.float64]) -> NDArray[np.float64]:
    """(P, 3) points in a camera: right and up in focal lengths, and the distance along its axis, m.

    Args:
        points: (P, 3) in the ego LiDAR's frame.
        eye: (3,) position of the camera.
        aim: (3,) point on its axis.
    """
    ahead = (aim - eye) / np.linalg.norm(aim - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    seen = (np.asarray(points, np.float64) - eye) @ np.stack([right, np.cross(right, ahead), ahead], axis=1)
    depth = np.maximum(seen[:, 2:], 1e-3)
    return np.concatenate([seen[:, :2] / depth, seen[:, 2:]], axis=1)


def camera_of(
    grid: GridSpec,
) -> tuple[Callable[[NDArray[np.floating]], NDArray[np.float64]], tuple[float, float, float, float]]:
    """Projection of (..., 3) points to (..., 2) right and up in 3D pictures, and the range's left, low, right, high.

    The camera is at the right of the ego and above, with the whole range in view.
    """
    x0, y0, z0, x1, y1, z1 = grid.range_m
    aim = np.array([(x0 + x1) / 2, (y0 + y1) / 2, z0])
    eye = aim + (x1 - x0) * np.array([0.0, -1.0, 1.1])

    def seen(points: NDArray[np.floating]) -> NDArray[np.float64]:
        return project(points.reshape(-1, 3), eye, aim)[:, :2].reshape(*points.shape[:-1], 2)

    ends = seen(np.array([(x, y, z) for x in (x0, x1) for y in (y0, y1) for z in (z0, z1)]))
    (left, low), (right, high) = ends.min(axis=0), ends.max(axis=0)
    return seen, (left, low, right, high)


def draw_scene(axes: Axes, sample: Sample, drawn: Iterable[tuple[Boxes, str, float, bool]], grid: GridSpec) -> None:
    """Draw points and boxes in 3D, see `camera_of`.

    Args:
        axes: to draw on.
        sample: whose points and agents.
        drawn: boxes, their colour, width of their edges and whether their floor is filled.
        grid: the range.
    """
    x0, y0, z0, x1, y1, _ = grid.range_m
    seen, (left, low, right, high) = camera_of(grid)
    ground = [((x, y0, z0), (x, y1, z0)) for x in _ticks(x0, x1)] + [((x0, y, z0), (x1, y, z0)) for y in _ticks(y0, y1)]
    axes.add_collection(LineCollection(list(seen(np.array(ground))), colors="#D5D9DE", linewidths=0.6, zorder=0))
    points = seen(_shown(sample))
    axes.scatter(points[:, 0], points[:, 1], s=0.5, color=POINT, linewidth=0, rasterized=True)
    for boxes, color, width, filled in drawn:
        corners = seen(boxes.corners())
        if filled:
            axes.add_collection(PolyCollection(list(corners[:, :4]), facecolors=to_rgba(color, 0.3), linewidths=0))
        edges = corners[:, _EDGES].reshape(-1, 2, 2)
        axes.add_collection(LineCollection(list(edges), colors=color, linewidths=width))
    draw_agents(axes, sample, grid, seen)
    axes.set(xlim=(left, right), ylim=(low, high), xticks=[], yticks=[], aspect="equal")
    axes.spines[:].set_visible(False)
    axes.grid(visible=False)


def _ticks(low: float, high: float) -> NDArray[np.float64]:
    """Multiples of the grid's width in a range, and its ends."""
    inside = np.arange(np.ceil(low / GRID_M), np.floor(high / GRID_M) + 1) * GRID_M
    return np.unique([low, *inside, high])


def draw_agents(
    axes: Axes,
    sample: Sample,
    grid: GridSpec,
    seen: Callable[[NDArray[np.float64]], NDArray[np.float64]] = lambda points: points[:, :2],
) -> None:
    """Mark the agents in the range through a projection of (P, 3) points: the ego as an arrow, others as diamonds."""
    places = sample.ego_from_agent[:, :3, 3]
    low, high = np.array(grid.range_m[:2]), np.array(grid.range_m[3:5])
    others = places[1:][((places[1:, :2] >= low) & (places[1:, :2] <= high)).all(axis=1)]
    for points, marker, size, face in ((others, "D", 4.5, "white"), (places[:1], ">", 6.0, AGENT)):
        axes.plot(
            *seen(points).T, marker=marker, markersize=size, markerfacecolor=face, color=AGENT,
            markeredgewidth=0.9, linestyle="", zorder=4,
        )  # fmt: skip


def _shown(sample: Sample) -> NDArray[np.float32]:
    """(P, 3) points of all agents, evenly thinned."""
    points = np.concatenate([cloud[:, :3] for cloud in sample.clouds])
    return points[:: max(1, len(points) // _SHOWN_POINTS)]


def draw_points(axes: Axes, sample: Sample) -> None:
    """Draw the points of all agents from above, evenly thinned."""
    points = _shown(sample)
    axes.scatter(points[:, 0], points[:, 1], s=0.7, color=POINT, linewidth=0, rasterized=True)


def draw_truth(axes: Axes, sample: Sample, width: float, *, filled: bool) -> None:
    """Draw the true boxes, those with points from helpers alone in their own colour."""
    helped = only_helpers_see(sample)
    for boxes, color in ((sample.boxes[~helped], TRUTH), (sample.boxes[helped], HELPED)):
        draw_boxes(axes, boxes, color, width, filled=filled)


def draw_boxes(axes: Axes, boxes: Boxes, color: str, width: float, *, filled: bool = False) -> None:
    """Draw outlines of boxes, with a line from the centre to the front."""
    corners = boxes.bev_polygons()
    if filled:
        axes.add_collection(PolyCollection(list(corners), facecolors=to_rgba(color, 0.3), linewidths=0))
    outlines = [*corners[:, [0, 1, 2, 3, 0]]]
    outlines += [*np.stack([boxes.center[:, :2], corners[:, :2].mean(axis=1)], axis=1)]
    axes.add_collection(LineCollection(outlines, colors=color, linewidths=width))


def show_range(axes: Axes, grid: GridSpec) -> None:
    """Show a panel from above in the range of a grid, m."""
    x0, y0, _, x1, y1, _ = grid.range_m
    axes.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")
    axes.grid(visible=False)
    axes.tick_params(labelsize=7)
