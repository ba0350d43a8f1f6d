"""Figures of frames: evidence in feature maps, the paper's Figure 6, and detections, its Figure 8."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from dsrc.evaluation.metrics.matching import match
from dsrc.models.inputs.labels import cells_in_boxes
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from dsrc.ops.iou import bev_iou
from dsrc.tables.figure import figure_style, panels
from sim.boxes import Boxes
from studies.dsrc_paper.drawing import (
    AGENT,
    FOUND,
    GRID_M,
    HELPED,
    POINT,
    TRUTH,
    camera_of,
    draw_agents,
    draw_boxes,
    draw_points,
    draw_scene,
    draw_truth,
    show_range,
)
from studies.dsrc_paper.evidence import EvidenceFunction
from studies.dsrc_paper.frames import DrawnFrame, only_helpers_see

HIT_IOU = 0.5
TOP = 0.99
"""Quantile of the cells in true boxes at which the colours of Figure 6 end: single cells elsewhere have far more."""


def feature_figure(chosen: Sequence[DrawnFrame], maps: Mapping[str, EvidenceFunction], grid: GridSpec) -> Figure:
    """Figure 6: the points of all agents and each network's evidence, a line each, a column for each frame.

    Args:
        chosen: the frames.
        maps: by the line's name, see `vehicle_evidence`; all have one scale.
        grid: the range that all of them see.
    """
    x0, y0, _, x1, y1, _ = grid.range_m
    values = [[seen(frame.sample) for frame in chosen] for seen in maps.values()]
    inside = [_cells(frame, grid, values[0][0].shape) for frame in chosen]
    pairs = (zip(of_network, inside, strict=True) for of_network in values)
    within = np.concatenate([seen[cells] for several in pairs for seen, cells in several])
    high = (float(np.quantile(within, TOP)) if len(within) else 0.0) or 1.0
    with figure_style():
        heights = [(y1 - y0) / (x1 - x0)] * (1 + len(maps))
        figure, axes = _columns(chosen, heights, "Evidence for a vehicle in feature maps")
        for column, frame in enumerate(chosen):
            points = axes[0, column]
            draw_points(points, frame.sample)
            points.set_title(frame.heading, fontsize=8.5)
            for line, of_network in enumerate(values):
                panel, seen = axes[1 + line, column], of_network[column]
                image = panel.imshow(seen, "YlOrBr", origin="lower", extent=(x0, x1, y0, y1), vmin=0.0, vmax=high)
                panel.set_title(_contrast(seen, inside[column]), fontsize=8, fontweight="normal")
            for panel in axes[:, column]:
                draw_truth(panel, frame.sample, 0.9, filled=panel is points)
                show_range(panel, grid)
                draw_agents(panel, frame.sample, grid)
        _name_lines(axes, ["LiDAR points of all agents", *maps])
        bar = figure.colorbar(image, ax=axes[1:].ravel().tolist(), extend="max", fraction=0.02, pad=0.01, aspect=40)
        bar.set_label(
            f"evidence for a vehicle, logits; up to the {100 * TOP:g}th percentile of the cells in true boxes"
        )
        axes[-1, len(chosen) // 2].set_xlabel("x ahead of the ego, y to its left, m", fontsize=8)
        figure.legend(handles=_handles(), loc="outside lower center", ncols=5)
    return figure


def _cells(frame: DrawnFrame, grid: GridSpec, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Cells of an (h, w) map in the true boxes of a frame; the input's cells are smaller."""
    inside = cells_in_boxes([frame.sample.boxes], grid)[0]
    height, width = shape
    found: NDArray[np.bool_] = inside.reshape(height, inside.shape[0] // height, width, -1).any(axis=(1, 3))
    return found


def _contrast(seen: NDArray[np.float32], inside: NDArray[np.bool_]) -> str:
    """Text of an (h, w) map's means in the cells of true boxes and elsewhere."""
    within = f"{seen[inside].mean():.2f}" if inside.any() else "-"
    return f"mean in true boxes {within}, elsewhere {seen[~inside].mean():.2f}"


def detection_figure(chosen: Sequence[DrawnFrame], found: Mapping[str, Sequence[Detections]], grid: GridSpec) -> Figure:
    """Figure 8: each method's detections and the truth in 3D and below it from above, a column for each frame.

    The others have points on the ego, so that some detectors find it. Its own body is not in the ground truth, and AP
    counts such a detection as false; here it has the ego's colour and is counted apart.

    Args:
        chosen: the frames.
        found: detections in each frame, by method.
        grid: range of all methods.
    """
    with figure_style():
        title = f"Detections; hits at IoU {HIT_IOU} in bird's-eye view"
        x0, y0, _, x1, y1, _ = grid.range_m
        _, (left, low, right, high) = camera_of(grid)
        heights = [(high - low) / (right - left), (y1 - y0) / (x1 - x0)] * len(found)
        figure, axes = _columns(chosen, heights, title)
        for row, of_method in enumerate(found.values()):
            for column, (frame, detections) in enumerate(zip(chosen, of_method, strict=True)):
                scene, above = axes[2 * row, column], axes[2 * row + 1, column]
                own = bev_iou(detections.boxes.array, frame.ego.array).max(axis=1, initial=0.0) >= HIT_IOU
                others, helped = detections[~own], only_helpers_see(frame.sample)
                drawn = (
                    (frame.sample.boxes[~helped], TRUTH, 1.0, True), (frame.sample.boxes[helped], HELPED, 1.0, True),
                    (others.boxes, FOUND, 1.1, False),
                    (frame.ego, AGENT, 1.0, True), (detections.boxes[own], AGENT, 1.1, False),
                )  # fmt: skip
                draw_scene(scene, frame.sample, drawn, grid)
                found_itself = ", and the ego itself" if own.any() else ""
                heading = f"{frame.heading}\n" if row == 0 else ""
                scene.set_title(f"{heading}{match_counts(others, frame.sample.boxes)}{found_itself}", fontsize=8.5)
                draw_points(above, frame.sample)
                for boxes, color, width, filled in drawn:
                    draw_boxes(above, boxes, color, width, filled=filled)
                show_range(above, grid)
                draw_agents(above, frame.sample, grid)
        _name_lines(axes, [label for name in found for label in (name, f"{name}, from above")])
        about = f"3D: from the right of the ego and above, lines on the ground every {GRID_M:g} m. "
        about += "From above: x ahead of the ego, y to its left, m"
        axes[-1, len(chosen) // 2].set_xlabel(about, fontsize=8)
        figure.legend(
            handles=[*_handles(), Line2D([], [], color=FOUND, label="detection")], loc="outside lower center", ncols=6
        )
    return figure


def _columns(chosen: Sequence[DrawnFrame], heights: Sequence[float], title: str) -> tuple[Figure, NDArray[Any]]:
    """Figure and its (rows, frames) panels; `heights` are those of the rows over a panel's width."""
    width = max(3.8, 8.0 / len(chosen))
    total = 1.4 + sum(0.18 + width * height for height in heights)
    figure, axes = panels(0.8 + width * len(chosen), total, len(heights), len(chosen), title)
    spec = axes[0].get_gridspec()
    if spec is not None:
        spec.set_height_ratios(heights)
    figure.set_layout_engine("compressed")  # panels of fixed proportions, without the room that these leave
    return figure, np.array(axes).reshape(len(heights), len(chosen))


def _name_lines(axes: NDArray[Any], names: Sequence[str]) -> None:
    """Label the lines at their left."""
    for panel, name in zip(axes[:, 0], names, strict=True):
        panel.set_ylabel(textwrap.fill(name, 16), fontsize=8, fontweight="bold")


def match_counts(detections: Detections, truth: Boxes) -> str:
    """Text of the counts of true boxes hit and missed and of false detections."""
    hits = int(match(bev_iou(detections.boxes.array, truth.array), detections.score, HIT_IOU).hit.sum())
    return f"{hits} hit, {len(truth) - hits} missed, {len(detections) - hits} false"


def _handles() -> list[Patch | Line2D]:
    """Legend of both figures."""
    agents = [
        Line2D([], [], color=AGENT, linestyle="", marker=marker, markerfacecolor=face, label=label)
        for marker, face, label in ((">", AGENT, "ego"), ("D", "white", "other agents"))
    ]
    return [
        Patch(edgecolor=TRUTH, facecolor=to_rgba(TRUTH, 0.3), label="true box with points from the ego"),
        Patch(edgecolor=HELPED, facecolor=to_rgba(HELPED, 0.3), label="true box that only helpers have points on"),
        *agents,
        Line2D([], [], color=POINT, linestyle="", marker=".", label="LiDAR points"),
    ]
