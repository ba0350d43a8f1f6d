"""Result tables: for the terminal, and as CSV and JSON files that say what made them."""

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

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
_FIELDS = ("method", "condition", "severity", "frames", "truth", "detections")
_CHANNEL_FIELDS = ("bytes_per_frame", "message_age_s", "heard")


def result_table(rows: Sequence[Row], title: str = "Average precision, %") -> Table:
    """Return the table for the terminal: conditions in groups, one line per method, the best of a group in bold."""
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
    """Return what was sent, in kB per frame, the mean age of it, in ms, and the share of senders heard, in percent."""
    scaled = zip((row.bytes_per_frame, row.message_age_s, row.heard), (1e-3, 1e3, 1e2), strict=True)
    sent, age, heard = ("" if value is None else f"{scale * value:.1f}" for value, scale in scaled)
    return sent, age.partition(".")[0], heard.partition(".")[0]


def _percent(row: Row, group: Sequence[Row], name: str) -> str:
    """Return one number in percent, bold when it is the best of several."""
    value = row.metrics.get(name, math.nan)
    if math.isnan(value):
        return "-"
    others = [v for other in group if not math.isnan(v := other.metrics.get(name, math.nan))]
    best = min(others) if row.condition == MCE else max(others)
    text = f"{100 * value:.1f}"
    return f"[bold]{text}[/bold]" if len(others) > 1 and value == best else text


def _fields(rows: Sequence[Row]) -> tuple[str, ...]:
    """Return the columns of a result; those of the channel where there was one."""
    return _FIELDS + (_CHANNEL_FIELDS if any(row.bytes_per_frame is not None for row in rows) else ())


def rows_to_csv(rows: Sequence[Row], made_by: Mapping[str, Any]) -> str:
    """Return CSV with one line per row; its first line is a comment (#) that holds the provenance as JSON."""
    names = list(dict.fromkeys(name for row in rows for name in row.metrics))
    text = io.StringIO()
    text.write(f"# {json.dumps(made_by, sort_keys=True, allow_nan=False)}\n")
    writer = csv.writer(text, lineterminator="\n")
    fields = _fields(rows)
    writer.writerow([*fields, *names])
    for row in rows:
        values = [row.metrics.get(name, math.nan) for name in names]
        writer.writerow(
            [*(getattr(row, f) for f in fields), *("" if math.isnan(v) else repr(float(v)) for v in values)]
        )
    return text.getvalue()


def rows_to_json(rows: Sequence[Row], made_by: Mapping[str, Any]) -> str:
    """Return JSON `{"provenance": ..., "rows": [...]}`; numbers that are undefined are null."""
    listed = [
        {f: getattr(row, f) for f in _fields(rows)}
        | {"metrics": {name: None if math.isnan(v) else float(v) for name, v in row.metrics.items()}}
        for row in rows
    ]
    return json.dumps({"provenance": dict(made_by), "rows": listed}, indent=1, sort_keys=True, allow_nan=False) + "\n"


def rows_from_json(path: Path) -> list[Row]:
    """Read the rows of a `results.json` back; undefined numbers are NaN, curves and times are gone."""
    rows = json.loads(path.read_text(encoding="utf-8"))["rows"]
    for row in rows:
        row["metrics"] = {name: math.nan if v is None else v for name, v in row["metrics"].items()}
    return [Row(**row) for row in rows]


def timings_to_csv(rows: Sequence[Row]) -> str:
    """Return CSV with the time per frame of each row that has one."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["method", "condition", "frames", "seconds_per_frame"])
    for row in rows:
        if row.seconds_per_frame is not None:
            writer.writerow([row.method, row.condition, row.frames, f"{row.seconds_per_frame:.6f}"])
    return text.getvalue()
