"""Pictures of single frames: evidence in feature maps as in the paper's Figure 6, detections as in its Figure 8."""

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
from dsrc.evaluation.benchmark import Condition, corrupted, places_of
from dsrc.evaluation.config import Benchmark
from dsrc.evaluation.metrics.matching import match
from dsrc.evaluation.plots import COLORS, panels, png_bytes, styled
from dsrc.evaluation.report.paper_tables import PAPER_SEVERITY, View
from dsrc.evaluation.report.report import Block, provenance_of, slug
from dsrc.evaluation.runner import Outcome, Trained, load_used
from dsrc.evaluation.table import Column, Line, Sheet, Stat
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
"""Blue, green and orange: told apart with any colour vision. In grey it is the filling that tells true boxes."""
HIT_IOU = 0.5

_FUSION = "attention"
"""Of the networks of Figure 6, as in the paper."""
_COUNTED_FRAMES = 24
_TOP = 0.998
_SHOWN_POINTS = 12_000
_GRID_M = 20.0
_RING = np.array([(0, 1), (1, 2), (2, 3), (3, 0)])
_EDGES = np.concatenate([_RING, _RING + 4, [(corner, corner + 4) for corner in range(4)]])
"""Pairs of corners of a box, in the order of `Boxes.corners`."""

EvidenceMap = Callable[[Sample], NDArray[np.float32]]
"""What a network sees in a sample, (h, w), see `evidence`."""


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

    @property
    def helped(self) -> str:
        """How many of the true boxes only helpers see, in words."""
        return f"{only_helpers_see(self.sample).sum()} of {len(self.sample.boxes)} true boxes seen by helpers alone"

    @property
    def heading(self) -> str:
        """What stands above a column of pictures."""
        return f"Percentile {self.percentile}\n{self.title}\n{self.helped}"


def write_pictures(outcome: Outcome, out: Path) -> list[Block]:
    """Blocks of Figures 6 and 8 of a benchmark, written into the folder of its first dataset.

    Figure 6 is of the first plain method with attention, of the teacher where one is named, and of the first DSRC; a
    table counts the channels of these networks that never fire.

    Raises:
        UserError: the dataset has no frame, or the teacher's file is wrong.
    """
    plan, made_by = outcome.plan, provenance_of(outcome)
    folder = slug(plan.datasets[0].name)
    view = View.of(outcome, plan.datasets[0].name)
    shots_in = cache(partial(take_shots, plan))
    blocks = [*_figure_6(plan, view, shots_in, out / folder, made_by)]
    blocks.append(_figure_8(plan, view, shots_in, out / folder, made_by))
    return [block.below(folder) for block in blocks]


def _figure_6(
    plan: Benchmark, view: View, shots_in: Callable[[GridSpec], list[Shot]], folder: Path, made_by: Mapping[str, Any]
) -> Iterator[Block]:
    """Yield the blocks of Figure 6 and of the channels, or of the line that says what is missing."""
    baseline, student = view.plain(_FUSION), view.whole(_FUSION)
    if baseline is None or student is None:
        lacking = "a plain method with attention (attfuse)" if baseline is None else "DSRC with attention (dsrc)"
        yield Block("figure_6", f"Figure 6 is left out: it needs {lacking}.\n")
        return
    learner, taught = _load(view.trained[student][0]), ""
    networks = {f"baseline: {baseline}": _load(view.trained[baseline][0]), f"student: {student}": learner}
    maps: dict[str, EvidenceMap] = {"student, before fusion: the ego alone": partial(evidence, learner, fused=False)}
    if plan.pictures.teacher:
        teacher = load_detector(Path(plan.pictures.teacher))
        networks["teacher"] = with_fusion(teacher, _FUSION)
        taught = _about_teacher(teacher)
    maps |= {name: partial(evidence, network) for name, network in networks.items()}
    grid = learner.settings.grid
    shots = shots_in(grid)
    write_file(folder / "figure_6.png", png_bytes(feature_figure(shots, maps, grid), made_by))
    title = f"Figure 6. Evidence for a vehicle, {view.dataset}"
    text = (
        f"**{title}**\n\nEvidence in a cell: the sum over the channels c of relu(w_c f_c), in logits, with f the "
        "feature after the shrink convolutions and w the weights of the class head; of the cell's two anchors the one "
        "with more. The bias and what speaks against a vehicle are left out. All panels have one linear scale, from 0 "
        f"to the {100 * _TOP:g}th percentile of all their cells. Above a panel: the mean over the cells in true boxes, "
        f"and over all others. {taught}{_rule(shots)}\n"
    )
    yield Block("figure_6", text, "figure_6.png", title)
    sheet = _channel_sheet(networks, spread_samples(plan, grid), view.dataset)
    tables = {f"{sheet.name}.md": sheet.markdown(), f"{sheet.name}.csv": sheet.csv()}
    for name, content in tables.items():
        write_file(folder / name, content)
    yield Block(sheet.name, sheet.markdown(), tables=tuple(tables))


def _figure_8(
    plan: Benchmark, view: View, shots_in: Callable[[GridSpec], list[Shot]], folder: Path, made_by: Mapping[str, Any]
) -> Block:
    """Write Figure 8; return its block."""
    methods = list(view.trained)
    names = plan.pictures.methods or (methods if len(methods) <= 4 else [*methods[:3], methods[-1]])
    grid = view.settings[names[-1]].grid
    shots = shots_in(grid)
    detectors = {name: _load(view.trained[name][0]) for name in names}
    found = {name: [detector.detect(shot.sample) for shot in shots] for name, detector in detectors.items()}
    write_file(folder / "figure_8.png", png_bytes(detection_figure(shots, found, grid), made_by))
    title = f"Figure 8. Detections, {view.dataset}"
    text = f"**{title}**\n\nHits are at IoU {HIT_IOU} in bird's-eye view, of the first training. {_rule(shots)}\n"
    return Block("figure_8", text, "figure_8.png", title)


def _rule(shots: Sequence[Shot]) -> str:
    """Return how the frames were chosen, and which they are."""
    listed = "; ".join(f"{shot.percentile}: {shot.title}, {shot.helped}" for shot in shots)
    if any(only_helpers_see(shot.sample).any() for shot in shots):
        which = "evaluated frames with true boxes that only helpers have points on are sorted by their number"
    else:
        which = "no evaluated frame has a true box that only helpers have points on, and all are sorted"
    return (
        f"The frames are computed: {which}, those of the same number by drive and frame, and the ones at these "
        f"percentiles (nearest rank) are drawn. {listed}."
    )


def _about_teacher(teacher: Detector) -> str:
    """Return what a teacher reads in Figure 6, and what it read in its training."""
    settings = teacher.settings
    trained = "" if settings.fusion == _FUSION else f", though it was trained with the fusion '{settings.fusion}'"
    clouds = " and ".join(word for word, on in (("dense", settings.sdd), ("painted", settings.pcp)) if on) or "plain"
    return (
        f"The teacher reads the clouds of all agents, which ground truth has made {clouds}, with the student's fusion"
        f"{trained}. "
    )


def check_pictures(plan: Benchmark) -> None:
    """Look, before the work, whether the pictures of a benchmark can be drawn after it.

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


def _load(one: Trained) -> Detector:
    return load_used(one.path, one.use)


def only_helpers_see(sample: Sample) -> NDArray[np.bool_]:
    """(N,) whether a true box has a point from a helper and none from the ego, in the sweeps as they were recorded."""
    return ~np.isin(sample.boxes.object_id, sample.agent_boxes[0].object_id)


def frames_at(plan: Benchmark, grid: GridSpec) -> list[tuple[int, Drive, int]]:
    """Percentile, drive and position of the frames that are drawn: nobody chooses them.

    Those evaluated frames of the first dataset that have true boxes in the grid's range with points from helpers alone
    are sorted by the number of such boxes, frames of the same number by drive and frame; where no frame has any, all
    are. The frame at percentile p of n is number ceil(p / 100 * n) of them, at least the first: nearest rank,
    definition 1 of Hyndman and Fan, Sample Quantiles in Statistical Packages, 1996.

    Raises:
        DataError: the dataset has no frame.
    """
    readers = _readers(plan)
    places = places_of(readers, plan.limit)
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


def spread_samples(plan: Benchmark, grid: GridSpec) -> list[Sample]:
    """Samples of clean frames, evenly spread over the first dataset, that channels are counted in."""
    readers = _readers(plan)
    places = places_of(readers, min(_COUNTED_FRAMES, plan.limit or _COUNTED_FRAMES))
    return [
        make_sample(reader.read(position), None, grid)
        for reader, positions in zip(readers, places, strict=True)
        for position in positions
    ]


def _readers(plan: Benchmark) -> list[Drive]:
    return [open_drive(drive) for folder in plan.datasets[0].drives for drive in list_drives(Path(folder))]


def _output(detector: Detector, sample: Sample) -> Output:
    """Return what a network computes of a sample; a teacher reads clouds made with ground truth."""
    batch = collate([sample], detector.settings, training=False)
    pillars = batch.teacher if detector.settings.role == "teacher" else batch.student
    if pillars is None:
        raise ValueError("a batch has the clouds that its network reads")
    device = detector.cls_head.weight.device
    return detector(pillars.to(device), batch.layout.to(device))


@torch.inference_mode()
def evidence(detector: Detector, sample: Sample, *, fused: bool = True) -> NDArray[np.float32]:
    """(h, w) evidence for a vehicle in each cell, logits, at least 0.

    It is the sum over the channels c of relu(w_c f_c), f being the feature after the shrink convolutions and w the
    class head's weights, of that one of the cell's two anchors that has more of it. The logit is this, less what speaks
    against a vehicle, plus the bias. The mean of |f| is no evidence: it can be largest where the head is surest that a
    cell is empty.

    Args:
        detector: one that fuses stages, in evaluation mode.
        sample: what it sees.
        fused: of the fused maps; else of the ego's own, before fusion.
    """
    output = _output(detector, sample)
    if not fused:
        output = detector.read(output.stages, [own[:1] for own in detector.maps(output.stages)])
    weight = detector.cls_head.weight[:, :, 0, 0]
    by_anchor = (weight[:, :, None, None] * output.fused[:1]).relu().sum(1)
    return by_anchor.amax(0).float().cpu().numpy()


@torch.inference_mode()
def firing_channels(detector: Detector, samples: Iterable[Sample]) -> NDArray[np.bool_]:
    """(C,) whether a channel after the shrink convolutions is above 0 in any cell of any sample."""
    fired = np.zeros(detector.cls_head.in_channels, bool)
    for sample in samples:
        fired |= (_output(detector, sample).fused > 0).any(3).any(2).any(0).cpu().numpy()
    return fired


def _channel_sheet(networks: Mapping[str, Detector], samples: Sequence[Sample], dataset: str) -> Sheet:
    """Return how many channels each network has after the shrink convolutions, and how many of them never fire."""
    columns = tuple(Column(title, ("",), better="", scale=1, digits=0) for title in ("Channels", "Never fire"))
    lines = []
    for name, network in networks.items():
        fired = firing_channels(network, samples)
        lines.append(Line(name, ((Stat(len(fired)),), (Stat(int((~fired).sum())),))))
    note = (
        "Channels after the shrink convolutions, fused, and those that are above 0 in no cell of "
        f"{len(samples)} clean frames, evenly spread over the drives. The first training of each."
    )
    return Sheet("channels", f"Channels that never fire, {dataset}", note, "Network", columns, tuple(lines))


def feature_figure(shots: Sequence[Shot], maps: Mapping[str, EvidenceMap], grid: GridSpec) -> Figure:
    """Figure 6: the points of all agents and each network's evidence, a line each, a column for each frame.

    Args:
        shots: the frames.
        maps: by the line's name, see `evidence`; all have one scale.
        grid: the range that all of them see.
    """
    x0, y0, _, x1, y1, _ = grid.range_m
    values = [[seen(shot.sample) for shot in shots] for seen in maps.values()]
    high = float(np.quantile(np.array(values), _TOP)) or 1.0
    with styled():
        heights = [(y1 - y0) / (x1 - x0)] * (1 + len(maps))
        figure, axes = _columns(shots, heights, "Evidence for a vehicle in feature maps")
        for column, shot in enumerate(shots):
            points = axes[0, column]
            _points_above(points, shot.sample)
            points.set_title(shot.heading, fontsize=8.5)
            inside = cells_in_boxes([shot.sample.boxes], grid)[0]
            for line, of_network in enumerate(values):
                panel, seen = axes[1 + line, column], of_network[column]
                image = panel.imshow(seen, "YlOrBr", origin="lower", extent=(x0, x1, y0, y1), vmin=0.0, vmax=high)
                panel.set_title(_contrast(seen, inside), fontsize=8, fontweight="normal")
            for panel in axes[:, column]:
                _truth_above(panel, shot.sample, 0.9, filled=panel is points)
                _frame_above(panel, grid)
                _agents(panel, shot.sample, grid)
        _name_lines(axes, ["LiDAR points of all agents", *maps])
        bar = figure.colorbar(image, ax=axes[1:].ravel().tolist(), extend="max", fraction=0.02, pad=0.01, aspect=40)
        bar.set_label(f"evidence for a vehicle, logits; up to the {100 * _TOP:g}th percentile of all panels' cells")
        axes[-1, len(shots) // 2].set_xlabel("x ahead of the ego, y to its left, m", fontsize=8)
        figure.legend(handles=_handles(), loc="outside lower center", ncols=5)
    return figure


def _contrast(seen: NDArray[np.float32], inside: NDArray[np.bool_]) -> str:
    """Return the mean of an (h, w) map in true boxes and elsewhere; `inside` is (H, W) of the input's smaller cells."""
    height, width = seen.shape
    cells = inside.reshape(height, inside.shape[0] // height, width, inside.shape[1] // width).any(axis=(1, 3))
    within = f"{seen[cells].mean():.2f}" if cells.any() else "-"
    return f"mean in true boxes {within}, elsewhere {seen[~cells].mean():.2f}"


def detection_figure(shots: Sequence[Shot], found: Mapping[str, Sequence[Detections]], grid: GridSpec) -> Figure:
    """Figure 8: each method's detections and the truth in 3D and below it from above, a column for each frame.

    The others have points on the ego, so that some detectors find it. Its own body is no object of the truth and AP
    takes such a detection for a false one; here it has the ego's colour and is counted apart.

    Args:
        shots: the frames.
        found: by method the detections in each of them.
        grid: the range that all methods see.
    """
    with styled():
        title = f"Detections; hits at IoU {HIT_IOU} in bird's-eye view"
        x0, y0, _, x1, y1, _ = grid.range_m
        _, (left, low, right, high) = _camera(grid)
        heights = [(high - low) / (right - left), (y1 - y0) / (x1 - x0)] * len(found)
        figure, axes = _columns(shots, heights, title)
        for row, of_method in enumerate(found.values()):
            for column, (shot, detections) in enumerate(zip(shots, of_method, strict=True)):
                scene, above = axes[2 * row, column], axes[2 * row + 1, column]
                own = bev_iou(detections.boxes.array, shot.ego.array).max(axis=1, initial=0.0) >= HIT_IOU
                others, helped = detections[~own], only_helpers_see(shot.sample)
                drawn = (
                    (shot.sample.boxes[~helped], TRUTH, 1.0, True), (shot.sample.boxes[helped], HELPED, 1.0, True),
                    (others.boxes, FOUND, 1.1, False),
                    (shot.ego, AGENT, 1.0, True), (detections.boxes[own], AGENT, 1.1, False),
                )  # fmt: skip
                _scene(scene, shot.sample, drawn, grid)
                found_itself = ", and the ego itself" if own.any() else ""
                heading = f"{shot.heading}\n" if row == 0 else ""
                scene.set_title(f"{heading}{counted(others, shot.sample.boxes)}{found_itself}", fontsize=8.5)
                _points_above(above, shot.sample)
                for boxes, color, width, filled in drawn:
                    _boxes_above(above, boxes, color, width, filled=filled)
                _frame_above(above, grid)
                _agents(above, shot.sample, grid)
        _name_lines(axes, [label for name in found for label in (name, f"{name}, from above")])
        about = f"3D: from the right of the ego and above, lines on the ground every {_GRID_M:g} m. "
        about += "From above: x ahead of the ego, y to its left, m"
        axes[-1, len(shots) // 2].set_xlabel(about, fontsize=8)
        figure.legend(
            handles=[*_handles(), Line2D([], [], color=FOUND, label="detection")], loc="outside lower center", ncols=6
        )
    return figure


def _columns(shots: Sequence[Shot], heights: Sequence[float], title: str) -> tuple[Figure, NDArray[Any]]:
    """Return a figure and its (rows, frames) panels; `heights` are those of the rows over a panel's width."""
    width = max(3.8, 8.0 / len(shots))
    total = 1.4 + sum(0.18 + width * height for height in heights)
    figure, axes = panels(0.8 + width * len(shots), total, len(heights), len(shots), title)
    spec = axes[0].get_gridspec()
    if spec is not None:
        spec.set_height_ratios(heights)
    figure.set_layout_engine("compressed")  # panels of fixed proportions, without the room that these leave
    return figure, np.array(axes).reshape(len(heights), len(shots))


def _name_lines(axes: NDArray[Any], names: Sequence[str]) -> None:
    """Write the names of the lines at their left."""
    for panel, name in zip(axes[:, 0], names, strict=True):
        panel.set_ylabel(textwrap.fill(name, 16), fontsize=8, fontweight="bold")


def counted(detections: Detections, truth: Boxes) -> str:
    """Return how many true boxes were hit and missed, and how many detections hit none."""
    hits = int(match(bev_iou(detections.boxes.array, truth.array), detections.score, HIT_IOU).hit.sum())
    return f"{hits} hit, {len(truth) - hits} missed, {len(detections) - hits} false"


def _handles() -> list[Patch | Line2D]:
    """Return what the colours and signs of both figures mean."""
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


def _camera(
    grid: GridSpec,
) -> tuple[Callable[[NDArray[np.floating]], NDArray[np.float64]], tuple[float, float, float, float]]:
    """Return what maps (..., 3) points to (..., 2) right and up in 3D pictures, and the range's left, low, right, high.

    The camera stands at the right of the ego and above, with the whole range in sight.
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


def _truth_above(axes: Axes, sample: Sample, width: float, *, filled: bool) -> None:
    """Draw the true boxes, those that only helpers see in their own colour."""
    helped = only_helpers_see(sample)
    for boxes, color in ((sample.boxes[~helped], TRUTH), (sample.boxes[helped], HELPED)):
        _boxes_above(axes, boxes, color, width, filled=filled)


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
    axes.grid(visible=False)
    axes.tick_params(labelsize=7)
