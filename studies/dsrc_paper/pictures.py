"""Sections of a report with pictures of single frames: the paper's Figures 6 and 8."""

from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path

from dsrc.detectors.open import open_detector
from dsrc.evaluation.config import Benchmark
from dsrc.evaluation.report.dataset_results import DatasetResults
from dsrc.evaluation.runner import BenchmarkResult, TrainedDetector
from dsrc.models.detector import Detector
from dsrc.models.storage.checkpoint import load_detector, with_fusion
from dsrc.ops.grid import GridSpec
from dsrc.tables.document import SectionWriter
from sim.errors import CheckpointError, SettingsError, complaint
from studies.dsrc_paper.evidence import EvidenceFunction, channel_table, vehicle_evidence
from studies.dsrc_paper.frame_figures import HIT_IOU, TOP, detection_figure, feature_figure
from studies.dsrc_paper.frames import DrawnFrame, only_helpers_see, pictures_of, read_drawn_frames, spread_samples
from studies.dsrc_paper.methods import plain, whole

_FUSION = "attention"
"""Fusion of the networks in Figure 6, as in the paper."""


def write_pictures(result: BenchmarkResult, writer: SectionWriter) -> None:
    """Write Figures 6 and 8 of a benchmark's first dataset.

    Figure 6 shows the first plain method with attention, the teacher if named, and the first DSRC; a table counts the
    channels of these networks that never fire.

    Raises:
        UserError: the dataset has no frame, or the teacher's file is invalid.
    """
    plan = result.plan
    results = DatasetResults.of(result, plan.datasets[0].name)
    frames_in = cache(partial(read_drawn_frames, plan))
    _figure_6(plan, results, frames_in, writer)
    _figure_8(plan, results, frames_in, writer)


def _figure_6(
    plan: Benchmark,
    results: DatasetResults,
    frames_in: Callable[[GridSpec], list[DrawnFrame]],
    writer: SectionWriter,
) -> None:
    """Write Figure 6 and the table of channels, or a text that names the missing method."""
    baseline, student = plain(results, _FUSION), whole(results, _FUSION)
    if baseline is None or student is None:
        lacking = "a plain method with attention (attfuse)" if baseline is None else "DSRC with attention (dsrc)"
        writer.section("figure_6", f"Figure 6 is left out: it needs {lacking}.\n")
        return
    learner, taught = _load(results.trained[student][0]), ""
    networks = {f"baseline: {baseline}": _load(results.trained[baseline][0]), f"student: {student}": learner}
    maps: dict[str, EvidenceFunction] = {
        "student, before fusion: the ego alone": partial(vehicle_evidence, learner, fused=False)
    }
    if file := pictures_of(plan).teacher:
        teacher = load_detector(Path(file))
        networks["teacher"] = with_fusion(teacher, _FUSION)
        taught = _about_teacher(teacher)
    maps |= {name: partial(vehicle_evidence, network) for name, network in networks.items()}
    grid = learner.settings.grid
    chosen = frames_in(grid)
    title = f"Figure 6. Evidence for a vehicle, {results.dataset}"
    text = (
        f"**{title}**\n\nEvidence in a cell: the sum over the channels c of relu(w_c f_c), in logits, with f the "
        "feature after the shrink convolutions and w the weights of the class head; of the cell's two anchors the one "
        "with more. The bias and what speaks against a vehicle are left out. All panels have one linear scale, from 0 "
        f"to the {100 * TOP:g}th percentile of their cells in true boxes. Above a panel: the mean over these cells and "
        f"over all others. {taught}{_selection_rule(chosen)}\n"
    )
    writer.section("figure_6", text, figure=feature_figure(chosen, maps, grid), about=title)
    writer.table(channel_table(networks, spread_samples(plan, grid), results.dataset))


def _figure_8(
    plan: Benchmark,
    results: DatasetResults,
    frames_in: Callable[[GridSpec], list[DrawnFrame]],
    writer: SectionWriter,
) -> None:
    """Write Figure 8."""
    methods = list(results.trained)
    names = pictures_of(plan).methods or (methods if len(methods) <= 4 else [*methods[:3], methods[-1]])
    grid = results.settings[names[-1]].grid
    chosen = frames_in(grid)
    detectors = {name: _load(results.trained[name][0]) for name in names}
    found = {name: [detector.detect(frame.sample) for frame in chosen] for name, detector in detectors.items()}
    title = f"Figure 8. Detections, {results.dataset}"
    about = f"Hits are at IoU {HIT_IOU} in bird's-eye view, of the first training."
    text = f"**{title}**\n\n{about} {_selection_rule(chosen)}\n"
    writer.section("figure_8", text, figure=detection_figure(chosen, found, grid), about=title)


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
    if not (file := pictures_of(plan).teacher):
        return
    teacher = load_detector(Path(file))
    if teacher.settings.role != "teacher":
        raise SettingsError(complaint(file, "settings.role", "teacher", teacher.settings.role))
    try:
        with_fusion(teacher, _FUSION)
    except CheckpointError as error:
        raise CheckpointError(f"{file}: {error}") from None


def _load(one: TrainedDetector) -> Detector:
    detector = open_detector(one.text, use=one.use)
    if not isinstance(detector, Detector):
        raise SettingsError(complaint(one.text, "detector", "a detector file", "another"))
    return detector
