"""Runner of a benchmark: computes missing cells on any number of workers, and makes rows of cells.

An interrupted benchmark resumes, and a new method costs only its own cells.
"""

import hashlib
import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dsrc.data.drives import Drive, labelled_frames, list_drives, open_drive, traffic_runs
from dsrc.data.sample import DetectorSettings
from dsrc.detectors.open import close_detector, detector_sha256, open_detector
from dsrc.detectors.texts import kind_of
from dsrc.evaluation.cache import CellSettings, read_cell, read_settings
from dsrc.evaluation.cells import CellJob, make_cells
from dsrc.evaluation.config import Benchmark, Case, MethodSpec, cases_of, plan_conditions
from dsrc.evaluation.detect import MethodResult, frame_positions, join_results, warn_of_slow_drives
from dsrc.evaluation.metrics.ap import evaluate_matches, metric_name
from dsrc.evaluation.metrics.calibration import IOU, choice_metrics, sure_errors
from dsrc.evaluation.metrics.intervals import RankedDetections
from dsrc.evaluation.results import Row, make_row
from dsrc.messages.message import LIES, tells_boxes
from dsrc.models.fusion import FUSIONS
from dsrc.models.settings import fusion_of
from dsrc.models.storage.checkpoint import read_meta
from dsrc.options.detection import Device
from dsrc.runs.executors import SERIAL, Pool, Progress
from dsrc.runs.lock import locked
from dsrc.runs.study import Study, reuse_entry
from sensors.corruptions import CLEAN, Condition, Family, conditions_of, corruption_kinds, drive_seed
from sim.errors import DataError, SettingsError, UserError, complaint
from sim.kept.code_hash import code_hash, versions_with

_log = logging.getLogger(__name__)

CHUNK = 50
"""Frames of a unit of work, the most that an interruption loses."""

VISIBILITY = {"hidden": (0.0, 0.1), "partly": (0.1, 0.6), "open": (0.6, 1.01)}
"""Classes of true boxes by visibility from the ego: the share of its rays on a box that nothing else stops.

A box so far away that no ray reaches it even in free view is hidden."""

CELLS: Study[CellJob, MethodResult] = Study(
    task=make_cells,
    alike=lambda job: (job.drive, job.settings.positions, job.condition),
    steps=lambda job: len(job.settings.positions),
    endings=(".seconds", ".npz"),
    read=read_cell,
    settings=lambda job: job.settings,
    stored=read_settings,
)


@dataclass(frozen=True, slots=True)
class TrainedDetector:
    """Detector of a method, one training of it.

    Attributes:
        text: as `open_detector` takes it.
        sha256: see `detector_sha256`.
        settings: of the detector, as used.
        seed: of the training; None where the file has none.
        use: changed settings, see `MethodSpec`.
        recipe: of the training; "" where the file has none.
        agents: most agents that take part, see `MethodSpec`.
    """

    text: str
    sha256: str
    settings: DetectorSettings
    seed: int | None
    use: dict[str, bool | int | float | str]
    recipe: str = ""
    agents: int | None = None

    @property
    def name(self) -> str:
        """Name of the file, or the text of a detector that is none."""
        return Path(self.text).name if kind_of(self.text) in ("file", "onnx") else self.text

    @property
    def fusion(self) -> str:
        """Fusion method; that of a detector of one's own is `early`, since it gets clouds."""
        return fusion_of(self.settings)

    @property
    def most_agents(self) -> int:
        """Most agents whose data it uses."""
        return 1 if self.fusion == "none" else self.settings.request.max_agents


@dataclass(frozen=True, slots=True)
class CaseResult:
    """Result of one case.

    Attributes:
        case: method, training, dataset, condition and channel.
        row: the numbers.
        cells: keys of its cells.
        drives: path of the drive of each cell.
        ranked: detections of a method in differences, where nothing is swept; else None.
    """

    case: Case
    row: Row
    cells: tuple[str, ...]
    drives: tuple[Path, ...] = field(compare=False)
    ranked: RankedDetections | None = field(default=None, compare=False, repr=False)

    @property
    def digest(self) -> str:
        """Hash of the cells' keys, and so of all settings of the row."""
        return hashlib.sha256("".join(self.cells).encode()).hexdigest()[:32]


@dataclass(frozen=True, slots=True)
class BenchmarkResult:
    """Results of a benchmark.

    Attributes:
        plan: the benchmark.
        trained: detectors by method.
        drives: hashes of drives, by dataset and name.
        frames: evaluated frames of each drive, by dataset.
        runs: number of the run of traffic of each drive, by dataset, see `dsrc.data.drives.traffic_runs`.
        entries: results of all cases.
        made: number of cells computed in this run.
        engine: execution of the networks.
        reused: entry of its provenance on cells of earlier code, see `dsrc.runs.study.reuse_entry`.
    """

    plan: Benchmark
    trained: dict[str, list[TrainedDetector]]
    drives: dict[str, dict[str, str]]
    frames: dict[str, tuple[int, ...]]
    runs: dict[str, tuple[int, ...]]
    entries: list[CaseResult]
    made: int
    engine: str = "fused"
    reused: Mapping[str, Any] = field(default_factory=dict)


def run_plan(
    plan: Benchmark,
    out: Path,
    pool: Pool = SERIAL,
    device: Device = "cpu",
    progress: Progress | None = None,
    engine: str = "fused",
    reuse: Iterable[Path] = (),
    judged: bool = True,
) -> BenchmarkResult:
    """Compute the cells missing in `out/cells`, and the rows of all cases.

    Args:
        plan: a valid benchmark, see `dsrc.evaluation.config.check`.
        pool: workers, of one thread each; the cells are the same for any.
        progress: called with detections done and detections missing at the start.
        engine: execution of the networks, one of `dsrc.models.storage.deploy.ENGINES`.
        reuse: folders of earlier results: cells whose settings agree in all but code and versions are taken from them.
        judged: False takes frames without ground truth too.

    Raises:
        UserError: a file, a drive or a setting is wrong, or a sweep lacks what a corruption needs; of a drive that is
            damaged further on, all cells that can be computed are there.
    """
    check_device(plan.name, device)
    trained = {m.name: [_trained(text, m, engine) for text in m.detectors] for m in plan.methods}
    for name, several in trained.items():
        for other in several[1:]:
            if other.settings != several[0].settings:
                raise SettingsError(
                    complaint(other.text, "settings", f"those of {several[0].text}, which is '{name}' too", "others")
                )
    _check_judged_alike(plan, trained)
    datasets = {d.name: [r for folder in d.drives for r in _readers(folder)] for d in plan.datasets}
    positions = {name: frame_positions(readers, plan.frames, judged) for name, readers in datasets.items()}
    drives = {name: {str(r.drive): r.digest() for r in readers} for name, readers in datasets.items()}
    conditions = plan_conditions(plan)
    for name, readers in datasets.items():
        for error in _refusals(readers, positions[name], conditions, plan.seed).values():
            raise error
    cases = cases_of(plan)
    cells = _CellPlanner(plan, device, engine, trained, datasets, positions, drives)
    folder = out / "cells"
    with locked(out, what="benchmark"):
        planned = [cells.of_case(case) for case in cases]
        jobs = {job.settings.key: job for own in planned for job in own}
        if any(job.channel is not None and job.channel.medium != "perfect" for job in jobs.values()):
            warn_of_slow_drives([reader for readers in datasets.values() for reader in readers])
        made = CELLS.run(folder, jobs, pool, progress, reuse)
        ranked = {name for pair in plan.differences for name in (pair.method, pair.baseline)}
        entries = [
            _case_result(case, folder, own, case.method in ranked and not case.swept)
            for case, own in zip(cases, planned, strict=True)
        ]
    named = {name: {Path(p).name: digest for p, digest in listed.items()} for name, listed in drives.items()}
    frames = {name: tuple(map(len, of_drives)) for name, of_drives in positions.items()}
    runs = {name: traffic_runs(readers) for name, readers in datasets.items()}
    return BenchmarkResult(plan, trained, named, frames, runs, entries, made, engine, reuse_entry(folder, jobs))


def fitting_kinds(where: str, names: Sequence[str], family: Family, drives: Sequence[Drive]) -> tuple[str, ...]:
    """Return kinds of corruption by name, without those of a group that the drives' sweeps refuse, which are logged.

    Args:
        where: begins the messages.
        names: see `corruption_kinds`; a kind that is named itself stays, and `run_plan` refuses it.
    """
    kinds = corruption_kinds(names, family, where)
    refused = _refusals(drives, list(map(labelled_frames, drives)), conditions_of(kinds, (1,), (family,)), 0)
    left_out = [one.kind for one in refused if one.kind not in names]
    if left_out:
        _log.warning(
            "%s: leaves out %s, which the sweeps do not take: %s",
            where,
            ", ".join(left_out),
            next(iter(refused.values())),
        )
    return tuple(kind for kind in kinds if kind not in left_out)


def _refusals(
    drives: Sequence[Drive], positions: Sequence[Sequence[int]], conditions: Iterable[Condition], seed: int
) -> dict[Condition, DataError]:
    """Return the conditions that the first frame refuses, such as missing beams of clouds without rings, and why.

    Each kind is tried once; a frame that cannot be read is told where it is evaluated.
    """
    drive, first = next(((drive, own[0]) for drive, own in zip(drives, positions, strict=True) if own), (None, 0))
    kinds = {(one.kind, one.family): one for one in conditions if one.kind != CLEAN}
    if drive is None or not kinds:
        return {}
    try:
        frame = drive.read(first)
    except UserError:
        return {}
    refused = {}
    for condition in kinds.values():
        try:
            condition.apply(frame, drive_seed(seed, drive.drive.name))
        except DataError as error:
            refused[condition] = DataError(f"{drive.drive}: {error}")
    return refused


def check_device(what: str, device: Device) -> None:
    """Check that a device is there.

    Raises:
        SettingsError: it is not.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise SettingsError(complaint(what, "device", "a GPU that torch can use", "none", "; use cpu"))


def _trained(text: str, method: MethodSpec, engine: str) -> TrainedDetector:
    detector = open_detector(text, engine=engine, use=method.use)
    for name in {"defence", "messages"} & method.use.keys():
        if not tells_boxes(detector):
            expected = "a detector whose agents tell boxes, as with messages of boxes and recorded heights"
            hint = "" if "messages" in method.use else '; add --messages boxes, in a plan messages = "boxes"'
            raise SettingsError(complaint(text, name, expected, method.use[name], hint))
    sha256, settings = detector_sha256(text, detector), detector.settings
    close_detector(detector)
    meta = read_meta(Path(text)) if kind_of(text) == "file" else {}
    seed, recipe = meta.get("seed"), meta.get("settings")
    for name in ("recipe", "name"):
        recipe = recipe.get(name) if isinstance(recipe, Mapping) else None
    seed, recipe = seed if isinstance(seed, int) else None, recipe if isinstance(recipe, str) else ""
    return TrainedDetector(text, sha256, settings, seed, method.use, recipe, method.agents)


def _check_judged_alike(plan: Benchmark, trained: Mapping[str, Sequence[TrainedDetector]]) -> None:
    """Check that both methods of a difference are judged on the same boxes."""
    for pair in plan.differences:
        found, wanted = trained[pair.method][0], trained[pair.baseline][0]
        own, other = found.settings.request, wanted.settings.request
        fields = ("users", "comm_range_m", "max_agents", "team_by", "keep_ego_box")
        ranges = ("range", own.judged_m, other.judged_m)
        for name, mine, theirs in (ranges, *((name, getattr(own, name), getattr(other, name)) for name in fields)):
            if mine != theirs:
                expected = f"{theirs}, as its baseline '{pair.baseline}' has, for a difference on the same boxes"
                raise SettingsError(complaint(found.text, name, expected, str(mine)))


def _readers(folder: str) -> list[Drive]:
    return [open_drive(drive) for drive in list_drives(Path(folder))]


@dataclass(frozen=True, slots=True)
class _CellPlanner:
    """Cells of the cases of a benchmark.

    Attributes:
        plan: the benchmark.
        device: of the networks.
        engine: execution of the networks.
        trained: detectors by method.
        datasets: drives by dataset.
        positions: frames of each drive, by dataset.
        drives: hashes of drives, by dataset and path.
    """

    plan: Benchmark
    device: Device
    engine: str
    trained: Mapping[str, Sequence[TrainedDetector]]
    datasets: Mapping[str, Sequence[Drive]]
    positions: Mapping[str, Sequence[Sequence[int]]]
    drives: Mapping[str, Mapping[str, str]]

    def of_case(self, case: Case) -> list[CellJob]:
        """Return the cells of a case, drive by drive, at most `CHUNK` frames each."""
        one = self.trained[case.method][case.training]
        most = one.most_agents
        agents = min(most, *(limit for limit in (case.agents, one.agents, most) if limit is not None))
        # The ego alone gets no message: the same through every channel.
        channel = case.spec() if agents > 1 else None
        condition, listed = case.condition.decisive(), None if channel is None else channel.decisive()
        planned = []
        for reader, positions in zip(self.datasets[case.dataset], self.positions[case.dataset], strict=True):
            for start in range(0, len(positions), CHUNK):
                chunk = tuple(positions[start : start + CHUNK])
                settings = CellSettings(
                    detector=one.sha256,
                    use=one.use,
                    drive=reader.drive.name,
                    data=self.drives[case.dataset][str(reader.drive)],
                    positions=chunk,
                    seed=self.plan.seed,
                    agents=agents,
                    device=self.device,
                    engine=self.engine,
                    versions=versions_with(make_cells.__module__, FUSIONS[one.fusion]),
                    code=code_hash(make_cells.__module__),
                    condition=condition,
                    channel=listed,
                )
                limit = None if agents == one.settings.request.max_agents else agents
                planned.append(CellJob(settings, one.text, reader.drive, case.condition, limit, channel))
        return planned


def _case_result(case: Case, folder: Path, cells: Sequence[CellJob], keep_detections: bool) -> CaseResult:
    keys = [job.settings.key for job in cells]
    parts = [read_cell(folder, key) for key in keys]
    result = join_results(parts)
    whole = evaluate_matches(result.matches)
    row = make_row(
        case.method,
        case.condition.kind,
        case.condition.severity,
        whole,
        result.seconds,
        result.traffic,
    )
    # The ego alone was sent nothing.
    sent = 0.0 if row.bytes_per_frame is None else row.bytes_per_frame
    drives = list(dict.fromkeys(job.drive for job in cells))
    drive = np.repeat([drives.index(job.drive) for job in cells], [len(part.table) for part in parts])
    table = result.table
    distance_m = np.hypot(*table.truth[:, :2].T)
    choice = choice_metrics(whole.curves[IOU], result.matches, table.points, table.objects(drive), distance_m)
    metrics = {**row.metrics, **by_visibility(result), **choice, **sure_errors(result.matches)}
    if result.told is not None:
        metrics |= dict(zip(LIES, result.told.sum(axis=0).tolist(), strict=True))
    row = replace(row, metrics=metrics, bytes_per_frame=sent, result=None)
    ranked = RankedDetections.of(result.matches) if keep_detections else None
    return CaseResult(case, row, tuple(keys), tuple(job.drive for job in cells), ranked)


def by_visibility(result: MethodResult) -> dict[str, float]:
    """Return the average precision of each class of `VISIBILITY`; empty where visibility is unknown."""
    if not np.isfinite(result.table.ego_share).any():
        return {}
    share = np.nan_to_num(result.table.ego_share, nan=0.0)
    named = {}
    for name, (low, high) in VISIBILITY.items():
        of_class = evaluate_matches(result.matches, (share >= low) & (share < high))
        for threshold in (0.5, 0.7):
            named[f"{metric_name('bev', threshold)}_{name}"] = of_class.curves["bev", threshold].ap
    return named
