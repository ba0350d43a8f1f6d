"""What breaks a detector, `dsrc stress`: its average precision under every corruption, severity and group of agents.

Each group is a benchmark of its own in one folder of cells. The critical severity of a corruption is the least at which
the average precision falls below a share of the clean one. Intervals are of the paired bootstrap over frames, see
`dsrc.evaluation.metrics.intervals`: every condition is evaluated on the same resamples.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from msgspec.structs import replace
from numpy.typing import NDArray

from dsrc.data.drives import open_drives
from dsrc.detectors.levelled import height_in_use
from dsrc.detectors.texts import named
from dsrc.evaluation.cache import read_cell
from dsrc.evaluation.config import Benchmark, DatasetSpec, MethodSpec, check, check_messages, single_defence
from dsrc.evaluation.detect import MethodResult, join_results
from dsrc.evaluation.metrics.calibration import SURE, reliability, sure_counts, sure_errors
from dsrc.evaluation.metrics.intervals import (
    Interval,
    RankedDetections,
    draw_weights,
    percentile_interval,
    resampled_ap,
)
from dsrc.evaluation.report.report import provenance_of, stored_index
from dsrc.evaluation.results import CLEAN, condition_title
from dsrc.evaluation.runner import BenchmarkResult, CaseResult, fitting_kinds, run_plan
from dsrc.evaluation.stored import write_index
from dsrc.options.detection import Stressing
from dsrc.options.fields import takes_fields
from dsrc.runs.executors import SERIAL, Pool, Progress
from dsrc.tables.figure import WIDTH_IN, figure_style, panels, styles_of, write_figure
from dsrc.tables.files import csv_text, json_text
from dsrc.tables.junit import Case, Suite, junit_xml
from dsrc.tables.table import Column, Table, TableRow
from sensors.corruptions import Condition
from sim.errors import SettingsError, complaint
from sim.files import write_file

IOU = 0.5
"""Bird's-eye overlap at which a detection is right."""
QUICK_FRAMES, QUICK_SEVERITIES = 12, (1, 3, 5)
WORST = 10
_RESAMPLES = 400


@dataclass(frozen=True, slots=True)
class StressRow:
    """A condition.

    Attributes:
        corruption: kind, `clean`, or the text of faults.
        who: corrupted agents; "" of clean frames and faults.
        severity: 0 of clean frames and faults.
        ap: average precision at a bird's-eye IoU of 0.5; NaN without true boxes.
        low, high: its interval.
        false_per_frame: wrong detections of a score of at least 0.3.
        calibration_error: expected calibration error of the scores, mean distance of score and share of right
            detections in ten bins of equal width, weighted by their detections (C. Guo et al., ICML 2017).
        cells: keys of its cells.
    """

    corruption: str
    who: str
    severity: int
    ap: float
    low: float
    high: float
    false_per_frame: float
    calibration_error: float
    cells: tuple[str, ...] = field(repr=False)


@dataclass(frozen=True, slots=True)
class WorstFrame:
    """Frame in which a corruption does most harm.

    Attributes:
        drive: name of the drive.
        position: of the frame in it.
        corruption, who, severity: condition.
        lost: true boxes that are found in the clean frame and not in this one.
        made_up: further false boxes.
    """

    drive: str
    position: int
    corruption: str
    who: str
    severity: int
    lost: int
    made_up: int

    @property
    def harm(self) -> int:
        """Errors more than in the clean frame."""
        return self.lost + self.made_up


@dataclass(frozen=True, slots=True)
class Stress:
    """What a stress test has found.

    Attributes:
        name: of the detector.
        rows: clean first.
        worst: most harmful first.
        share: of the clean average precision, below which a severity is critical.
        made_by: provenance.
    """

    name: str
    rows: tuple[StressRow, ...]
    worst: tuple[WorstFrame, ...]
    share: float
    made_by: Mapping[str, Any]

    @property
    def clean(self) -> StressRow:
        """Row of the clean frames."""
        return self.rows[0]

    def curves(self) -> dict[tuple[str, str], list[StressRow]]:
        """Return the rows of each corruption and group of agents by severity, those that cost most first."""
        found: dict[tuple[str, str], list[StressRow]] = {}
        for row in self.rows[1:]:
            found.setdefault((row.corruption, row.who), []).append(row)
        return dict(sorted(found.items(), key=lambda item: float(np.mean([row.ap for row in item[1]]))))

    def critical(self, rows: Sequence[StressRow]) -> int | None:
        """Return the critical severity among rows; None where there is none."""
        return next((row.severity for row in rows if row.severity and row.ap < self.share * self.clean.ap), None)


@takes_fields(Stressing)
def stress(config: Stressing, pool: Pool = SERIAL, progress: Progress | None = None) -> Stress:
    """Evaluate a detector under all conditions, write tables, curves and the index of its detections; resume.

    Args:
        config: see `Stressing`, with `data`.
        pool: workers, of one thread each.
        progress: called with detections done and detections to do, for each group of agents anew.

    Raises:
        UserError: a file, a drive or a setting is wrong.
    """
    results = [run_plan(plan, config.out, pool, config.device, progress, config.engine) for plan in _plans(config)]
    entries = {entry.case.condition: entry for result in results for entry in result.entries}
    judged = [_Judged.of(entry, config.out / "cells") for entry in entries.values()]
    frames = judged[0].whole.matches.frames
    weights = draw_weights(np.arange(frames), _RESAMPLES, np.random.default_rng(config.seed))
    rows = tuple(_row(one, weights) for one in judged)
    found = Stress(results[0].plan.methods[0].name, rows, tuple(_worst(judged)), config.share, _made_by(results))
    _write(config.out, found, results)
    return found


def _plans(config: Stressing) -> list[Benchmark]:
    """Return a benchmark for each group of agents."""
    if config.data is None:
        raise SettingsError(complaint("stress", "data", "a drive, or a folder of drives", "none"))
    if not 0.0 < config.share < 1.0:
        raise SettingsError(complaint("stress", "share", "more than 0, less than 1", config.share))
    (name, text), *_ = named([str(config.detector)])
    use = height_in_use("stress", config.height)
    if config.messages is not None:
        check_messages(config.messages, "stress")
        use["messages"] = config.messages
    if single_defence(config.defence, "stress"):
        use["defence"] = config.defence
    groups = config.corrupted_agents
    drives = open_drives(config.data)
    if all(len(drive.agents) == 1 for drive in drives):
        groups = tuple(who for who in groups if who not in ("ego", "helpers")) or ("all",)  # they are all, or none
    fitting = fitting_kinds("stress", config.corruption, config.family, drives)
    plans: list[Benchmark] = []
    for who in groups:
        kinds = [kind for kind in fitting if _fits(kind, who)]
        plan = Benchmark(
            name="stress",
            methods=(MethodSpec(name=name, detectors=(text,), use=use),),
            datasets=(DatasetSpec(name=config.data.name or "data", drives=(str(config.data),)),),
            corruption=tuple(kinds) or (CLEAN,),
            severity=QUICK_SEVERITIES if config.quick and config.severity == (1, 2, 3, 4, 5) else config.severity,
            family=(config.family,),
            corrupted_agents=who,
            fault=() if plans else config.fault,
            frames=min(config.frames or QUICK_FRAMES, QUICK_FRAMES) if config.quick else config.frames,
            seed=config.seed,
        )
        check(plan, "stress")
        plans.append(plan)
    return plans


def _fits(kind: str, who: str) -> bool:
    """Whether a corruption can be of these agents alone: an error of pose is of helpers."""
    try:
        Condition.of(kind, 1, "physical", who).checked()
    except SettingsError:
        return who not in ("ego", "helpers")
    return True


@dataclass(frozen=True, slots=True)
class _Judged:
    """Result of a condition, and the drive of each of its frames."""

    entry: CaseResult
    whole: MethodResult
    drives: tuple[str, ...]

    @classmethod
    def of(cls, entry: CaseResult, folder: Path) -> "_Judged":
        parts = [read_cell(folder, key) for key in entry.cells]
        names = [drive.name for drive, part in zip(entry.drives, parts, strict=True) for _ in range(len(part.table))]
        return cls(entry, join_results(parts), tuple(names))

    def counts(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return (F,) true boxes that are found for sure, and false boxes."""
        return sure_counts(self.whole.matches)


def _row(one: _Judged, weights: NDArray[np.float32]) -> StressRow:
    entry, condition, matches = one.entry, one.entry.case.condition, one.whole.matches
    spread = resampled_ap(RankedDetections.of(matches, (IOU,)), weights)[0]
    interval: Interval = percentile_interval(spread, matches.frames)
    right = matches.matched["bev", IOU] >= 0
    level = condition.severity
    return StressRow(
        corruption=condition.kind,
        who=condition.agents_text if level else "",
        severity=level,
        ap=entry.row.metrics["ap_bev_50"],
        low=interval.low,
        high=interval.high,
        false_per_frame=sure_errors(matches)["false_per_frame"],
        calibration_error=reliability(matches.score, right).error,
        cells=entry.cells,
    )


def _worst(judged: Sequence[_Judged]) -> list[WorstFrame]:
    """Return the frames that lose most against the clean ones, each frame once, under what harms it most."""
    clean, *others = judged
    hits, false = clean.counts()
    found: dict[tuple[str, int], WorstFrame] = {}
    for one in others:
        condition, (own_hits, own_false) = one.entry.case.condition, one.counts()
        for row, (drive, position) in enumerate(zip(one.drives, one.whole.table.position.tolist(), strict=True)):
            lost, made_up = int(hits[row] - own_hits[row]), int(own_false[row] - false[row])
            words = condition.kind, condition.agents_text, condition.severity
            frame = WorstFrame(drive, position, *words, lost, made_up)
            if frame.harm > 0 and ((drive, position) not in found or frame.harm > found[drive, position].harm):
                found[drive, position] = frame
    return sorted(found.values(), key=lambda one: -one.harm)[:WORST]


def _made_by(results: Sequence[BenchmarkResult]) -> dict[str, Any]:
    made_by = provenance_of(results[0])
    made_by["settings"]["who"] = [result.plan.corrupted_agents for result in results]
    return made_by


def _write(out: Path, found: Stress, results: Sequence[BenchmarkResult]) -> None:
    """Write `results.json`, `stress.csv`, `stress.md`, `stress.png` and the index of the detections."""
    rows = [{name: value for name, value in asdict(row).items() if name != "cells"} for row in found.rows]
    # Without a detection there is no calibration, with one frame no interval: JSON has no NaN.
    known = [{name: None if value != value else value for name, value in row.items()} for row in rows]
    content = {"provenance": found.made_by, "rows": known, "worst": [asdict(one) for one in found.worst]}
    write_file(out / "results.json", json_text(content))  # the manifest first: what lies beside it is ours
    write_file(out / "stress.csv", csv_text(rows, made_by=found.made_by))
    write_file(out / "stress.md", stress_table(found).markdown() + "\n" + worst_table(found).markdown())
    indices = [stored_index(one, [(e, one.trained[e.case.method][0]) for e in one.entries]) for one in results]
    runs = {(run.kind, run.severity, run.who): run for index in indices for run in index.runs}
    write_index(out, replace(indices[0], runs=tuple(runs.values())))
    if any(row.severity for row in found.rows):
        write_figure(out / "stress.png", stress_curves(found), found.made_by)


def stress_table(found: Stress) -> Table:
    """Table of corruptions and groups of agents, the most harmful first."""
    curves, clean = found.curves(), found.clean
    levels = sorted({row.severity for row in found.rows if row.severity})
    columns = [Column("agents", align="left"), *(Column(f"severity {level}") for level in levels)]
    columns += [Column("worst, 95 %", align="left"), Column("critical"), Column("false boxes"), Column("ECE", digits=2)]
    lines = [
        TableRow(
            CLEAN,
            ("", *("-" for _ in levels), _span(clean), "", f"{clean.false_per_frame:.2f}", clean.calibration_error),
        )
    ]
    for (kind, who), rows in curves.items():
        by_level, worst = {row.severity: row for row in rows}, min(rows, key=lambda row: row.ap)
        aps = (f"{100 * by_level[level].ap:.1f}" if level in by_level else "-" for level in levels)
        critical = found.critical(rows)
        cells = (who, *aps, _span(worst), "-" if critical is None else str(critical))
        lines.append(TableRow(condition_title(kind), (*cells, f"{worst.false_per_frame:.2f}", worst.calibration_error)))
    caption = (
        f"AP at a bird's-eye IoU of {IOU:g}, %; worst: the least of the severities, its 95 % interval over frames, its "
        f"false boxes a frame (score at least {SURE:g}) and expected calibration error. Critical: the least severity "
        f"below {100 * found.share:g} % of the clean AP."
    )
    return Table("stress", f"What breaks {found.name}", "corruption", tuple(columns), tuple(lines), caption=caption)


def worst_table(found: Stress) -> Table:
    """Table of the worst frames."""
    columns = [Column("frame"), Column("corruption", align="left"), Column("agents", align="left")]
    columns += [Column("severity"), Column("lost"), Column("made up")]
    lines = [
        TableRow(one.drive, (str(one.position), condition_title(one.corruption), one.who, *_numbers(one)))
        for one in found.worst
    ]
    caption = f"Lost: true boxes found clean (score at least {SURE:g}) and not so. Positions in their drives."
    return Table("worst", "Worst frames", "drive", tuple(columns), tuple(lines), caption=caption)


def _numbers(one: WorstFrame) -> tuple[str, str, str]:
    return str(one.severity), str(one.lost), str(one.made_up)


def _span(row: StressRow) -> str:
    return f"{100 * row.ap:.1f} [{100 * row.low:.1f}, {100 * row.high:.1f}]"


def stress_curves(found: Stress) -> Figure:
    """Draw AP over severity, a panel for each corruption, a curve for each group of agents."""
    curves, columns = {key: rows for key, rows in found.curves().items() if rows[0].severity}, 3
    kinds = list(dict.fromkeys(kind for kind, _ in curves))
    styles = styles_of(list(dict.fromkeys(who for _, who in curves)))
    high = -(-len(kinds) // columns)
    with figure_style():
        title = f"What breaks {found.name}"
        figure, parts = panels(WIDTH_IN, 0.6 + 2.2 * high, rows=high, columns=columns, title=title)
        for axes in parts[len(kinds) :]:
            axes.set_axis_off()
        for axes, kind in zip(parts, kinds, strict=False):
            for (own, who), rows in curves.items():
                if own != kind:
                    continue
                listed = [found.clean, *sorted(rows, key=lambda row: row.severity)]
                places = [row.severity for row in listed]
                low, top = ([100 * getattr(row, end) for row in listed] for end in ("low", "high"))
                axes.fill_between(places, low, top, color=styles[who].color, alpha=0.15, linewidth=0)
                axes.plot(places, [100 * row.ap for row in listed], label=who, **styles[who].line())
            axes.axhline(100 * found.share * found.clean.ap, color="0.5", linewidth=0.8, linestyle=":")
            axes.set(title=condition_title(kind), ylim=(0, 100), xlabel="severity")
        parts[0].set_ylabel("AP@0.5, %")
        parts[0].legend(loc="lower left")
    return figure


def junit(found: Stress, fail_under: float | None) -> bytes:
    """Return JUnit's XML: a test case for each condition, failed where its AP lies below a bound.

    Args:
        fail_under: least AP, 0 to 1; None for no failures.
    """
    cases = []
    for row in found.rows:
        name = f"{row.corruption} {row.severity} {row.who}".strip() if row.severity else row.corruption
        failed = fail_under is not None and fails(row, fail_under)
        why = f"AP@{IOU:g} {row.ap:.4f} is below {fail_under:g}" if failed else ""
        cases.append(Case("dsrc.stress", name, "failure" if why else "passed", why, f"AP@{IOU:g} {_span(row)}"))
    name = f"dsrc stress {found.name}"
    return junit_xml(name, [Suite(name, tuple(cases))])


def fails(row: StressRow, fail_under: float | None) -> bool:
    """Whether a condition's average precision lies below a bound; an unknown one does."""
    return fail_under is not None and not row.ap >= fail_under
