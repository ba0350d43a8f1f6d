"""Pictures of one frame: feature maps as in the paper's Figure 6, detections as in its Figure 8."""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import PowerNorm, to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from dsrc.data.drives import Drive, list_drives, open_drive
from dsrc.data.sample import Sample, make_sample
from dsrc.evaluation.benchmark import Condition, corrupted, places_of
from dsrc.evaluation.config import Benchmark
from dsrc.evaluation.matching import match
from dsrc.evaluation.plots.plots import COLORS, panels, png_bytes, styled
from dsrc.evaluation.report.files import write_atomic
from dsrc.evaluation.report.paper_tables import PAPER_SEVERITY, View
from dsrc.evaluation.report.report import Block, provenance_of, slug
from dsrc.evaluation.runner import Outcome, Trained, load_used
from dsrc.models.detector import Detector
from dsrc.models.inputs.batch import collate
from dsrc.models.storage.checkpoint import load_detector
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from dsrc.ops.iou import bev_iou
from sensors.corruptions import CLEAN, drive_seed
from sim.boxes import Boxes
from sim.errors import SettingsError, complaint
from sim.geometry import invert

TRUTH, FOUND, AGENT, POINT = COLORS[0], COLORS[1], "#000000", "#7B848E"
"""Blue and orange: told apart with any colour vision. In grey it is the filling that tells true boxes."""
HIT_IOU = 0.5

_SHOWN_POINTS = 25_000
_GRID_M = 20.0
_RING = np.array([(0, 1), (1, 2), (2, 3), (3, 0)])
_EDGES = np.concatenate([_RING, _RING + 4, [(corner, corner + 4) for corner in range(4)]])
"""Pairs of corners of a box, in the order of `Boxes.corners`."""


@dataclass(frozen=True, slots=True)
class Shot:
    """A frame that is drawn.

    Attributes:
        sample: as the ego and its collaborators see it.
        title: which frame it is.
        percentile: that it stands at, see `frames_at`.
        ego: the ego's own body, which is no object to be found, in its LiDAR's frame; none where it is not known.
    """

    sample: Sample
    title: str
    percentile: int
    ego: Boxes = field(default_factory=Boxes.zeros)


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
        shot = take_shots(plan, view.settings[student].grid)[0]
        write_atomic(out / folder / "figure_6.png", png_bytes(feature_figure(shot, detectors), made_by))
        blocks.append(Block("figure_6", picture="figure_6.png", about=f"Figure 6. Fused features, {shot.title}"))
    names = list(plan.pictures.methods or (first if len(first) <= 4 else [*list(first)[:3], list(first)[-1]]))
    grid = view.settings[names[-1]].grid
    shot = take_shots(plan, grid)[0]
    found = {name: _load(first[name]).detect(shot.sample) for name in names}
    write_atomic(out / folder / "figure_8.png", png_bytes(detection_figure(shot, found, grid), made_by))
    blocks.append(Block("figure_8", picture="figure_8.png", about=f"Figure 8. Detections, {shot.title}"))
    return [block.below(folder) for block in blocks]


def check_pictures(plan: Benchmark) -> None:
    """Look, before the work, whether the pictures of a benchmark can be drawn after it.

    Raises:
        UserError: the frame that is asked for does not exist, or the teacher's file is missing, damaged or a student's.
    """
    if plan.pictures.teacher:
        role = load_detector(Path(plan.pictures.teacher)).settings.role
        if role != "teacher":
            raise SettingsError(complaint(plan.pictures.teacher, "settings.role", "teacher", role))


def _load(one: Trained) -> Detector:
    return load_used(one.path, one.use)


def only_helpers_see(sample: Sample) -> NDArray[np.bool_]:
    """(N,) whether a true box has a point from a helper and none from the ego, in the sweeps as they were recorded."""
    return ~np.isin(sample.boxes.object_id, sample.agent_boxes[0].object_id)


def frames_at(plan: Benchmark, grid: GridSpec) -> list[tuple[int, Drive, int]]:
    """Percentile, drive and position of the frames that are drawn: nobody chooses them.

    The evaluated frames of the first dataset are sorted by the number of true boxes in the grid's range that only
    helpers have points on, frames of the same number by the names of their drives and their own numbers. The frame at
    percentile p of n is number ceil(p / 100 * n) of them, at least the first: nearest rank, definition 1 of Hyndman and
    Fan, Sample Quantiles in Statistical Packages, 1996.

    Raises:
        DataError: the dataset has no frame.
    """
    readers = [open_drive(drive) for folder in plan.datasets[0].drives for drive in list_drives(Path(folder))]
    places = places_of(readers, plan.limit)
    ranked = []
    for row, (reader, positions) in enumerate(zip(readers, places, strict=True)):
        for position in positions:
            seen = make_sample(reader.read(position), None, grid, cooperative=False)
            count, number = int(only_helpers_see(seen).sum()), reader.frames[position]
            ranked.append((count, reader.drive.name, number, row, position))
    ranked.sort()
    chosen = []
    for percentile in plan.pictures.percentiles:
        *_, row, position = ranked[max(1, math.ceil(percentile * len(ranked) / 100)) - 1]
        chosen.append((percentile, readers[row], position))
    return chosen


def take_shots(plan: Benchmark, grid: GridSpec) -> list[Shot]:
    """Frames that a benchmark's pictures are of, see `frames_at`, as the ego and its helpers see them.

    Raises:
        DataError: the dataset has no frame.
    """
    kind = plan.pictures.corruption
    condition = Condition(kind, 0 if kind == CLEAN else PAPER_SEVERITY, plan.family)
    shots = []
    for percentile, reader, position in frames_at(plan, grid):
        name = reader.drive.name
        frame = corrupted(reader.read(position), condition, drive_seed(plan.seed, name))
        sample = make_sample(frame, None, grid)
        pose = frame.agent(sample.agent_ids[0]).sweep.world_from_lidar
        ego = frame.truth[frame.truth.object_id == sample.agent_ids[0]].transform(invert(pose))
        shots.append(Shot(sample, f"{name}, frame {reader.frames[position]}, {kind}", percentile, ego))
    return shots


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
    """Draw the points of all agents and the fused feature of each detector, with the true boxes, as Figure 6."""
    grid = next(iter(detectors.values())).settings.grid
    x0, y0, _, x1, y1, _ = grid.range_m
    rows = (2 + len(detectors)) // 2
    with styled():
        size = 9.0, 0.8 + rows * (0.6 + 3.4 * (y1 - y0) / (x1 - x0))
        figure, axes = panels(*size, rows, 2, f"Fused features: {shot.title}")
        for panel in axes[1 + len(detectors) :]:
            panel.set_axis_off()
        axes = axes[: 1 + len(detectors)]
        _points_above(axes[0], shot.sample)
        axes[0].set_title("LiDAR points of all agents")
        for panel, (name, detector) in zip(axes[1:], detectors.items(), strict=True):
            values = feature_map(detector, shot.sample)
            high = float(np.quantile(values, 0.998))
            scale = PowerNorm(0.5, 0.0, high or 1.0)  # a few cells are so strong that all others would look alike
            image = panel.imshow(values, origin="lower", extent=(x0, x1, y0, y1), cmap="YlOrBr", norm=scale)
            bar = figure.colorbar(image, ax=panel, extend="max", fraction=0.03, pad=0.02)
            bar.set_label("mean |feature|")
            panel.set_title(name)
        for panel in axes:
            _boxes_above(panel, shot.sample.boxes, TRUTH, 0.9, filled=panel is axes[0])
            _frame_above(panel, grid)
            _agents(panel, shot.sample, grid)
        figure.legend(handles=_handles()[:1] + _handles()[2:], loc="outside lower center", ncols=4)
    return figure


def detection_figure(shot: Shot, found: Mapping[str, Detections], grid: GridSpec) -> Figure:
    """Draw each method's detections and the truth in 3D (left) and from above (right), a line each, as Figure 8.

    The others have points on the ego, so that some detectors find it. Its own body is no object of the truth and AP
    takes such a detection for a false one; here it has the ego's colour and is counted apart.
    """
    with styled():
        x0, y0, _, x1, y1, _ = grid.range_m
        size = 9.0, 0.9 + len(found) * (0.55 + 4.1 * (y1 - y0) / (x1 - x0))
        title = f"Detections: {shot.title}; hits at IoU {HIT_IOU} in bird's-eye view"
        figure, axes = panels(*size, len(found), 2, title)
        for line, (name, detections) in enumerate(found.items()):
            scene, above = axes[2 * line : 2 * line + 2]
            own = bev_iou(detections.boxes.array, shot.ego.array).max(axis=1, initial=0.0) >= HIT_IOU
            others = detections[~own]
            drawn = (
                (shot.sample.boxes, TRUTH, 1.0, True), (others.boxes, FOUND, 1.1, False),
                (shot.ego, AGENT, 1.0, True), (detections.boxes[own], AGENT, 1.1, False),
            )  # fmt: skip
            _scene(scene, shot.sample, drawn, grid)
            found_itself = ", and the ego itself" if own.any() else ""
            scene.set_title(f"{name}: {counted(others, shot.sample.boxes)}{found_itself}")
            _points_above(above, shot.sample)
            for boxes, color, width, filled in drawn:
                _boxes_above(above, boxes, color, width, filled=filled)
            _frame_above(above, grid)
            _agents(above, shot.sample, grid)
        figure.legend(handles=_handles(), loc="outside lower center", ncols=5)
    return figure


def counted(detections: Detections, truth: Boxes) -> str:
    """Return how many true boxes were hit and missed, and how many detections hit none."""
    hits = int(match(bev_iou(detections.boxes.array, truth.array), detections.score, HIT_IOU).hit.sum())
    return f"{hits} hit, {len(truth) - hits} missed, {len(detections) - hits} false"


def _handles() -> list[Patch | Line2D]:
    """Return what the colours and signs of the pictures mean."""
    agents = [
        Line2D([], [], color=AGENT, linestyle="", marker=marker, markerfacecolor=face, label=label)
        for marker, face, label in ((">", AGENT, "ego"), ("D", "white", "other agents"))
    ]
    return [
        Patch(edgecolor=TRUTH, facecolor=to_rgba(TRUTH, 0.3), label="true box"),
        Line2D([], [], color=FOUND, label="detection"),
        *agents,
        Line2D([], [], color=POINT, linestyle="", marker=".", label="LiDAR points"),
    ]


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


def _scene(axes: Axes, sample: Sample, drawn: Iterable[tuple[Boxes, str, float, bool]], grid: GridSpec) -> None:
    """Draw points and boxes as seen from the right of the ego and above, the whole range in sight.

    Args:
        axes: to draw on.
        sample: whose points and agents.
        drawn: boxes, their colour, width of their edges and whether their floor is filled.
        grid: the range.
    """
    x0, y0, z0, x1, y1, z1 = grid.range_m
    aim = np.array([(x0 + x1) / 2, (y0 + y1) / 2, z0])
    eye = aim + (x1 - x0) * np.array([0.0, -1.0, 1.1])

    def seen(points: NDArray[np.floating]) -> NDArray[np.float64]:
        return project(points.reshape(-1, 3), eye, aim)[:, :2].reshape(*points.shape[:-1], 2)

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
    _agents(axes, sample, grid, seen)
    ends = seen(np.array([(x, y, z) for x in (x0, x1) for y in (y0, y1) for z in (z0, z1)]))
    (left, low), (right, high) = ends.min(axis=0), ends.max(axis=0)
    axes.set(xlim=(left, right), ylim=(low, high), xticks=[], yticks=[], aspect="equal")
    axes.set_xlabel(f"from the right and above; lines on the ground every {_GRID_M:g} m", fontsize=8)
    axes.spines[:].set_visible(False)
    axes.grid(visible=False)


def _ticks(low: float, high: float) -> NDArray[np.float64]:
    """Return the multiples of the grid's width in a range, and its ends."""
    inside = np.arange(np.ceil(low / _GRID_M), np.floor(high / _GRID_M) + 1) * _GRID_M
    return np.unique([low, *inside, high])


def _agents(
    axes: Axes,
    sample: Sample,
    grid: GridSpec,
    seen: Callable[[NDArray[np.float64]], NDArray[np.float64]] = lambda points: points[:, :2],
) -> None:
    """Mark the agents in the range, by what a picture sees of (P, 3) points: the ego ahead, the others as diamonds."""
    places = sample.ego_from_agent[:, :3, 3]
    low, high = np.array(grid.range_m[:2]), np.array(grid.range_m[3:5])
    others = places[1:][((places[1:, :2] >= low) & (places[1:, :2] <= high)).all(axis=1)]
    for points, marker, size, face in ((others, "D", 4.5, "white"), (places[:1], ">", 6.0, AGENT)):
        axes.plot(
            *seen(points).T, marker=marker, markersize=size, markerfacecolor=face, color=AGENT,
            markeredgewidth=0.9, linestyle="", zorder=4,
        )  # fmt: skip


def _shown(sample: Sample) -> NDArray[np.float32]:
    """Return (P, 3) points of all agents, evenly thinned."""
    points = np.concatenate([cloud[:, :3] for cloud in sample.clouds])
    return points[:: max(1, len(points) // _SHOWN_POINTS)]


def _points_above(axes: Axes, sample: Sample) -> None:
    points = _shown(sample)
    axes.scatter(points[:, 0], points[:, 1], s=0.7, color=POINT, linewidth=0, rasterized=True)


def _boxes_above(axes: Axes, boxes: Boxes, color: str, width: float, *, filled: bool = False) -> None:
    """Draw outlines, and a line from the centre to the front."""
    corners = boxes.bev_polygons()
    if filled:
        axes.add_collection(PolyCollection(list(corners), facecolors=to_rgba(color, 0.3), linewidths=0))
    outlines = [*corners[:, [0, 1, 2, 3, 0]]]
    outlines += [*np.stack([boxes.center[:, :2], corners[:, :2].mean(axis=1)], axis=1)]
    axes.add_collection(LineCollection(outlines, colors=color, linewidths=width))


def _frame_above(axes: Axes, grid: GridSpec) -> None:
    x0, y0, _, x1, y1, _ = grid.range_m
    axes.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")
    axes.set_xlabel("x, m, ahead of the ego", fontsize=8)
    axes.set_ylabel("y, m, to its left", fontsize=8)
    axes.grid(visible=False)
    axes.tick_params(labelsize=7)
