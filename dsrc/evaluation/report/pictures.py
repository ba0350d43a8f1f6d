"""Pictures of single frames: evidence in feature maps, the paper's Figure 6, and detections, its Figure 8."""

import math
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from dsrc.data.drives import Drive, list_drives, open_drive
from dsrc.data.sample import Sample, make_sample
from dsrc.evaluation.conditions import Condition
from dsrc.evaluation.config import Benchmark
from dsrc.evaluation.detect import corrupted, frame_positions
from dsrc.evaluation.metrics.matching import match
from dsrc.evaluation.plots import COLORS, figure_style, panels, png_bytes
from dsrc.evaluation.report.paper_tables import PAPER_SEVERITY, DatasetResults
from dsrc.evaluation.report.report import Section, provenance_of, slug
from dsrc.evaluation.runner import BenchmarkResult, TrainedDetector, load_adjusted
from dsrc.evaluation.table import Column, ResultTable, Stat, TableRow
from dsrc.models.detector import Detector, Output
from dsrc.models.inputs.batch import collate
from dsrc.models.inputs.labels import cells_in_boxes
from dsrc.models.storage.checkpoint import load_detector, with_fusion
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from dsrc.ops.iou import bev_iou
from sensors.corruptions import CLEAN, drive_seed
from sim.boxes import Boxes
from sim.errors import CheckpointError, SettingsError, complaint
from sim.files import write_file
from sim.geometry import invert

TRUTH, HELPED, FOUND, AGENT, POINT = COLORS[0], COLORS[2], COLORS[1], "#000000", "#7B848E"
"""Blue, green and orange, distinct with any colour vision; in grey the filling marks true boxes."""
HIT_IOU = 0.5

_FUSION = "attention"
"""Fusion of the networks in Figure 6, as in the paper."""
_COUNTED_FRAMES = 24
_TOP = 0.998
_SHOWN_POINTS = 12_000
_GRID_M = 20.0
_RING = np.array([(0, 1), (1, 2), (2, 3), (3, 0)])
_EDGES = np.concatenate([_RING, _RING + 4, [(corner, corner + 4) for corner in range(4)]])
"""Edges of a box: pairs of its corners, in the order of `Boxes.corners`."""

EvidenceFunction = Callable[[Sample], NDArray[np.float32]]
"""Function from a sample to a network's (h, w) evidence, see `vehicle_evidence`."""


@dataclass(frozen=True, slots=True)
class DrawnFrame:
    """Frame in a picture.

    Attributes:
        sample: of the ego and its collaborators.
        title: drive, number and condition of the frame.
        percentile: of the frame, see `frames_at`.
        ego: the ego's own body, not part of the ground truth, in its LiDAR's frame; empty where unknown.
    """

    sample: Sample
    title: str
    percentile: int
    ego: Boxes = field(default_factory=Boxes.zeros)

    @property
    def helped(self) -> str:
        """Count of true boxes with points from helpers alone, as text."""
        return f"{only_helpers_see(self.sample).sum()} of {len(self.sample.boxes)} true boxes seen by helpers alone"

    @property
    def heading(self) -> str:
        """Heading of a column of pictures."""
        return f"Percentile {self.percentile}\n{self.title}\n{self.helped}"


def write_pictures(result: BenchmarkResult, out: Path) -> list[Section]:
    """Sections of Figures 6 and 8 of a benchmark, written into the folder of its first dataset.

    Figure 6 shows the first plain method with attention, the teacher if named, and the first DSRC; a table counts the
    channels of these networks that never fire.

    Raises:
        UserError: the dataset has no frame, or the teacher's file is invalid.
    """
    plan, made_by = result.plan, provenance_of(result)
    folder = slug(plan.datasets[0].name)
    results = DatasetResults.of(result, plan.datasets[0].name)
    frames_in = cache(partial(read_drawn_frames, plan))
    sections = [*_figure_6(plan, results, frames_in, out / folder, made_by)]
    sections.append(_figure_8(plan, results, frames_in, out / folder, made_by))
    return [section.below(folder) for section in sections]


def _figure_6(
    plan: Benchmark,
    results: DatasetResults,
    frames_in: Callable[[GridSpec], list[DrawnFrame]],
    folder: Path,
    made_by: Mapping[str, Any],
) -> Iterator[Section]:
    """Yield the sections of Figure 6 and of the channels, or one that names the missing method."""
    baseline, student = results.plain(_FUSION), results.whole(_FUSION)
    if baseline is None or student is None:
        lacking = "a plain method with attention (attfuse)" if baseline is None else "DSRC with attention (dsrc)"
        yield Section("figure_6", f"Figure 6 is left out: it needs {lacking}.\n")
        return
    learner, taught = _load(results.trained[student][0]), ""
    networks = {f"baseline: {baseline}": _load(results.trained[baseline][0]), f"student: {student}": learner}
    maps: dict[str, EvidenceFunction] = {
        "student, before fusion: the ego alone": partial(vehicle_evidence, learner, fused=False)
    }
    if plan.pictures.teacher:
        teacher = load_detector(Path(plan.pictures.teacher))
        networks["teacher"] = with_fusion(teacher, _FUSION)
        taught = _about_teacher(teacher)
    maps |= {name: partial(vehicle_evidence, network) for name, network in networks.items()}
    grid = learner.settings.grid
    chosen = frames_in(grid)
    write_file(folder / "figure_6.png", png_bytes(feature_figure(chosen, maps, grid), made_by))
    title = f"Figure 6. Evidence for a vehicle, {results.dataset}"
    text = (
        f"**{title}**\n\nEvidence in a cell: the sum over the channels c of relu(w_c f_c), in logits, with f the "
        "feature after the shrink convolutions and w the weights of the class head; of the cell's two anchors the one "
        "with more. The bias and what speaks against a vehicle are left out. All panels have one linear scale, from 0 "
        f"to the {100 * _TOP:g}th percentile of all their cells. Above a panel: the mean over the cells in true boxes, "
        f"and over all others. {taught}{_selection_rule(chosen)}\n"
    )
    yield Section("figure_6", text, "figure_6.png", title)
    sheet = _channel_table(networks, spread_samples(plan, grid), results.dataset)
    tables = {f"{sheet.name}.md": sheet.markdown(), f"{sheet.name}.csv": sheet.csv()}
    for name, content in tables.items():
        write_file(folder / name, content)
    yield Section(sheet.name, sheet.markdown(), tables=tuple(tables))


def _figure_8(
    plan: Benchmark,
    results: DatasetResults,
    frames_in: Callable[[GridSpec], list[DrawnFrame]],
    folder: Path,
    made_by: Mapping[str, Any],
) -> Section:
    """Write Figure 8; return its section."""
    methods = list(results.trained)
    names = plan.pictures.methods or (methods if len(methods) <= 4 else [*methods[:3], methods[-1]])
    grid = results.settings[names[-1]].grid
    chosen = frames_in(grid)
    detectors = {name: _load(results.trained[name][0]) for name in names}
    found = {name: [detector.detect(frame.sample) for frame in chosen] for name, detector in detectors.items()}
    write_file(folder / "figure_8.png", png_bytes(detection_figure(chosen, found, grid), made_by))
    title = f"Figure 8. Detections, {results.dataset}"
    about = f"Hits are at IoU {HIT_IOU} in bird's-eye view, of the first training."
    text = f"**{title}**\n\n{about} {_selection_rule(chosen)}\n"
    return Section("figure_8", text, "figure_8.png", title)


def _selection_rule(chosen: Sequence[DrawnFrame]) -> str:
    """Text of the selection of frames, with its result."""
    listed = "; ".join(f"{frame.percentile}: {frame.title}, {frame.helped}" for frame in chosen)
    if any(only_helpers_see(frame.sample).any() for frame in chosen):
        which = "evaluated frames with true boxes that only helpers have points on are sorted by their number"
    else:
        which = "no evaluated frame has a true box that only helpers have points on, and all are sorted"
    return (
        f"The frames are computed: {which}, those of the same number by drive and frame, and the ones at these "
        f"percentiles (nearest rank) are drawn. {listed}."
    )


def _about_teacher(teacher: Detector) -> str:
    """Text of a teacher's input in Figure 6 and in its training."""
    settings = teacher.settings
    trained = "" if settings.fusion == _FUSION else f", though it was trained with the fusion '{settings.fusion}'"
    clouds = " and ".join(word for word, on in (("dense", settings.sdd), ("painted", settings.pcp)) if on) or "plain"
    return (
        f"The teacher reads the clouds of all agents, which ground truth has made {clouds}, with the student's fusion"
        f"{trained}. "
    )


def check_pictures(plan: Benchmark) -> None:
    """Check before the work that the pictures of a benchmark can be drawn.

    Raises:
        UserError: the teacher's file is missing, damaged, a student's, or of a fusion with weights of its own.
    """
    if plan.pictures.teacher:
        teacher = load_detector(Path(plan.pictures.teacher))
        if teacher.settings.role != "teacher":
            raise SettingsError(complaint(plan.pictures.teacher, "settings.role", "teacher", teacher.settings.role))
        try:
            with_fusion(teacher, _FUSION)
        except CheckpointError as error:
            raise CheckpointError(f"{plan.pictures.teacher}: {error}") from None


def _load(one: TrainedDetector) -> Detector:
    return load_adjusted(one.path, one.use)


def only_helpers_see(sample: Sample) -> NDArray[np.bool_]:
    """(N,) true boxes with points from helpers and none from the ego, in the sweeps as recorded."""
    return ~np.isin(sample.boxes.object_id, sample.agent_boxes[0].object_id)


def frames_at(plan: Benchmark, grid: GridSpec) -> list[tuple[int, Drive, int]]:
    """Percentile, drive and position of the drawn frames, selected by rule.

    Evaluated frames of the first dataset with true boxes in the grid's range that have points from helpers alone are
    sorted by the number of these boxes, equal ones by drive and frame; where no frame has any, all frames are sorted.
    The frame at percentile p of n is number ceil(p / 100 * n), at least the first: nearest rank, definition 1 of
    Hyndman and Fan, Sample Quantiles in Statistical Packages, 1996.

    Raises:
        DataError: the dataset has no frame.
    """
    readers = _readers(plan)
    places = frame_positions(readers, plan.limit)
    ranked = []
    for row, (reader, positions) in enumerate(zip(readers, places, strict=True)):
        for position in positions:
            seen = make_sample(reader.read(position), None, grid, cooperative=False)
            count, number = int(only_helpers_see(seen).sum()), reader.frames[position]
            ranked.append((count, reader.drive.name, number, row, position))
    ranked.sort()
    ranked = [one for one in ranked if one[0]] or ranked
    chosen = []
    for percentile in plan.pictures.percentiles:
        *_, row, position = ranked[max(1, math.ceil(percentile * len(ranked) / 100)) - 1]
        chosen.append((percentile, readers[row], position))
    return chosen


def read_drawn_frames(plan: Benchmark, grid: GridSpec) -> list[DrawnFrame]:
    """Frames of a benchmark's pictures, see `frames_at`, under their condition.

    Raises:
        DataError: the dataset has no frame.
    """
    kind = plan.pictures.corruption
    condition = Condition(kind, 0 if kind == CLEAN else PAPER_SEVERITY, plan.family, plan.who)
    chosen = []
    for percentile, reader, position in frames_at(plan, grid):
        name = reader.drive.name
        frame = corrupted(reader.read(position), condition, drive_seed(plan.seed, name))
        sample = make_sample(frame, None, grid)
        pose = frame.agent(sample.agent_ids[0]).sweep.world_from_lidar
        ego = frame.truth[frame.truth.object_id == sample.agent_ids[0]].transform(invert(pose))
        chosen.append(DrawnFrame(sample, f"{name}, frame {reader.frames[position]}, {kind}", percentile, ego))
    return chosen


def spread_samples(plan: Benchmark, grid: GridSpec) -> list[Sample]:
    """Samples of clean frames for the count of channels, evenly spread over the first dataset."""
    readers = _readers(plan)
    places = frame_positions(readers, min(_COUNTED_FRAMES, plan.limit or _COUNTED_FRAMES))
    return [
        make_sample(reader.read(position), None, grid)
        for reader, positions in zip(readers, places, strict=True)
        for position in positions
    ]


def _readers(plan: Benchmark) -> list[Drive]:
    return [open_drive(drive) for folder in plan.datasets[0].drives for drive in list_drives(Path(folder))]


def _output(detector: Detector, sample: Sample) -> Output:
    """Output of a network for a sample; a teacher reads clouds made with ground truth."""
    batch = collate([sample], detector.settings, training=False)
    pillars = batch.teacher if detector.settings.role == "teacher" else batch.student
    if pillars is None:
        raise ValueError("the batch has no clouds for this network")
    device = detector.cls_head.weight.device
    return detector(pillars.to(device), batch.layout.to(device))


@torch.inference_mode()
def vehicle_evidence(detector: Detector, sample: Sample, *, fused: bool = True) -> NDArray[np.float32]:
    """(h, w) evidence for a vehicle in each cell of the grid, y upwards and x to the right, logits, at least 0.

    The sum over the channels c of relu(w_c f_c), with f the feature after the shrink convolutions and w the weights of
    the class head, for the cell's anchor with the larger sum. The logit is this plus the negative terms and the bias.
    The mean of |f| is no evidence: it can be largest where the head is surest that a cell is empty.

    Args:
        detector: one that fuses stages, in evaluation mode.
        sample: its input.
        fused: evidence in the fused maps, else in the ego's own before fusion.
    """
    output = _output(detector, sample)
    if not fused:
        output = detector.heads(output.stages, [own[:1] for own in detector.maps(output.stages)])
    weight = detector.cls_head.weight[:, :, 0, 0]
    by_anchor = (weight[:, :, None, None] * output.fused[:1]).relu().sum(1)
    evidence = by_anchor.amax(0).float().cpu().numpy()
    # The maps of a network that was trained in the mirror image have y to the right.
    return np.ascontiguousarray(evidence[::-1]) if detector.settings.left_handed else evidence


@torch.inference_mode()
def firing_channels(detector: Detector, samples: Iterable[Sample]) -> NDArray[np.bool_]:
    """(C,) channels after the shrink convolutions above 0 in any cell of any sample."""
    fired = np.zeros(detector.cls_head.in_channels, bool)
    for sample in samples:
        fired |= (_output(detector, sample).fused > 0).any(3).any(2).any(0).cpu().numpy()
    return fired


def _channel_table(networks: Mapping[str, Detector], samples: Sequence[Sample], dataset: str) -> ResultTable:
    """Table of the channels after the shrink convolutions of each network, and of those that never fire."""
    columns = tuple(Column(title, ("",), better="", scale=1, digits=0) for title in ("Channels", "Never fire"))
    lines = []
    for name, network in networks.items():
        fired = firing_channels(network, samples)
        lines.append(TableRow(name, ((Stat(len(fired)),), (Stat(int((~fired).sum())),))))
    note = (
        "Channels after the shrink convolutions, fused, and those that are above 0 in no cell of "
        f"{len(samples)} clean frames, evenly spread over the drives. The first training of each."
    )
    return ResultTable("channels", f"Channels that never fire, {dataset}", note, "Network", columns, tuple(lines))


def feature_figure(chosen: Sequence[DrawnFrame], maps: Mapping[str, EvidenceFunction], grid: GridSpec) -> Figure:
    """Figure 6: the points of all agents and each network's evidence, a line each, a column for each frame.

    Args:
        chosen: the frames.
        maps: by the line's name, see `vehicle_evidence`; all have one scale.
        grid: the range that all of them see.
    """
    x0, y0, _, x1, y1, _ = grid.range_m
    values = [[seen(frame.sample) for frame in chosen] for seen in maps.values()]
    high = float(np.quantile(np.array(values), _TOP)) or 1.0
    with figure_style():
        heights = [(y1 - y0) / (x1 - x0)] * (1 + len(maps))
        figure, axes = _columns(chosen, heights, "Evidence for a vehicle in feature maps")
        for column, frame in enumerate(chosen):
            points = axes[0, column]
            _points_above(points, frame.sample)
            points.set_title(frame.heading, fontsize=8.5)
            inside = cells_in_boxes([frame.sample.boxes], grid)[0]
            for line, of_network in enumerate(values):
                panel, seen = axes[1 + line, column], of_network[column]
                image = panel.imshow(seen, "YlOrBr", origin="lower", extent=(x0, x1, y0, y1), vmin=0.0, vmax=high)
                panel.set_title(_contrast(seen, inside), fontsize=8, fontweight="normal")
            for panel in axes[:, column]:
                _truth_above(panel, frame.sample, 0.9, filled=panel is points)
                _frame_above(panel, grid)
                _agents(panel, frame.sample, grid)
        _name_lines(axes, ["LiDAR points of all agents", *maps])
        bar = figure.colorbar(image, ax=axes[1:].ravel().tolist(), extend="max", fraction=0.02, pad=0.01, aspect=40)
        bar.set_label(f"evidence for a vehicle, logits; up to the {100 * _TOP:g}th percentile of all panels' cells")
        axes[-1, len(chosen) // 2].set_xlabel("x ahead of the ego, y to its left, m", fontsize=8)
        figure.legend(handles=_handles(), loc="outside lower center", ncols=5)
    return figure


def _contrast(seen: NDArray[np.float32], inside: NDArray[np.bool_]) -> str:
    """Text of an (h, w) map's means in true boxes and elsewhere; `inside` is (H, W), of the input's smaller cells."""
    height, width = seen.shape
    cells = inside.reshape(height, inside.shape[0] // height, width, inside.shape[1] // width).any(axis=(1, 3))
    within = f"{seen[cells].mean():.2f}" if cells.any() else "-"
    return f"mean in true boxes {within}, elsewhere {seen[~cells].mean():.2f}"


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
        _, (left, low, right, high) = _camera(grid)
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
                _scene(scene, frame.sample, drawn, grid)
                found_itself = ", and the ego itself" if own.any() else ""
                heading = f"{frame.heading}\n" if row == 0 else ""
                scene.set_title(f"{heading}{match_counts(others, frame.sample.boxes)}{found_itself}", fontsize=8.5)
                _points_above(above, frame.sample)
                for boxes, color, width, filled in drawn:
                    _boxes_above(above, boxes, color, width, filled=filled)
                _frame_above(above, grid)
                _agents(above, frame.sample, grid)
        _name_lines(axes, [label for name in found for label in (name, f"{name}, from above")])
        about = f"3D: from the right of the ego and above, lines on the ground every {_GRID_M:g} m. "
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


def _camera(
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


def _scene(axes: Axes, sample: Sample, drawn: Iterable[tuple[Boxes, str, float, bool]], grid: GridSpec) -> None:
    """Draw points and boxes in 3D, see `_camera`.

    Args:
        axes: to draw on.
        sample: whose points and agents.
        drawn: boxes, their colour, width of their edges and whether their floor is filled.
        grid: the range.
    """
    x0, y0, z0, x1, y1, _ = grid.range_m
    seen, (left, low, right, high) = _camera(grid)
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
    axes.set(xlim=(left, right), ylim=(low, high), xticks=[], yticks=[], aspect="equal")
    axes.spines[:].set_visible(False)
    axes.grid(visible=False)


def _ticks(low: float, high: float) -> NDArray[np.float64]:
    """Multiples of the grid's width in a range, and its ends."""
    inside = np.arange(np.ceil(low / _GRID_M), np.floor(high / _GRID_M) + 1) * _GRID_M
    return np.unique([low, *inside, high])


def _agents(
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


def _points_above(axes: Axes, sample: Sample) -> None:
    points = _shown(sample)
    axes.scatter(points[:, 0], points[:, 1], s=0.7, color=POINT, linewidth=0, rasterized=True)


def _truth_above(axes: Axes, sample: Sample, width: float, *, filled: bool) -> None:
    """Draw the true boxes, those with points from helpers alone in their own colour."""
    helped = only_helpers_see(sample)
    for boxes, color in ((sample.boxes[~helped], TRUTH), (sample.boxes[helped], HELPED)):
        _boxes_above(axes, boxes, color, width, filled=filled)


def _boxes_above(axes: Axes, boxes: Boxes, color: str, width: float, *, filled: bool = False) -> None:
    """Draw outlines of boxes, with a line from the centre to the front."""
    corners = boxes.bev_polygons()
    if filled:
        axes.add_collection(PolyCollection(list(corners), facecolors=to_rgba(color, 0.3), linewidths=0))
    outlines = [*corners[:, [0, 1, 2, 3, 0]]]
    outlines += [*np.stack([boxes.center[:, :2], corners[:, :2].mean(axis=1)], axis=1)]
    axes.add_collection(LineCollection(outlines, colors=color, linewidths=width))


def _frame_above(axes: Axes, grid: GridSpec) -> None:
    x0, y0, _, x1, y1, _ = grid.range_m
    axes.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")
    axes.grid(visible=False)
    axes.tick_params(labelsize=7)
