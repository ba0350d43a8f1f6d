"""Tables over a swept quantity: agents, pose errors, delay, loss, channels, severity, visibility."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from dsrc.evaluation.report.dataset_results import NAMES, DatasetResults, compared_methods
from dsrc.evaluation.report.notes import AP_NOTE, bytes_note, sample_note
from dsrc.evaluation.results import CLEAN, Row
from dsrc.evaluation.runner import VISIBILITY, BenchmarkResult
from dsrc.evaluation.table import Column, ResultTable, Stat, TableRow
from sim.radio import IDEAL


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
            "Figure 7. Number of agents",
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
    axes.append(
        SweepAxis("channels", "Channels", "channel", tuple((name, {"channel": name}) for name in plan.channels))
    )
    return [axis for axis in axes if len(axis.values) > 1]


def clean_tables(results: DatasetResults, axes: Sequence[SweepAxis]) -> list[ResultTable | str]:
    """Tables of clean frames, the same for all families."""
    return [visibility_table(results), *(sweep_table(results, axis) for axis in axes)]


def sweep_table(results: DatasetResults, axis: SweepAxis) -> ResultTable:
    """Table of methods over the values of a swept quantity, in clean frames."""
    columns = [Column(text) for text, _ in axis.values]
    if axis.name == "channels":
        columns += [Column(f"{text}, kB / age ms / heard %", ("kB", "ms", "%"), "", 1.0, 0) for text, _ in axis.values]
    lines, shown = [], []
    for method in results.settings:
        found = [results.rows(method, **picks) for _, picks in axis.values]  # type: ignore[arg-type]
        cells = [results.ap(rows) for rows in found]
        if all(math.isnan(cell[0].mean) for cell in cells[1:]):
            continue
        shown.append(method)
        cells += [_air(rows) for rows in found] if axis.name == "channels" else []
        lines.append(TableRow(method, tuple(cells), results.mark(method)))
    sent = bytes_note(results, shown) if axis.name == "channels" else ""
    note = f"{AP_NOTE}, clean frames, over: {axis.label}.{sent}{sample_note(results, shown)}"
    title, footnotes = f"{axis.title}, {results.dataset}", results.footnotes(shown)
    return ResultTable(axis.name, title, note, "Method", tuple(columns), tuple(lines), footnotes=footnotes)


def _air(rows: Sequence[Row]) -> tuple[Stat, ...]:
    """Traffic: kB sent per frame, age of used messages, ms, and share of senders received, %."""
    return tuple(
        Stat.of([math.nan if (value := getattr(row, name)) is None else scale * value for row in rows])
        for name, scale in (("bytes_per_frame", 1e-3), ("message_age_s", 1e3), ("heard", 100.0))
    )


def visibility_table(results: DatasetResults) -> ResultTable | str:
    """Table of AP by visibility of the boxes from the ego, or a text where it is unknown."""
    if not any(name.endswith("_hidden") for entry in results.entries for name in entry.row.metrics):
        return f"Visibility is left out: unknown in {results.dataset}."
    columns = [Column(f"{name}, {low:.0%} to {min(high, 1.0):.0%}") for name, (low, high) in VISIBILITY.items()]
    lines = [
        TableRow(
            method,
            tuple(results.ap(results.rows(method), [f"{name}_{part}" for name in NAMES]) for part in VISIBILITY),
            results.mark(method),
        )
        for method in compared_methods(results)
    ]
    note = (
        f"{AP_NOTE}, clean frames, of boxes by the share of the ego's rays on them that nothing else stops."
        f"{sample_note(results, compared_methods(results))}"
    )
    title, footnotes = f"By what the ego sees, {results.dataset}", results.footnotes(compared_methods(results))
    return ResultTable("visibility", title, note, "Method", tuple(columns), tuple(lines), footnotes=footnotes)


def severity_table(results: DatasetResults, severities: Sequence[int]) -> ResultTable:
    """Table of mean AP over the corruptions at each severity."""
    columns = [Column(CLEAN.capitalize()), *(Column(f"severity {level}") for level in severities)]
    lines = []
    for method in compared_methods(results):
        cells = [results.ap(results.rows(method))]
        for level in severities:
            groups = [results.rows(method, kind, severity=level) for kind in results.kinds()]
            trainings = zip(*groups, strict=True)
            means = [
                [sum(row.metrics[name] for row in rows) / len(rows) for name in NAMES] for rows in trainings if rows
            ]
            cells.append(tuple(Stat.of([pair[k] for pair in means]) for k in range(2)))
        lines.append(TableRow(method, tuple(cells), results.mark(method)))
    note = f"{AP_NOTE}, mean of the corruptions.{sample_note(results, compared_methods(results))}"
    title, footnotes = f"Severity, {results.titled}", results.footnotes(compared_methods(results))
    return ResultTable("severity", title, note, "Method", tuple(columns), tuple(lines), footnotes=footnotes)
