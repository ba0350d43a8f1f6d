"""Sections of a report with pictures of single frames: the paper's Figures 6 and 8."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

from dsrc.evaluation.config import Benchmark
from dsrc.evaluation.figures.style import png_bytes
from dsrc.evaluation.report.dataset_results import DatasetResults
from dsrc.evaluation.report.document import Section, slug
from dsrc.evaluation.report.pictures.evidence import EvidenceFunction, channel_table, vehicle_evidence
from dsrc.evaluation.report.pictures.figures import HIT_IOU, TOP, detection_figure, feature_figure
from dsrc.evaluation.report.pictures.frames import DrawnFrame, only_helpers_see, read_drawn_frames, spread_samples
from dsrc.evaluation.report.report import provenance_of
from dsrc.evaluation.runner import BenchmarkResult, TrainedDetector, load_adjusted
from dsrc.models.detector import Detector
from dsrc.models.storage.checkpoint import load_detector, with_fusion
from dsrc.ops.grid import GridSpec
from sim.errors import CheckpointError, SettingsError, complaint
from sim.files import write_file

_FUSION = "attention"
"""Fusion of the networks in Figure 6, as in the paper."""


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
        f"to the {100 * TOP:g}th percentile of their cells in true boxes. Above a panel: the mean over these cells and "
        f"over all others. {taught}{_selection_rule(chosen)}\n"
    )
    yield Section("figure_6", text, "figure_6.png", title)
    sheet = channel_table(networks, spread_samples(plan, grid), results.dataset)
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
