import io
import math
from dataclasses import replace

import pytest
from rich.console import Console

from dsrc.evaluation.report.ap_table import result_table
from dsrc.evaluation.report.choice import choice_table
from dsrc.evaluation.results import MCE, Row, conditions_of, find_row, methods_of, summary_rows


def some_rows() -> list[Row]:
    rows = []
    for condition, ap in (("clean", 0.8), ("fog", 0.6), ("beam_missing", math.nan)):
        for method, factor in (("dsrc", 1.0), ("plain", 0.9)):
            metrics = {"ap_bev_50": ap * factor, "ap_bev_70": 0.5 * ap * factor}
            rows.append(Row(method, condition, 0 if condition == "clean" else 3, 10, 40, 35, metrics, 0.012))
    return rows


def test_the_terminal_table_fits_80_columns_and_names_everything() -> None:
    rows = [row for row in some_rows() if row.condition != "beam_missing"]
    rows += summary_rows(rows)
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(result_table(rows))
    text = console.export_text()
    for word in ("clean", "fog", "mean AP", "mCE", "dsrc", "plain", "80.0", "25.0", "12"):
        assert word in text


def test_the_smallest_mce_is_the_best() -> None:
    rows = [
        Row("steady", MCE, 0, 1, 1, 0, {"ap_bev_50": 0.1}),
        Row("shaky", MCE, 0, 1, 1, 0, {"ap_bev_50": 0.3}),
    ]
    console = Console(width=80, record=True, file=io.StringIO(), force_terminal=True)
    console.print(result_table(rows))
    styled = console.export_text(styles=True)
    assert "\x1b[1m10.0" in styled
    assert "\x1b[1m30.0" not in styled


def test_rows_are_found_by_method_and_condition() -> None:
    rows = some_rows()
    assert methods_of(rows) == ["dsrc", "plain"]
    assert conditions_of([*rows, *summary_rows(rows)]) == ["clean", "fog", "beam_missing"]
    assert find_row(rows, "plain", "fog").metrics["ap_bev_50"] == pytest.approx(0.54)
    assert find_row(rows, "plain", "hail") is None


def test_without_corruptions_or_without_clean_there_is_no_summary() -> None:
    rows = some_rows()
    assert summary_rows([r for r in rows if r.condition == "clean"]) == []
    assert summary_rows([r for r in rows if r.condition == "fog"]) == []


def test_the_table_of_operating_points_shows_shares_in_percent_and_fits_80_columns() -> None:
    numbers = {"best_score": 0.25, "best_recall": 0.923, "helped_recall": math.nan, "false_boxes": 1.6, "ece": 0.264}
    metrics = {"ap_bev_50": 0.8, **numbers, "first_sight_m": 31.25}
    rows = [Row("a detector", "clean", 0, 10, 40, 35, metrics, 0.012, 1500.0)]
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(choice_table([*rows, *summary_rows(rows)]))
    text = console.export_text()
    first, second = (line.split()[2:] for line in text.splitlines() if "a detector" in line)
    assert [*first, *second] == ["80.0", "0.25", "92.3", "31.2", "1.6", "26.4", "1.5", "12"]


def test_corruption_errors_are_of_average_precisions_alone() -> None:
    rows = some_rows()
    rows = [replace(row, metrics={**row.metrics, "ece": 0.2}) for row in rows]
    assert all("ece" not in row.metrics for row in summary_rows(rows))
