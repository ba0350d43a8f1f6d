"""Tables on a terminal: every word and number is there for any number of columns and length of names."""

import io

import pytest
from rich.console import Console

from dsrc.evaluation.table import Column, ResultTable, Stat, TableRow


def printed(sheet: ResultTable, columns: int) -> str:
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(sheet.terminal(columns))
    return console.export_text()


@pytest.mark.parametrize("columns", [1, 9, 20])
def test_nothing_of_a_table_is_lost_at_80_columns(columns):
    names = ("[plain]", "DSRC, a twentieth in 8 bits", "averyveryverylongnamewithoutanyspace")
    lines = tuple(
        TableRow(name, tuple((Stat(0.01 * c + 0.1 * i, 0.02), Stat(0.005 + 0.01 * c)) for c in range(columns + 1)))
        for i, name in enumerate(names)
    )
    titles = [f"Cross sensor{c}" for c in range(columns)]
    sheet = ResultTable("table_1", "Table 1", "", "Method", tuple(map(Column, [*titles, "hidden"])), lines)
    text = printed(sheet, columns)
    assert "…" not in text and "hidden" not in text and max(map(len, text.splitlines())) <= 80
    words = text.split()
    for c in range(columns):
        assert f"sensor{c}" in words
        for i in range(len(names)):
            assert {f"{c + 10 * i:.1f}", f"{c + 0.5:.1f}"} <= set(words)
    assert "IoU 0.5, 0.7" in text and "[plain]" in text and "twentieth" in text
    join_results = "".join(line.split(" ")[0] for line in text.splitlines())
    assert "averyveryverylongnamewithoutanyspace" in join_results
