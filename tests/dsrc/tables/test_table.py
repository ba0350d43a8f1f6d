"""Tables: every word and number is there, on a terminal of any width, in Markdown and in CSV."""

import csv
import io
import math

import pytest
from rich.console import Console

from dsrc.tables.table import Column, Stat, Strong, Table, TableRow


def printed(table: Table, width: int = 80, *, styles: bool = False) -> str:
    console = Console(width=width, record=True, file=io.StringIO(), force_terminal=styles)
    console.print(table)
    return console.export_text(styles=styles)


def mixed() -> Table:
    columns = (
        Column("kind", align="left"),
        Column("boxes"),
        Column("path", unit="m", digits=1),
        Column("AP", ("0.5", "0.7"), scale=100.0, digits=1, better="high"),
        Column("log", align="left", terminal=False),
    )
    rows = (
        TableRow("a|b", ("near", 1200, 3.25, (Stat(0.5, 0.01), Stat(0.4)), "x.npz"), "†"),
        TableRow("c", (Strong("far"), 7, math.nan, (Stat(0.25), Stat(0.4)), None)),
    )
    return Table("mixed", "Mixed", "drive", columns, rows, "A note.", "A caption.", ("† Marked.",))


def test_markdown_has_units_alignment_bold_and_what_stands_below() -> None:
    assert mixed().markdown().splitlines() == [
        *("**Mixed**", ""),
        "| drive | kind | boxes | path, m | AP | log |",
        "| --- | --- | ---: | ---: | ---: | --- |",
        "| a\\|b † | near | 1200 | 3.2 | **50.0 ± 1.0** / **40.0** | x.npz |",
        "| c | **far** | 7 | - | 25.0 / **40.0** |  |",
        *("", "† Marked.", "", "A note."),
    ]


def test_records_and_csv_hold_numbers_in_full_under_names_without_marks() -> None:
    near, far = mixed().records()
    assert near == {
        **{"drive": "a|b", "kind": "near", "boxes": 1200, "path": 3.25, "log": "x.npz"},
        **{"AP 0.5": 0.5, "AP 0.5 spread": 0.01, "AP 0.7": 0.4, "AP 0.7 spread": None},
    }
    assert far["path"] is None and far["log"] is None
    rows = list(csv.DictReader(io.StringIO(mixed().csv())))
    assert [row["path"] for row in rows] == ["3.25", ""] and rows[0]["AP 0.5"] == "0.5"


def test_a_terminal_has_the_caption_and_no_note_and_no_column_of_files() -> None:
    text = printed(mixed())
    assert "A caption." in text and "† Marked." in text
    assert "A note." not in text and "x.npz" not in text and "±" not in text
    assert str(mixed()).split() == text.split()
    assert "\x1b[1mfar" in printed(mixed(), styles=True)


def test_a_group_has_its_label_once_and_an_empty_table_none() -> None:
    rows = tuple(TableRow(label, (name, 1)) for label in ("clean", "fog") for name in ("ours", "theirs"))
    table = Table("groups", "", "condition", (Column("method", align="left"), Column("n")), rows, grouped=True)
    text = printed(table)
    assert text.split() == ["method", "n", "─" * 11, *"clean ours 1 theirs 1 fog ours 1 theirs 1".split()]
    assert table.markdown().count("| clean |") == 2
    assert Table("none", "", "", (), (), "Nothing.").markdown() == "Nothing.\n"


@pytest.mark.parametrize("columns", [1, 9, 20])
def test_nothing_of_a_table_is_lost_at_80_columns(columns: int) -> None:
    names = ("[plain]", "DSRC, a twentieth in 8 bits", "averyveryverylongnamewithoutanyspace")
    rows = tuple(
        TableRow(name, tuple((Stat(0.01 * c + 0.1 * i, 0.02), Stat(0.005 + 0.01 * c)) for c in range(columns)))
        for i, name in enumerate(names)
    )
    heads = [Column(f"Cross sensor{c}", ("0.5", "0.7"), scale=100.0, digits=1, better="high") for c in range(columns)]
    text = printed(Table("table_1", "Table 1", "Method", tuple(heads), rows))
    assert "…" not in text and max(map(len, text.splitlines())) <= 80
    words = text.split()
    for c in range(columns):
        assert f"sensor{c}" in words
        for i in range(len(names)):
            assert {f"{c + 10 * i:.1f}", f"{c + 0.5:.1f}"} <= set(words)
    assert "[plain]" in text and "twentieth" in text
    assert "averyveryverylongnamewithoutanyspace" in "".join(line.split(" ")[0] for line in text.splitlines())


def test_values_are_a_table_as_they_are() -> None:
    table = Table.of(("LiDAR", "maker", "beams", "Hz"), [("vlp-16", "Velodyne", 16, 10.0), ("os1", "", 64, 12.5)], 2)
    assert table.markdown().splitlines()[1:3] == ["| --- | --- | ---: | ---: |", "| vlp-16 | Velodyne | 16 | 10 |"]
    assert table.text(1000).splitlines()[2:] == ["vlp-16 Velodyne    16   10", "os1                64 12.5"]
