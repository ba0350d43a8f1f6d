"""Tables of the numbers by which one chooses a detector and its threshold: in the terminal, and of a benchmark."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

from dsrc.evaluation.metrics.ap import metric_name
from dsrc.evaluation.report.dataset_results import DatasetResults
from dsrc.evaluation.report.notes import bytes_note, sample_note
from dsrc.evaluation.results import Row, condition_title, conditions_of, find_row, methods_of
from dsrc.tables.table import Cell, Column, Stat, Table, TableRow

ABOUT = (
    "At the score of best F1, bird's-eye overlap of 0.5. Helped: recall of objects on which only others than the ego "
    "have points. First sight: median over objects of the distance at which the object is first found, in the frames "
    "evaluated; 0 m for one that never is. ECE: expected calibration error, the mean gap of score and precision. "
    "kB: what all collaborators send for a frame. ms: median time of a detection."
)
_COLUMNS = {
    metric_name("bev", 0.5): Column("AP@0.5", unit="%", scale=100.0, digits=1, better="high"),
    metric_name("bev", 0.7): Column("AP@0.7", unit="%", scale=100.0, digits=1, better="high"),
    "best_score": Column("score", digits=2),
    "best_precision": Column("precision", unit="%", scale=100.0, digits=1, better="high"),
    "best_recall": Column("recall", unit="%", scale=100.0, digits=1, better="high"),
    "helped_recall": Column("helped", unit="%", scale=100.0, digits=1, better="high"),
    "first_sight_m": Column("first sight", unit="m", digits=1, better="high"),
    "false_boxes": Column("false per frame", digits=1, better="low"),
    "ece": Column("ECE", unit="%", scale=100.0, digits=1, better="low"),
    "bytes_per_frame": Column("kB / frame", scale=1e-3, digits=1),
    "seconds_per_frame": Column("ms / frame", scale=1e3),
}
"""Columns by the names of metrics, see `dsrc.evaluation.metrics.calibration.choice_metrics`, and of fields of a row."""
BESIDE_AP = ("helped_recall", "first_sight_m", "false_boxes", "ece", "bytes_per_frame", "seconds_per_frame")
"""Those that stand beside the average precision of a table of corruptions."""


def choice_table(rows: Sequence[Row]) -> Table:
    """Table of the numbers for the terminal, a group of methods for each condition."""
    columns = (Column("method", align="left"), *(replace(column, better="") for column in _COLUMNS.values()))
    methods, lines = methods_of(rows), []
    for condition in conditions_of(rows):
        for method in methods:
            if (row := find_row(rows, method, condition)) is not None:
                cells = [None if math.isnan(value := _value(row, name)) else value for name in _COLUMNS]
                lines.append(TableRow(condition_title(condition), (method, *cells)))
    return Table("choice", "Operating point", "condition", columns, tuple(lines), caption=ABOUT, grouped=True)


def choice_sheet(results: DatasetResults) -> Table:
    """Table of the numbers in clean frames, a row for each method of a benchmark."""
    methods = list(results.trained)
    lines = [TableRow(name, tuple(choice_cells(results.rows(name))), results.mark(name)) for name in methods]
    note = f"Clean frames. {ABOUT}{bytes_note(results, methods)}{sample_note(results, methods)}"
    title, footnotes = f"Operating point, {results.dataset}", results.footnotes(methods)
    return Table("choice", title, "Method", tuple(sheet_columns()), tuple(lines), note, ABOUT, footnotes)


def sheet_columns(names: Iterable[str] = tuple(_COLUMNS)) -> list[Column]:
    """Columns of statistics over trainings."""
    return [replace(_COLUMNS[name], parts=("",)) for name in names]


def choice_cells(rows: Sequence[Row], names: Iterable[str] = tuple(_COLUMNS)) -> list[Cell]:
    """Cells of `sheet_columns` over rows, one per training."""
    return [(Stat.of([_value(row, name) for row in rows]),) for name in names]


def _value(row: Row, name: str) -> float:
    """Number of a row, NaN where it is unknown."""
    value = row.metrics.get(name) if name not in ("bytes_per_frame", "seconds_per_frame") else getattr(row, name)
    return math.nan if value is None else value
