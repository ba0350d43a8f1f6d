"""Tables of the numbers by which one chooses a detector and its threshold: in the terminal, and of a benchmark."""

import math
from collections.abc import Sequence
from dataclasses import replace

from dsrc.evaluation.report.dataset_results import DatasetResults
from dsrc.evaluation.report.tables import sample_note
from dsrc.evaluation.results import Row, condition_title, conditions_of, find_row, methods_of
from dsrc.tables.table import Column, Stat, Table, TableRow

_ABOUT = (
    "At the score of best F1, bird's-eye overlap of 0.5. Helped: recall of objects on which only others than the ego "
    "have points. "
    "ECE: expected calibration error, the mean gap of score and precision."
)
_COLUMNS = {
    "best_score": Column("score", digits=2),
    "best_recall": Column("recall", unit="%", scale=100.0, digits=1, better="high"),
    "helped_recall": Column("helped", unit="%", scale=100.0, digits=1, better="high"),
    "best_precision": Column("precision", unit="%", scale=100.0, digits=1, better="high"),
    "false_boxes": Column("false per frame", digits=1, better="low"),
    "ece": Column("ECE", unit="%", scale=100.0, digits=1, better="low"),
}
"""Columns by the names of `dsrc.evaluation.metrics.calibration.choice_metrics`."""


def choice_table(rows: Sequence[Row]) -> Table:
    """Table of operating point and calibration for the terminal, a group of methods for each condition."""
    columns = (Column("method", align="left"), *(replace(column, better="") for column in _COLUMNS.values()))
    methods, lines = methods_of(rows), []
    for condition in conditions_of(rows):
        for method in methods:
            if (row := find_row(rows, method, condition)) is not None:
                cells = [_number(row.metrics.get(name, math.nan)) for name in _COLUMNS]
                lines.append(TableRow(condition_title(condition), (method, *cells)))
    return Table("choice", "Operating point", "condition", columns, tuple(lines), caption=_ABOUT, grouped=True)


def choice_sheet(results: DatasetResults) -> Table:
    """Table of operating point and calibration in clean frames, a row for each method of a benchmark."""
    columns = tuple(replace(column, parts=("",)) for column in _COLUMNS.values())
    lines = []
    for method in results.trained:
        rows = results.rows(method)
        cells = tuple((Stat.of([row.metrics.get(name, math.nan) for row in rows]),) for name in _COLUMNS)
        lines.append(TableRow(method, cells, results.mark(method)))
    methods = list(results.trained)
    note, footnotes = f"Clean frames. {_ABOUT}{sample_note(results, methods)}", results.footnotes(methods)
    title = f"Operating point, {results.dataset}"
    return Table("choice", title, "Method", columns, tuple(lines), note, _ABOUT, footnotes)


def _number(value: float) -> float | None:
    return None if math.isnan(value) else value
