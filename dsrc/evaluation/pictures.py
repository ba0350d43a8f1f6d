"""Pictures of one frame: feature maps as in the paper's Figure 6, detections as in its Figure 8."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from dsrc.data.batch import collate
from dsrc.data.drives import Drive, list_drives, open_drive
from dsrc.data.sample import GridSpec, Sample, make_sample
from dsrc.detections import Detections
from dsrc.evaluation.benchmark import Condition, corrupted
from dsrc.evaluation.paper_tables import PAPER_SEVERITY, View
from dsrc.evaluation.plan import Benchmark
from dsrc.evaluation.plots import COLORS, panels, png_bytes, styled
from dsrc.evaluation.report import Block, provenance_of, slug
from dsrc.evaluation.runner import Outcome, Trained, load_used
from dsrc.evaluation.tables import write_atomic
from dsrc.models.checkpoint import load_detector
from dsrc.models.detector import Detector
from sensors.corruptions import CLEAN, drive_seed
from sim.boxes import Boxes
from sim.errors import DataError, SettingsError, complaint, did_you_mean

TRUTH, FOUND, POINT = COLORS[2], COLORS[1], "#8A939E"
"""Green and red, as in the paper's figures, and told apart with any colour vision."""

_EYE_M, _AIM_M = np.array([-72.0, 0.0, 46.0]), np.array([0.0, 0.0, -4.0])
_SHOWN_POINTS = 25_000
_RING = np.array([(0, 1), (1, 2), (2, 3), (3, 0)])
_EDGES = np.concatenate([_RING, _RING + 4, [(corner, corner + 4) for corner in range(4)]])
"""Pairs of corners of a box, in the order of `Boxes.corners`."""


@dataclass(frozen=True, slots=True)
class Shot:
    """A frame that is drawn.

    Attributes:
        sample: as the ego and its collaborators see it.
        title: which frame it is.
    """

    sample: Sample
    title: str


def write_pictures(outcome: Outcome, out: Path) -> list[Block]:
    """Write Figures 6 and 8 of a benchmark into the folder of its first dataset; return their blocks.

    Figure 6 is of the first plain method with attention, of the teacher where one is named, and of the first DSRC.

    Raises:
        UserError: the frame that is asked for does not exist, or the teacher's file is wrong.
    """
    plan, made_by = outcome.plan, provenance_of(outcome)
    folder = slug(plan.datasets[0].name)
    view = View.of(outcome, plan.datasets[0].name)
    first = {name: several[0] for name, several in outcome.trained.items()}
    blocks = []
    baseline, student = view.plain("attention"), view.whole("attention")
    if baseline is None or student is None:
        lacking = "a plain method with attention (attfuse)" if baseline is None else "DSRC with attention (dsrc)"
        blocks.append(Block("figure_6", f"Figure 6 is left out: it needs {lacking}.\n"))
    else:
        detectors = {f"baseline: {baseline}": _load(first[baseline])}
        if plan.pictures.teacher:
            detectors["teacher"] = load_detector(Path(plan.pictures.teacher))
        detectors[f"student: {student}"] = _load(first[student])
        shot = take_shot(plan, view.settings[student].grid)
        write_atomic(out / folder / "figure_6.png", png_bytes(feature_figure(shot, detectors), made_by))
        blocks.append(Block("figure_6", picture="figure_6.png", about=f"Figure 6. Fused features, {shot.title}"))
    names = list(plan.pictures.methods or (first if len(first) <= 4 else [*list(first)[:3], list(first)[-1]]))
    grid = view.settings[names[-1]].grid
    shot = take_shot(plan, grid)
    found = {name: _load(first[name]).detect(shot.sample) for name in names}
    write_atomic(out / folder / "figure_8.png", png_bytes(detection_figure(shot, found, grid), made_by))
    blocks.append(Block("figure_8", picture="figure_8.png", about=f"Figure 8. Detections, {shot.title}"))
    return [block.below(folder) for block in blocks]


def check_pictures(plan: Benchmark) -> None:
    """Look, before the work, whether the pictures of a benchmark can be drawn after it.

    Raises:
        UserError: the frame that is asked for does not exist, or the teacher's file is missing, damaged or a student's.
    """
    if plan.pictures.drive or plan.pictures.frame is not None:
        _place(plan)
    if plan.pictures.teacher:
        role = load_detector(Path(plan.pictures.teacher)).settings.role
        if role != "teacher":
            raise SettingsError(complaint(plan.pictures.teacher, "settings.role", "teacher", role))


def _load(one: Trained) -> Detector:
    return load_used(one.path, one.use)


def take_shot(plan: Benchmark, grid: GridSpec) -> Shot:
    """Return the frame that a benchmark's pictures are of.

    Raises:
        SettingsError: there is no such drive in the first dataset, or no such frame in it.
    """
    wanted = plan.pictures
    reader, position = _place(plan)
    condition = Condition(wanted.corruption, 0 if wanted.corruption == CLEAN else PAPER_SEVERITY, plan.family)
    name = reader.drive.name
    frame = corrupted(reader.read(position), condition, drive_seed(plan.seed, name))
    return Shot(make_sample(frame, None, grid), f"{name}, frame {reader.frames[position]}, {wanted.corruption}")


def _place(plan: Benchmark) -> tuple[Drive, int]:
    """Return the drive and the position of the frame in it."""
    readers = [open_drive(d) for folder in plan.datasets[0].drives for d in list_drives(Path(folder))]
    reader = _drive(readers, plan.pictures.drive)
    position = len(reader) // 2 if plan.pictures.frame is None else plan.pictures.frame
    if position >= len(reader):
        raise SettingsError(complaint("pictures", "frame", f"less than {len(reader)}", position))
    return reader, position


def _drive(readers: list[Drive], name: str) -> Drive:
    names = [reader.drive.name for reader in readers]
    if not readers:
        raise DataError(complaint("pictures", "drive", "a drive", "none"))
    if name and name not in names:
        raise SettingsError(complaint("pictures", "drive", "one of the dataset", name, did_you_mean(name, names)))
    return readers[names.index(name)] if name else readers[0]


@torch.inference_mode()
def feature_map(detector: Detector, sample: Sample) -> NDArray[np.float32]:
    """Return (h, w) the mean size of the fused feature over its channels; a teacher reads its own clouds."""
    batch = collate([sample], detector.settings, training=False)
    pillars = batch.teacher if detector.settings.role == "teacher" else batch.student
    if pillars is None:
        raise ValueError("a batch has the clouds that its network reads")
    device = detector.cls_head.weight.device
    return detector(pillars.to(device), batch.company.to(device)).fused[0].abs().mean(0).float().cpu().numpy()


def feature_figure(shot: Shot, detectors: Mapping[str, Detector]) -> Figure:
    """Draw the points of all agents and the fused feature of each detector, true boxes in red, as Figure 6."""
    grid = next(iter(detectors.values())).settings.grid
    x0, y0, _, x1, y1, _ = grid.range_m
    rows = 1 + len(detectors)
    with styled():
        figure, axes = panels(8.0, 0.6 + rows * (0.5 + 7.4 * (y1 - y0) / (x1 - x0)), rows=rows)
        _points_above(axes[0], shot.sample)
        axes[0].set_title("point clouds of all agents")
        for panel, (name, detector) in zip(axes[1:], detectors.items(), strict=True):
            values = feature_map(detector, shot.sample)
            high = float(np.quantile(values, 0.998))
            panel.imshow(values, origin="lower", extent=(x0, x1, y0, y1), cmap="viridis", vmin=0.0, vmax=high or 1.0)
            panel.set_title(name)
        for panel in axes:
            _boxes_above(panel, shot.sample.boxes, "#E8483F", 1.1)
            _frame_above(panel, grid)
        figure.suptitle(f"Fused features: {shot.title}", x=0.012, ha="left", fontsize=11, fontweight="bold")
    return figure


def detection_figure(shot: Shot, found: Mapping[str, Detections], grid: GridSpec) -> Figure:
    """Draw each method's detections and the truth in 3D (top) and from above (bottom), as Figure 8."""
    with styled():
        # As high as a scene of 0.4 times its width and the grid below it are.
        x0, y0, _, x1, y1, _ = grid.range_m
        figure, axes = panels(4.2 * len(found), 1.4 + 4.2 * (0.4 + (y1 - y0) / (x1 - x0)), rows=2, columns=len(found))
        for column, (name, detections) in enumerate(found.items()):
            high, flat = axes[column], axes[len(found) + column]
            _scene(high, shot.sample, detections)
            high.set_title(name)
            _points_above(flat, shot.sample)
            _boxes_above(flat, shot.sample.boxes, TRUTH, 1.4)
            _boxes_above(flat, detections.boxes, FOUND, 1.0)
            _frame_above(flat, grid)
        figure.suptitle(f"Detections: {shot.title}", x=0.012, ha="left", fontsize=11, fontweight="bold")
        handles = [Line2D([], [], color=color, label=label) for color, label in ((TRUTH, "truth"), (FOUND, "detected"))]
        figure.legend(handles=handles, loc="outside lower center", ncols=2, fontsize=9)
    return figure


def project(points: NDArray[np.floating], eye: NDArray[np.float64], aim: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (P, 3) what a camera sees of points: right and up in focal lengths, and the distance along its axis, m.

    Args:
        points: (P, 3) in the ego LiDAR's frame.
        eye: (3,) the camera's place.
        aim: (3,) what it looks at.
    """
    ahead = (aim - eye) / np.linalg.norm(aim - eye)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    seen = (np.asarray(points, np.float64) - eye) @ np.stack([right, np.cross(right, ahead), ahead], axis=1)
    depth = np.maximum(seen[:, 2:], 1e-3)
    return np.concatenate([seen[:, :2] / depth, seen[:, 2:]], axis=1)


def _scene(axes: Axes, sample: Sample, detections: Detections) -> None:
    """Draw points and boxes as seen from behind and above the ego."""
    points = project(_shown(sample), _EYE_M, _AIM_M)
    points = points[points[:, 2] > 1.0]
    axes.scatter(points[:, 0], points[:, 1], s=0.3, color=POINT, linewidth=0, rasterized=True)
    for boxes, color, width in ((sample.boxes, TRUTH, 1.4), (detections.boxes, FOUND, 1.0)):
        corners = project(boxes.corners().reshape(-1, 3), _EYE_M, _AIM_M).reshape(-1, 8, 3)
        corners = corners[(corners[:, :, 2] > 1.0).all(axis=1)]
        edges = corners[:, _EDGES, :2].reshape(-1, 2, 2)
        axes.add_collection(LineCollection(list(edges), colors=color, linewidths=width))
    axes.set(xlim=(-0.62, 0.62), ylim=(-0.3, 0.2), xticks=[], yticks=[], aspect="equal")
    axes.grid(visible=False)


def _shown(sample: Sample) -> NDArray[np.float32]:
    """Return (P, 3) points of all agents, evenly thinned."""
    points = np.concatenate([cloud[:, :3] for cloud in sample.clouds])
    return points[:: max(1, len(points) // _SHOWN_POINTS)]


def _points_above(axes: Axes, sample: Sample) -> None:
    points = _shown(sample)
    axes.scatter(points[:, 0], points[:, 1], s=0.3, color=POINT, linewidth=0, rasterized=True)


def _boxes_above(axes: Axes, boxes: Boxes, color: str, width: float) -> None:
    """Draw outlines, and a line from the centre to the front."""
    corners = boxes.corners()[:, :4, :2]
    outlines = [*corners[:, [0, 1, 2, 3, 0]]]
    outlines += [*np.stack([boxes.center[:, :2], corners[:, :2].mean(axis=1)], axis=1)]
    axes.add_collection(LineCollection(outlines, colors=color, linewidths=width))


def _frame_above(axes: Axes, grid: GridSpec) -> None:
    x0, y0, _, x1, y1, _ = grid.range_m
    axes.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")
    axes.grid(visible=False)
    axes.tick_params(labelsize=7)
