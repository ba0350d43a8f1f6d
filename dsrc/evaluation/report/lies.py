"""Table of attacks and defences in single frames: in the terminal, and of a benchmark."""

import math
from collections.abc import Sequence

from dsrc.evaluation.listener import lies
from dsrc.evaluation.metrics.ap import metric_name
from dsrc.evaluation.metrics.calibration import SURE
from dsrc.evaluation.results import CLEAN, Row, condition_title, conditions_of, find_row, methods_of
from dsrc.faults.condition import condition_of
from dsrc.messages.message import LIES
from dsrc.tables.table import Column, Table, TableRow

_ABOUT = (
    f"AP in bird's-eye view. Missed: of the true boxes those without a detection of a score of at least {SURE:g} and "
    "an overlap of 0.5; false boxes: such detections that hit none, in a frame. Attacks refused: of the false "
    "objects told those refused. Wrongly refused: of the messages without a lie, those of liars with nothing to remove "
    "among them, those of which an object was refused. Both are unknown where helpers tell no boxes. Sent: by all "
    "helpers for a frame."
)


def lie_table(rows: Sequence[Row], title: str = "Attacks and defences") -> Table | None:
    """Table of clean frames and attacks; None without attack or defence."""
    kinds = [kind for kind in conditions_of(rows) if kind == CLEAN or lies(condition_of(kind, 1, "physical", "all"))]
    if kinds == [CLEAN] and not any(LIES[0] in row.metrics for row in rows):
        return None
    columns = [Column("method", align="left"), Column("AP@0.5", unit="%"), Column("AP@0.7", unit="%")]
    columns += [Column("missed", unit="%"), Column("false boxes"), Column("attacks refused"), Column("wrongly refused")]
    columns += [Column("sent kB")] if any(row.bytes_per_frame for row in rows) else []
    lines = []
    for kind in kinds:
        for method in methods_of(rows):
            if (row := find_row(rows, method, kind)) is not None:
                cells = (method, *_numbers(row.metrics), f"{1e-3 * (row.bytes_per_frame or 0.0):.2f}")
                lines.append(TableRow(condition_title(kind), cells[: len(columns)]))
    return Table("lies", title, "attack", tuple(columns), tuple(lines), note=_ABOUT, caption=_ABOUT, grouped=True)


def _numbers(metrics: dict[str, float]) -> list[str]:
    """Return the numbers of a row, as columns have them."""
    told, caught, _, honest, wronged = (metrics.get(name, math.nan) for name in LIES)
    shares = (metrics[metric_name("bev", 0.5)], metrics[metric_name("bev", 0.7)], metrics["missed_share"])
    return [
        *(f"{100.0 * value:.1f}" for value in shares),
        f"{metrics['false_per_frame']:.2f}",
        _part(caught, told),
        _part(wronged, honest),
    ]


def _part(part: float, whole: float) -> str:
    return f"{100.0 * part / whole:.0f} % of {whole:.0f}" if whole > 0.0 else ""
