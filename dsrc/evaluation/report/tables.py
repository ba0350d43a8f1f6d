"""Tables of a benchmark: clean and corrupted frames, severities, visibility, and a swept quantity each."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from dsrc.evaluation.metrics.ap import metric_name
from dsrc.evaluation.metrics.robustness import mce, mean_ap
from dsrc.evaluation.report.choice import ABOUT, BESIDE_AP, choice_cells, sheet_columns
from dsrc.evaluation.report.dataset_results import NAMES, DatasetResults
from dsrc.evaluation.report.notes import bytes_note, sample_note
from dsrc.evaluation.results import CLEAN, Row, condition_title
from dsrc.evaluation.runner import VISIBILITY, BenchmarkResult
from dsrc.tables.table import Cell, Column, Stat, Table, TableRow
from sim.radio import IDEAL

AP_NOTE = "Average precision in bird's-eye view at IoU 0.5 / 0.7, %"
AP_CAPTION = "In a cell, from above: IoU 0.5, 0.7; %."
OPENCOOD_NAMES = (metric_name("bev", 0.5, opencood=True), metric_name("bev", 0.7, opencood=True))
ap_column = partial(Column, parts=("0.5", "0.7"), scale=100.0, digits=1, better="high")
"""Column of average precisions at two IoU thresholds."""


def table_1(results: DatasetResults, *, opencood: bool = False) -> Table:
    """Table of clean and corrupted frames, mCE and mean AP, and of the numbers by which one chooses.

    Args:
        opencood: detections sorted inside their frame only, as in the paper's tables.
    """
    names, kinds, methods = OPENCOOD_NAMES if opencood else NAMES, results.kinds(), list(results.trained)
    columns = [Column("Start", align="left", terminal=False)] if results.starts else []
    columns += [ap_column(condition_title(kind).capitalize()) for kind in (CLEAN, *kinds)]
    columns += [ap_column("mCE", better="low"), ap_column("mAP")]
    columns += [replace(column, terminal=False) for column in sheet_columns(BESIDE_AP)]
    rows = []
    for method in methods:
        clean = results.rows(method)
        cells: list[Cell] = [results.starts.get(method, "")] if results.starts else []
        cells += [results.ap(clean, names), *(results.ap(results.rows(method, kind), names) for kind in kinds)]
        cells += [results.summary(method, mce, names), results.summary(method, mean_ap, names)]
        cells += choice_cells(clean, BESIDE_AP)
        rows.append(TableRow(method, tuple(cells), results.mark(method)))
    order = (
        "detections sorted inside each frame, as OpenCOOD and the paper do" if opencood else "sorted over all frames"
    )
    about = (
        f"; {order}. {results.level} mCE: share of the clean AP lost, less is better; mAP: mean over clean and "
        f"corrupted frames. Of clean frames: {ABOUT}{bytes_note(results, methods)}"
    )
    name = "table_1_opencood" if opencood else "table_1"
    title = f"Clean and corrupted frames{', sorted inside frames' if opencood else ''}, {results.titled}"
    return ap_table(results, name, title, columns, rows, about)


def ap_table(
    results: DatasetResults,
    name: str,
    title: str,
    columns: Sequence[Column],
    rows: Sequence[TableRow],
    about: str,
    *,
    head: str = "Method",
    methods: Sequence[str] | None = None,
) -> Table:
    """Table of average precisions, its note with sample and trainings, and footnotes.

    Args:
        rows: from top to bottom.
        about: rest of the note's first sentence and what follows.
        methods: whose numbers they are; default: the labels.
    """
    methods = [row.label for row in rows] if methods is None else methods
    note = f"{AP_NOTE}{about}{sample_note(results, methods)}"
    footnotes = results.footnotes(methods)
    return Table(name, title, head, tuple(columns), tuple(rows), note, AP_CAPTION, footnotes)


@dataclass(frozen=True, slots=True)
class SweepAxis:
    """Swept quantity of a benchmark.

    Attributes:
        name: of the table.
        title: of the table.
        label: with its unit.
        values: in their order: text, and arguments of `DatasetResults.rows` that select the rows.
    """

    name: str
    title: str
    label: str
    values: tuple[tuple[str, dict[str, object]], ...]

    @property
    def places(self) -> list[float]:
        """Places of the values on the axis: of numbers the numbers, of names 0, 1, 2, ..."""
        numbers = [picks.get(self.name) for _, picks in self.values]
        return [float(x) if isinstance(x, int | float) else row for row, x in enumerate(numbers)]


def axes_of(result: BenchmarkResult) -> list[SweepAxis]:
    """Swept quantities of a benchmark."""
    plan, sweeps = result.plan, result.plan.sweeps
    still: dict[str, object] = {"channel": IDEAL}
    axes = [
        SweepAxis(
            "agents",
            "Number of agents",
            "agents, the ego included",
            tuple((str(n), {**still, "agents": n}) for n in sorted(sweeps.agents)),
        )
    ]
    for name, title, label, values in (
        ("pose_error", "Errors of the pose", "standard deviation of the pose error, m and degrees", sweeps.pose_error),
        ("delay_s", "Delay", "delay, s", sweeps.delay_s),
        ("loss", "Loss", "share of packets lost", sweeps.loss),
    ):
        shown = sorted({0.0, *values}) if values else []
        axes.append(SweepAxis(name, title, label, tuple((f"{v:g}", {**still, name: v}) for v in shown)))
    axes.append(SweepAxis("channels", "Channels", "channel", tuple((name, {"channel": name}) for name in plan.channel)))
    return [axis for axis in axes if len(axis.values) > 1]


def sweep_table(results: DatasetResults, axis: SweepAxis) -> Table:
    """Table of methods over the values of a swept quantity, in clean frames."""
    channels = axis.name == "channels"
    columns = [ap_column(text) for text, _ in axis.values]
    if channels:
        columns += [
            Column(f"{text}, kB / age ms / heard %", ("kB", "ms", "%"), terminal=False) for text, _ in axis.values
        ]
    rows = []
    for method in results.trained:
        found = [results.rows(method, **picks) for _, picks in axis.values]  # type: ignore[arg-type]
        cells = [results.ap(of_value) for of_value in found]
        if not all(math.isnan(cell[0].mean) for cell in cells[1:]):
            cells += [_air(of_value) for of_value in found] if channels else []
            rows.append(TableRow(method, tuple(cells), results.mark(method)))
    sent = bytes_note(results, [row.label for row in rows]) if channels else ""
    about = f", clean frames, over: {axis.label}.{sent}"
    return ap_table(results, axis.name, f"{axis.title}, {results.dataset}", columns, rows, about)


def _air(rows: Sequence[Row]) -> tuple[Stat, ...]:
    """Traffic: kB sent per frame, age of used messages, ms, and share of senders received, %."""
    return tuple(
        Stat.of([math.nan if (value := getattr(row, name)) is None else scale * value for row in rows])
        for name, scale in (("bytes_per_frame", 1e-3), ("message_age_s", 1e3), ("heard", 100.0))
    )


def visibility_table(results: DatasetResults) -> Table | None:
    """Table of AP by visibility of the boxes from the ego; None where it is unknown."""
    if not any(name.endswith("_hidden") for entry in results.entries for name in entry.row.metrics):
        return None
    columns = [ap_column(f"{name}, {low:.0%} to {min(high, 1.0):.0%}") for name, (low, high) in VISIBILITY.items()]
    rows = [
        TableRow(
            method,
            tuple(results.ap(results.rows(method), [f"{name}_{part}" for name in NAMES]) for part in VISIBILITY),
            results.mark(method),
        )
        for method in results.trained
    ]
    about = ", clean frames, of boxes by the share of the ego's rays on them that nothing else stops."
    return ap_table(results, "visibility", f"By what the ego sees, {results.dataset}", columns, rows, about)


def severity_table(results: DatasetResults, severities: Sequence[int]) -> Table:
    """Table of mean AP over the corruptions at each severity."""
    columns = [ap_column(CLEAN.capitalize()), *(ap_column(f"severity {level}") for level in severities)]
    rows = []
    for method in results.trained:
        cells = [results.ap(results.rows(method))]
        for level in severities:
            groups = [results.rows(method, kind, severity=level) for kind in results.kinds()]
            trainings = zip(*groups, strict=True)
            means = [[sum(row.metrics[name] for row in own) / len(own) for name in NAMES] for own in trainings if own]
            cells.append(tuple(Stat.of([pair[k] for pair in means]) for k in range(2)))
        rows.append(TableRow(method, tuple(cells), results.mark(method)))
    title = f"Severity, {results.titled}"
    return ap_table(results, "severity", title, columns, rows, ", mean of the corruptions.")
