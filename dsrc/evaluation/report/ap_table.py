"""Table of average precision for the terminal: conditions in groups, a line per method."""

import math
from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.table import Table

from dsrc.evaluation.metrics.ap import metric_name
from dsrc.evaluation.results import MCE, MEAN_AP, Row, condition_title, conditions_of, find_row, methods_of

_COLUMNS = (
    ("BEV\n0.3", metric_name("bev", 0.3)),
    ("\n0.5", metric_name("bev", 0.5)),
    ("\n0.7", metric_name("bev", 0.7)),
    ("3D\n0.5", metric_name("3d", 0.5)),
    ("\n0.7", metric_name("3d", 0.7)),
    ("*BEV\n0.5", metric_name("bev", 0.5, opencood=True)),
    ("\n0.7", metric_name("bev", 0.7, opencood=True)),
)


def result_table(rows: Sequence[Row], title: str = "Average precision, %") -> Table:
    """Table of average precision, the best of a condition in bold; with traffic where it was counted."""
    table = Table(
        title=title, title_justify="left", header_style="bold", pad_edge=False, box=SIMPLE_HEAD, padding=(0, 0)
    )
    table.add_column("condition", no_wrap=True)
    table.add_column("method")
    for header, _ in _COLUMNS:
        table.add_column(header, justify="right", no_wrap=True)
    table.add_column("ms", justify="right", no_wrap=True)
    through_channel = any(row.bytes_per_frame is not None for row in rows)
    if through_channel:
        for header in ("sent\nkB", "age\nms", "heard\n%"):
            table.add_column(header, justify="right", no_wrap=True)
    methods = methods_of(rows)
    for condition in [*conditions_of(rows), MEAN_AP, MCE]:
        group = [row for method in methods if (row := find_row(rows, method, condition))]
        for i, row in enumerate(group):
            time_ms = "" if row.seconds_per_frame is None else f"{1000 * row.seconds_per_frame:.0f}"
            cells = [_percent(row, group, name) for _, name in _COLUMNS]
            first = condition_title(condition) if i == 0 else ""
            cells += [time_ms, *(_channel_cells(row) if through_channel else ())]
            table.add_row(first, row.method, *cells, end_section=i == len(group) - 1)
    table.caption = "*BEV: sorted per frame, as OpenCOOD does. mCE: share of the clean AP lost, less is better."
    table.caption_justify = "left"
    return table


def _channel_cells(row: Row) -> tuple[str, str, str]:
    """Bytes sent, kB per frame, mean age of messages, ms, and share of senders received, %."""
    scaled = zip((row.bytes_per_frame, row.message_age_s, row.heard), (1e-3, 1e3, 1e2), strict=True)
    sent, age, heard = ("" if value is None else f"{scale * value:.1f}" for value, scale in scaled)
    return sent, age.partition(".")[0], heard.partition(".")[0]


def _percent(row: Row, group: Sequence[Row], name: str) -> str:
    """Number in percent, bold where it is the best of several."""
    value = row.metrics.get(name, math.nan)
    if math.isnan(value):
        return "-"
    others = [v for other in group if not math.isnan(v := other.metrics.get(name, math.nan))]
    best = min(others) if row.condition == MCE else max(others)
    text = f"{100 * value:.1f}"
    return f"[bold]{text}[/bold]" if len(others) > 1 and value == best else text
