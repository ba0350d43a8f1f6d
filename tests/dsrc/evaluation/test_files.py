import csv
import io
import json
import math

import pytest
from rich.console import Console

from dsrc.evaluation.files import result_table, rows_from_json, rows_to_csv, rows_to_json, timings_to_csv
from dsrc.evaluation.results import MCE, Row, conditions_of, find_row, methods_of, summary_rows
from sim.files import write_file

MADE_BY = {"seed": 3, "settings": {"severity": 3}, "versions": {"numpy": "2"}}


def some_rows():
    rows = []
    for condition, ap in (("clean", 0.8), ("fog", 0.6), ("beam_missing", math.nan)):
        for method, factor in (("dsrc", 1.0), ("plain", 0.9)):
            metrics = {"ap_bev_50": ap * factor, "ap_bev_70": 0.5 * ap * factor}
            rows.append(Row(method, condition, 0 if condition == "clean" else 3, 10, 40, 35, metrics, 0.012))
    return rows


def test_csv_says_what_made_it_and_reads_back():
    comment, text = rows_to_csv(some_rows(), MADE_BY).split("\n", 1)
    assert json.loads(comment.removeprefix("# ")) == MADE_BY
    lines = list(csv.DictReader(io.StringIO(text)))
    assert len(lines) == 6
    assert float(lines[1]["ap_bev_50"]) == 0.8 * 0.9
    assert lines[4]["ap_bev_50"] == ""
    assert "seconds" not in text


def test_json_says_what_made_it_and_reads_back(tmp_path):
    path = tmp_path / "results.json"
    write_file(path, rows_to_json(some_rows(), MADE_BY))
    assert json.loads(path.read_text())["provenance"] == MADE_BY
    back = rows_from_json(path)
    assert back[:4] == some_rows()[:4]
    assert math.isnan(back[4].metrics["ap_bev_50"])
    assert [p.name for p in tmp_path.iterdir()] == ["results.json"]


def test_times_have_their_own_file():
    lines = timings_to_csv([*some_rows(), *summary_rows(some_rows())]).splitlines()
    assert lines[0] == "method,condition,frames,seconds_per_frame"
    assert lines[1] == "dsrc,clean,10,0.012000"
    assert len(lines) == 7


def test_the_terminal_table_fits_80_columns_and_names_everything():
    rows = [row for row in some_rows() if row.condition != "beam_missing"]
    rows += summary_rows(rows)
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(result_table(rows))
    text = console.export_text()
    for word in ("clean", "fog", "mean AP", "mCE", "dsrc", "plain", "80.0", "25.0", "12"):
        assert word in text


def test_the_smallest_mce_is_the_best():
    rows = [
        Row("steady", MCE, 0, 1, 1, 0, {"ap_bev_50": 0.1}),
        Row("shaky", MCE, 0, 1, 1, 0, {"ap_bev_50": 0.3}),
    ]
    console = Console(width=80, record=True, file=io.StringIO(), force_terminal=True)
    console.print(result_table(rows))
    styled = console.export_text(styles=True)
    assert "\x1b[1m10.0" in styled
    assert "\x1b[1m30.0" not in styled


def test_rows_are_found_by_method_and_condition():
    rows = some_rows()
    assert methods_of(rows) == ["dsrc", "plain"]
    assert conditions_of([*rows, *summary_rows(rows)]) == ["clean", "fog", "beam_missing"]
    assert find_row(rows, "plain", "fog").metrics["ap_bev_50"] == pytest.approx(0.54)
    assert find_row(rows, "plain", "hail") is None


def test_without_corruptions_or_without_clean_there_is_no_summary():
    rows = some_rows()
    assert summary_rows([r for r in rows if r.condition == "clean"]) == []
    assert summary_rows([r for r in rows if r.condition == "fog"]) == []
