import pytest

from studies.dsrc_paper.published import published_tables


def test_the_papers_tables_agree_with_each_other() -> None:
    sheets = published_tables()
    one = {line.label: line.cells for line in sheets["table_1"].rows}
    assert len(one) == 10 and all(len(cells) == 10 for cells in one.values())
    # Its Table 2 ends with the mean of its Table 1's last line; its Tables 3 and 4 begin with lines of its Table 1.
    last = sheets["table_2"].rows[-1].cells[0]
    assert [stat.mean for stat in one["DSRC"][-2]] == pytest.approx([stat.mean for stat in last], abs=1e-4)
    for name, method in (("table_3", "F-Cooper"), ("table_4", "No Collaboration")):
        assert [line.cells[0] for line in sheets[name].rows] == list(one[method][:-1])
    # Others measured each rival at 0.7 within 5 points of the paper.
    others = {name: cells[-1] for name, cells in one.items() if cells[-1] is not None}
    assert len(others) == 6 and all(abs(100 * one[name][0][1].mean - value) < 5 for name, value in others.items())
    # As printed, two digits.
    assert "| DSRC | **92.58** / **88.45** |" in sheets["table_1"].markdown()
    assert "| SDD + PCP | 84.83 / 75.99 |" in sheets["table_2"].markdown()
    assert "| Clean | 78.85 / 65.05 | 85.24 / 71.73 |" in sheets["table_4"].markdown()
    assert [100 * stat.mean for stat in one["CoBEVT"][7]] == pytest.approx([12.77, 17.43], abs=0.01)
    assert [100 * stat.mean for stat in one["Late Fusion"][7]] == pytest.approx([10.55, 20.14], abs=0.01)
