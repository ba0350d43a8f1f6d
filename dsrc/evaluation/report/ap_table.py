"""Table of average precision for the terminal: a group of methods for each condition."""

import math
from collections.abc import Sequence

from dsrc.evaluation.metrics.ap import metric_name
from dsrc.evaluation.results import MCE, MEAN_AP, Row, condition_title, conditions_of, find_row, methods_of
from dsrc.tables.table import Cell, Column, Strong, Table, TableRow

_METRICS = {
    "BEV 0.3": metric_name("bev", 0.3),
    "BEV 0.5": metric_name("bev", 0.5),
    "BEV 0.7": metric_name("bev", 0.7),
    "3D 0.5": metric_name("3d", 0.5),
    "3D 0.7": metric_name("3d", 0.7),
    "*BEV 0.5": metric_name("bev", 0.5, opencood=True),
    "*BEV 0.7": metric_name("bev", 0.7, opencood=True),
}


def result_table(rows: Sequence[Row]) -> Table:
    """Table of average precision, the best of a condition in bold; with traffic where it was counted."""
    columns = [Column("method", align="left"), *map(Column, _METRICS), Column("ms")]
    through_channel = any(row.heard is not None for row in rows)
    if through_channel:
        columns += [Column("sent kB", digits=1), Column("age ms"), Column("heard %")]
    methods, lines = methods_of(rows), []
    for condition in [*conditions_of(rows), MEAN_AP, MCE]:
        group = [row for method in methods if (row := find_row(rows, method, condition))]
        for row in group:
            cells: list[Cell] = [row.method, *(_percent(row, group, name) for name in _METRICS.values())]
            times = _scaled(row.seconds_per_frame, 1e3)
            traffic = (row.bytes_per_frame, 1e-3), (row.message_age_s, 1e3), (row.heard, 1e2)
            cells += [times, *(_scaled(*one) for one in (traffic if through_channel else ()))]
            lines.append(TableRow(condition_title(condition), tuple(cells)))
    caption = "*BEV: sorted per frame, as OpenCOOD does. mCE: share of the clean AP lost, less is better."
    return Table("ap", "Average precision, %", "condition", tuple(columns), tuple(lines), caption=caption, grouped=True)


def _scaled(value: float | None, scale: float) -> float | None:
    return None if value is None else scale * value


def _percent(row: Row, group: Sequence[Row], name: str) -> str:
    """Number in percent, bold where it is the best of several."""
    value = row.metrics.get(name, math.nan)
    if math.isnan(value):
        return "-"
    others = [v for other in group if not math.isnan(v := other.metrics.get(name, math.nan))]
    best = min(others) if row.condition == MCE else max(others)
    text = f"{100 * value:.1f}"
    return Strong(text) if len(others) > 1 and value == best else text
