"""Tables of the paper, of hand-made rows: methods are found by what they are, and missing ones are listed."""

import tomllib
from dataclasses import replace as changed
from pathlib import Path

import pytest
from msgspec.structs import replace

from dsrc.evaluation.config import Footnote
from dsrc.evaluation.report.dataset_results import DatasetResults
from dsrc.evaluation.report.report import RESULTS, write_report
from dsrc.evaluation.runner import TrainedDetector
from dsrc.tables.document import publish
from dsrc.training.recipes import METHODS
from studies.dsrc_paper import report
from studies.dsrc_paper.methods import averaged_methods, compared_methods, method_styles
from studies.dsrc_paper.report import write_paper
from studies.dsrc_paper.tables import mean_corrupted, table_2, table_3, table_4
from tests.dsrc.evaluation.report.test_tables import outcome_of, settings_of, view_of
from tests.paths import ROOT


def test_table_2_goes_from_none_to_all_parts_and_says_which_are_missing() -> None:
    results = view_of({"attfuse": 1, "sdd only": 1, "no rec": 1, "dsrc": 1})
    sheet = table_2(results)
    assert [line.label for line in sheet.rows] == ["none", "SDD", "SDD + PCP", "SDD + PCP + REC"]
    assert "Left out, for want of a method: PCP." in sheet.note
    corrupted, whole = sheet.rows[-1].cells[1:]
    assert 100 * corrupted[0].mean == pytest.approx(84.37, abs=0.01)
    assert 100 * whole[0].mean == pytest.approx(85.54, abs=0.01)
    assert mean_corrupted(0.9, {"fog": 0.5, "snow": 0.3}) == 0.4
    # Half a DSRC is no method of Table 1.
    assert compared_methods(results) == ["attfuse", "dsrc"]
    assert table_2(view_of({"attfuse": 1})) == (
        "Table 2 is left out: it needs a method with attention, SDD, PCP and REC (dsrc)."
    )
    assert "'dsrc' with other parts: none, SDD, PCP, SDD + PCP" in table_2(view_of({"dsrc": 1}))


def test_tables_3_and_4_find_their_pairs_by_what_methods_are() -> None:
    results = view_of({"dsrc": 1, "f-cooper": 1, "dsrc-max": 1, "attfuse": 1, "no-collaboration": 1, "dsrc-alone": 1})
    three, four = table_3(results), table_4(results)
    titles = [column.title for column in three.columns]
    assert titles == ["Maximum", "Maximum + DSRC", "Attention", "Attention + DSRC"]
    clean = three.rows[0]
    assert clean.label == "Clean" and [cell[0].mean for cell in clean.cells] == pytest.approx(
        [0.9229, 0.9229, 0.9229, 0.9258]
    )
    assert [line.label for line in three.rows][-2:] == ["mCE", "mAP"]
    assert [column.title for column in four.columns] == ["No collaboration", "No collaboration + DSRC"]
    assert "for want of methods: f-cooper, dsrc-max" in table_3(view_of({"dsrc": 1, "attfuse": 1})).note
    assert table_4(view_of({"dsrc": 1})) == "Table 4 is left out: it needs no-collaboration, dsrc-alone."


def test_a_plain_method_of_other_sizes_is_not_taken_for_the_base() -> None:
    result = outcome_of({"attfuse": 1, "dsrc": 1})
    wider = replace(settings_of("attfuse"), shrink_channels=128)
    result.trained["attfuse"][0] = TrainedDetector("x.pt", "x", wider, 0, {})
    assert "none" in table_2(DatasetResults.of(result, "made up"))


def test_figure_4_is_the_mean_of_methods_that_are_different() -> None:
    result = outcome_of({"late": 1, "f-cooper": 1, "dsrc": 1, "dsrc-max": 1, "dsrc-alone": 1, "v2vnet": 1})
    result.trained["dsrc, its clouds thinned"] = result.trained["dsrc"]
    only = result.trained["dsrc"][0]
    headed = replace(only.settings, direction=True)
    result.trained["dsrc, a head for directions"] = [changed(only, settings=headed)]
    result.trained["late"][0] = changed(result.trained["late"][0], use={"bits": 8})
    results = DatasetResults.of(result, "made up")
    assert averaged_methods(results) == ["f-cooper", "dsrc", "v2vnet"]
    assert len(compared_methods(results)) == 8


def test_a_method_has_one_style_in_all_benchmarks() -> None:
    methods = {"late": 1, "where2comm": 1, "v2vnet": 1, "attfuse": 1, "dsrc": 1, "dsrc-alone": 1}
    styles = method_styles(view_of(methods))
    assert len(set(styles.values())) == len(styles) and set(methods) <= set(styles)
    several = (["attfuse", "dsrc"], ["dsrc", "late"], ["v2vnet", "where2comm", "attfuse"], ["late"])
    for few in several:
        alone = method_styles(view_of(dict.fromkeys(few, 1)))
        assert {name: alone[name] for name in few} == {name: styles[name] for name in few}


def test_notes_mark_the_lines_of_their_methods_in_the_papers_tables() -> None:
    notes = (
        Footnote(methods=("dsrc", "no rec"), text="To be made anew."),
        Footnote(methods=("late",), text="Early, too."),
        Footnote(methods=("dsrc",), text="Twice."),
    )
    results = view_of(dict.fromkeys(("late", "attfuse", "no rec", "dsrc", "f-cooper", "dsrc-max"), 1), notes=notes)
    two, three = table_2(results), table_3(results)
    assert [row.title for row in two.rows] == ["none", "SDD + PCP †", "SDD + PCP + REC †."]
    assert two.footnotes == three.footnotes == ("† To be made anew.", ". Twice.")
    assert [c.title for c in three.columns] == ["Maximum", "Maximum + DSRC", "Attention", "Attention + DSRC †."]


@pytest.mark.slow
def test_the_papers_tables_take_their_places_in_a_document(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report, "write_pictures", lambda result, writer: None)
    result = outcome_of(dict.fromkeys(METHODS, 1), name="Small", family=("physical", "paper"))
    out = tmp_path / "out"
    ours, papers = ({one.name: one for one in write(result, out)} for write in (write_report, write_paper))
    tables = ("table_1", "table_2", "table_3", "table_4")
    for name in (*tables, *(f"{name}_paper" for name in tables)):
        section = papers[f"made-up/{name}"]
        assert all((out / file).is_file() for file in section.files) and len(section.files) == 3
        # The printed numbers are of one family of corruptions.
        assert ("**The paper's Table" in section.text) is not name.endswith("_paper")
    assert {"made-up/figure_4", "made-up/figure_5_paper"} <= papers.keys()
    publish(list((ours | papers).values()), out, tmp_path / "page.md", "Small", RESULTS)
    text = (tmp_path / "page.md").read_text()
    assert text.count("begin small/made-up/table_1 -->") == 1 and "**Table 1. Clean and corrupted frames" in text


def test_the_row_that_is_measured_again_is_one_of_the_sweeps() -> None:
    plans = (ROOT / "studies/dsrc_paper" / f"{name}.toml" for name in ("helpers", "sweeps"))
    row, whole = (tomllib.loads(path.read_text(encoding="utf-8")) for path in plans)
    team, alone = row["methods"]
    assert team in whole["methods"] and {**alone, "name": team["name"]} == {**team, "agents": 1}
    assert max(whole["sweeps"]["agents"]) == 5  # as many as a detector takes
    same = ("corruption", "channel", "frames", "datasets")
    assert [row[name] for name in same] == [whole[name] for name in same]
