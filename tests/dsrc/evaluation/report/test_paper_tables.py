"""Tables of hand-made rows: every number is in its place, and missing methods are listed."""

import csv
import io
import math
import statistics
from dataclasses import replace as changed
from pathlib import Path

import pytest
from msgspec.structs import replace

from dsrc.evaluation.conditions import Condition
from dsrc.evaluation.config import Benchmark, Case, DatasetSpec, Footnote, MethodSpec, ParameterSweeps, cases_of
from dsrc.evaluation.report.dataset_results import (
    DatasetResults,
    averaged_methods,
    compared_methods,
    method_styles,
)
from dsrc.evaluation.report.document import publish
from dsrc.evaluation.report.paper_tables import corruption_tables, mean_corrupted, table_1, table_2, table_3, table_4
from dsrc.evaluation.report.report import RESULTS, write_report
from dsrc.evaluation.report.sweep_tables import axes_of, clean_tables, sweep_table
from dsrc.evaluation.results import Row
from dsrc.evaluation.runner import BenchmarkResult, CaseResult, TrainedDetector
from dsrc.evaluation.table import ResultTable, Stat
from dsrc.training.recipes import METHODS, debug, of_method

# Table 1 of the paper, OPV2V, AP at IoU 0.5 and 0.7 in percent: clean and the six.
PAPER = {
    "dsrc": (
        (92.58, 85.82, 86.20, 83.54, 74.14, 90.76, 85.77),
        (88.45, 79.59, 69.41, 69.84, 67.25, 84.57, 77.64),
    ),
    "v2vnet": (
        (92.29, 83.30, 83.87, 68.22, 73.90, 90.33, 81.40),
        (83.20, 70.35, 65.17, 57.06, 66.93, 77.68, 67.53),
    ),
}
KINDS = ("clean", "beam_missing", "motion_blur", "fog", "snow", "crosstalk", "cross_sensor")


def settings_of(name: str):
    parts = {"sdd only": (True, False, False), "no rec": (True, True, False)}
    if name in parts:
        sdd, pcp, rec = parts[name]
        return replace(debug().model, sdd=sdd, pcp=pcp, rec=rec)
    return of_method(debug(), name).model


def number(case: Case, k: int) -> float:
    """Return the AP of a case: the paper's, less a percent per training, or one that depends on what is varied."""
    values = PAPER.get(case.method, PAPER["v2vnet"])[k]
    less = case.training + 10 * case.pose_error + (5 - (case.agents or 5))
    return values[KINDS.index(case.condition.kind)] / 100 - 0.01 * less


def outcome_of(methods: dict[str, int], **settings: object) -> BenchmarkResult:
    """Return rows for methods, by name their number of trainings."""
    specs = tuple(MethodSpec(name=n, detectors=tuple(f"{n}{i}" for i in range(k))) for n, k in methods.items())
    plan = Benchmark(methods=specs, datasets=(DatasetSpec(name="made up", drives=("x",)),), **settings)
    trained = {
        name: [TrainedDetector(Path(f"{name}{i}.pt"), f"{name}{i}", settings_of(name), i, {}) for i in range(count)]
        for name, count in methods.items()
    }
    entries = []
    for case in cases_of(plan):
        metrics = {"ap_bev_50": number(case, 0), "ap_bev_70": number(case, 1)}
        metrics |= {"ap_opencood_bev_50": metrics["ap_bev_50"] - 0.1, "ap_opencood_bev_70": 0.0}
        condition = case.condition
        row = Row(case.method, condition.kind, condition.severity, 10, 40, 35, metrics, 0.02, 1500.0, 0.0, 1.0)
        entries.append(CaseResult(case, row, ("ab",), (Path("drive"),)))
    return BenchmarkResult(plan, trained, {"made up": {"drive": "cd"}}, {"made up": (10,)}, entries, 0)


def view_of(methods: dict[str, int], **settings: object) -> DatasetResults:
    return DatasetResults.of(outcome_of(methods, **settings), "made up")


def tables_of(result: BenchmarkResult, dataset: str) -> list[ResultTable | str]:
    results = DatasetResults.of(result, dataset)
    return [*corruption_tables(results, result.plan.severities), *clean_tables(results, axes_of(result))]


def test_table_1_has_the_papers_mce_and_mean_of_the_papers_numbers():
    sheet = table_1(view_of({"v2vnet": 1, "dsrc": 1}))
    v2vnet, dsrc = sheet.lines
    assert [column.title for column in sheet.columns][:4] == ["Clean", "Beam missing", "Motion blur", "Fog"]
    assert [cell[0].mean for cell in dsrc.cells[:7]] == pytest.approx([x / 100 for x in PAPER["dsrc"][0]])
    # mCE as recomputed from the paper's Table 1 (0.5 / 0.7), and the mean that its Table 2 prints.
    assert [100 * stat.mean for stat in dsrc.cells[7]] == pytest.approx([8.87, 15.53], abs=0.01)
    assert [100 * stat.mean for stat in v2vnet.cells[7]] == pytest.approx([13.13, 18.93], abs=0.01)
    assert [100 * stat.mean for stat in dsrc.cells[8]] == pytest.approx([85.54, 76.67], abs=0.01)
    text = sheet.markdown().splitlines()
    assert text[2].startswith("| Method | Clean | Beam missing |")
    assert text[5].startswith("| dsrc | **92.6** / **88.5** | **85.8** / **79.6** | **86.2** / **69.4** |")
    assert text[4].endswith("| 13.1 / 18.9 | 81.9 / 69.7 | 1.5 | 20 |")
    assert text[5].endswith("| **8.9** / **15.5** | **85.5** / **76.7** | 1.5 | 20 |")


def test_several_trainings_are_a_mean_and_a_spread():
    sheet = table_1(view_of({"dsrc": 3, "v2vnet": 1}))
    clean = sheet.lines[0].cells[0][0]
    assert clean.mean == pytest.approx(0.9258 - 0.01) and clean.spread == pytest.approx(0.01)
    each = [
        statistics.mean(1 - (x / 100 - 0.01 * k) / (0.9258 - 0.01 * k) for x in PAPER["dsrc"][0][1:]) for k in range(3)
    ]
    assert sheet.lines[0].cells[7][0] == pytest.approx((statistics.mean(each), statistics.stdev(each)))
    assert math.isnan(sheet.lines[1].cells[0][0].spread)
    assert "| dsrc | 91.6 ± 1.0 / **87.4 ± 1.0** |" in sheet.markdown()
    assert "± is the standard deviation between trainings" in sheet.note
    first = next(csv.DictReader(io.StringIO(sheet.csv())))
    assert float(first["Clean 0.5"]) == pytest.approx(0.9158)
    assert float(first["Clean 0.5 spread"]) == pytest.approx(0.01)
    assert Stat.of([]).text(100, 1) == "-" and Stat.of([0.5, math.nan]).text(100, 1) == "-"


def test_the_other_order_has_its_own_table():
    sheet = table_1(view_of({"dsrc": 1}), opencood=True)
    assert sheet.lines[0].cells[0][0].mean == pytest.approx(0.8258)
    assert sheet.name == "table_1_opencood" and "inside each frame" in sheet.note


def test_table_2_goes_from_none_to_all_parts_and_says_which_are_missing():
    results = view_of({"attfuse": 1, "sdd only": 1, "no rec": 1, "dsrc": 1})
    sheet = table_2(results)
    assert [line.label for line in sheet.lines] == ["none", "SDD", "SDD + PCP", "SDD + PCP + REC"]
    assert "Left out, for want of a method: PCP." in sheet.note
    corrupted, whole = sheet.lines[-1].cells[1:]
    assert 100 * corrupted[0].mean == pytest.approx(84.37, abs=0.01)
    assert 100 * whole[0].mean == pytest.approx(85.54, abs=0.01)
    assert mean_corrupted(0.9, {"fog": 0.5, "snow": 0.3}) == 0.4
    # Half a DSRC is no method of Table 1.
    assert [line.label for line in table_1(results).lines] == ["attfuse", "dsrc"]
    assert table_2(view_of({"attfuse": 1})) == (
        "Table 2 is left out: it needs a method with attention, SDD, PCP and REC (dsrc)."
    )
    assert "'dsrc' with other parts: none, SDD, PCP, SDD + PCP" in table_2(view_of({"dsrc": 1}))


def test_tables_3_and_4_find_their_pairs_by_what_methods_are():
    results = view_of({"dsrc": 1, "f-cooper": 1, "dsrc-max": 1, "attfuse": 1, "no-collaboration": 1, "dsrc-alone": 1})
    three, four = table_3(results), table_4(results)
    titles = [column.title for column in three.columns]
    assert titles == ["Maximum", "Maximum + DSRC", "Attention", "Attention + DSRC"]
    clean = three.lines[0]
    assert clean.label == "Clean" and [cell[0].mean for cell in clean.cells] == pytest.approx(
        [0.9229, 0.9229, 0.9229, 0.9258]
    )
    assert [line.label for line in three.lines][-2:] == ["mCE", "mAP"]
    assert [column.title for column in four.columns] == ["No collaboration", "No collaboration + DSRC"]
    assert "for want of methods: f-cooper, dsrc-max" in table_3(view_of({"dsrc": 1, "attfuse": 1})).note
    assert table_4(view_of({"dsrc": 1})) == "Table 4 is left out: it needs no-collaboration, dsrc-alone."


def test_a_plain_method_of_other_sizes_is_not_taken_for_the_base():
    result = outcome_of({"attfuse": 1, "dsrc": 1})
    wider = replace(settings_of("attfuse"), shrink_channels=128)
    result.trained["attfuse"][0] = TrainedDetector(Path("x.pt"), "x", wider, 0, {})
    assert "none" in table_2(DatasetResults.of(result, "made up"))


def test_curves_hold_what_is_varied_in_ascending_order():
    result = outcome_of({"dsrc": 2}, sweeps=ParameterSweeps(agents=(3, 1, 2), pose_error=(0.4, 0.2)))
    agents, errors = axes_of(result)
    results = DatasetResults.of(result, "made up")
    assert [column.title for column in sweep_table(results, agents).columns] == ["1", "2", "3"]
    line = sweep_table(results, agents).lines[0]
    assert [cell[0].mean for cell in line.cells] == pytest.approx([0.9258 - 0.005 - 0.01 * (5 - n) for n in (1, 2, 3)])
    assert agents.places == [1, 2, 3] and errors.places == [0, 0.2, 0.4]
    assert [text for text, _ in errors.values] == ["0", "0.2", "0.4"]
    line = sweep_table(results, errors).lines[0]
    assert [cell[0].mean for cell in line.cells] == pytest.approx([0.9208, 0.9008, 0.8808])


def test_a_severity_that_is_not_the_papers_is_shown_where_it_is_the_only_one():
    results = view_of({"dsrc": 1}, severities=(5, 1), corruptions=("fog",))
    assert results.severity == 5 and results.kinds() == ["fog"]
    assert view_of({"dsrc": 1}, severities=(1, 3)).severity == 3
    assert len(results.rows("dsrc", "fog")) == 1 and results.rows("dsrc", "fog", severity=2) == []
    entry = results.entries[-1]
    assert entry.case.condition == Condition("fog", 1)


def test_clean_frames_alone_have_no_mce():
    sheet = table_1(view_of({"dsrc": 1}, corruptions=("clean",)))
    assert [column.title for column in sheet.columns] == ["Clean", "mCE", "mAP", "kB / frame", "ms / frame"]
    assert "| dsrc | 92.6 / 88.5 | - / - | - / - | 1.5 | 20 |" in sheet.markdown()


def test_every_table_says_what_its_numbers_come_from():
    methods = {"late": 1, "where2comm": 1, "attfuse": 1, "dsrc": 3, "f-cooper": 1, "dsrc-max": 1}
    result = outcome_of(
        methods, severities=(1, 3), sweeps=ParameterSweeps(agents=(1, 2)), channels=("ideal", "its-g5-6")
    )
    for name, several in result.trained.items():
        result.trained[name] = [changed(one, recipe="debug") for one in several]
    x0, y0, _, x1, y1, _ = settings_of("dsrc").grid.range_m
    sheets = {sheet.name: sheet for sheet in tables_of(result, "made up") if not isinstance(sheet, str)}
    assert {"table_1", "table_2", "table_3", "agents", "channels", "severity"} <= set(sheets)
    for sheet in sheets.values():
        assert "10 frames with 40 boxes" in sheet.note
        assert f"debug, x {x0:g} to {x1:g} m, y {y0:g} to {y1:g} m" in sheet.note
        assert "0, 1, 2 (dsrc); 0 (the others)" in sheet.note or sheet.name == "table_2"
    for name in ("table_1", "channels"):
        assert "That of where2comm is an upper bound" in sheets[name].note
        assert "That of late is of the objects of the ground truth" in sheets[name].note
    assert "upper bound" not in sheets["agents"].note
    results = DatasetResults.of(result, "made up")
    result.trained["late"] = [changed(one, recipe="", seed=None) for one in result.trained["late"]]
    assert "not known (late)" in table_1(results).note


def test_figure_4_is_the_mean_of_methods_that_are_different():
    result = outcome_of({"late": 1, "f-cooper": 1, "dsrc": 1, "dsrc-max": 1, "dsrc-alone": 1, "v2vnet": 1})
    result.trained["dsrc, its clouds thinned"] = result.trained["dsrc"]
    only = result.trained["dsrc"][0]
    headed = replace(only.settings, direction=True)
    result.trained["dsrc, a head for directions"] = [changed(only, settings=headed)]
    result.trained["late"][0] = changed(result.trained["late"][0], use={"bits": 8})
    results = DatasetResults.of(result, "made up")
    assert averaged_methods(results) == ["f-cooper", "dsrc", "v2vnet"]
    assert len(compared_methods(results)) == 8


def test_a_method_has_one_style_in_all_benchmarks():
    methods = {"late": 1, "where2comm": 1, "v2vnet": 1, "attfuse": 1, "dsrc": 1, "dsrc-alone": 1}
    styles = method_styles(view_of(methods))
    assert len(set(styles.values())) == len(styles) and set(methods) <= set(styles)
    several = (["attfuse", "dsrc"], ["dsrc", "late"], ["v2vnet", "where2comm", "attfuse"], ["late"])
    for few in several:
        alone = method_styles(view_of(dict.fromkeys(few, 1)))
        assert {name: alone[name] for name in few} == {name: styles[name] for name in few}


def test_notes_mark_the_lines_of_their_methods_in_every_table(tmp_path):
    notes = (
        Footnote(methods=("dsrc", "no rec"), text="To be made anew."),
        Footnote(methods=("late",), text="Early, too."),
        Footnote(methods=("dsrc",), text="Twice."),
    )
    methods = {"late": 1, "attfuse": 1, "no rec": 1, "dsrc": 1, "f-cooper": 1, "dsrc-max": 1}
    result = outcome_of(methods, notes=notes, severities=(1, 3), sweeps=ParameterSweeps(agents=(1, 2)))
    sheets = {sheet.name: sheet for sheet in tables_of(result, "made up") if not isinstance(sheet, str)}
    for name in ("table_1", "table_1_opencood", "severity", "agents"):
        text = sheets[name].markdown()
        assert "| dsrc †. | " in text and "| late ‡ | " in text and "| attfuse | " in text
        assert "\n\n† To be made anew.\n\n‡ Early, too.\n\n. Twice.\n\n" in text
    two, three = sheets["table_2"], sheets["table_3"]
    assert [line.title for line in two.lines] == ["none", "SDD + PCP †", "SDD + PCP + REC †."]
    assert two.footnotes == three.footnotes == ("† To be made anew.", ". Twice.")
    assert [c.title for c in three.columns] == ["Maximum", "Maximum + DSRC", "Attention", "Attention + DSRC †."]
    # Keys of CSV and of figures stay the methods' names.
    assert [row["Method"] for row in csv.DictReader(io.StringIO(sheets["table_1"].csv()))][-3] == "dsrc"
    assert write_report(result, tmp_path)


def test_a_start_has_a_column_where_a_method_says_so():
    result = outcome_of({"v2vnet": 1, "dsrc": 1})
    assert not table_1(DatasetResults.of(result, "made up")).words
    first, second = result.plan.methods
    plan = replace(result.plan, methods=(replace(first, start="own, maximum"), second))
    sheet = table_1(DatasetResults.of(changed(result, plan=plan), "made up"))
    text = sheet.markdown().splitlines()
    assert text[2].startswith("| Method | Start | Clean |")
    assert text[4].startswith("| v2vnet | own, maximum | 92.3") and text[5].startswith("| dsrc |  | **92.6**")
    rows = list(csv.DictReader(io.StringIO(sheet.csv())))
    assert [row["Start"] for row in rows] == ["own, maximum", ""]
    assert float(rows[1]["Clean 0.5"]) == pytest.approx(0.9258)


def test_each_family_of_corruptions_has_its_own_table_1():
    result = outcome_of({"dsrc": 1, "attfuse": 1}, families=("physical", "paper"), corruptions=("fog", "snow"))
    weaker = [
        changed(e, row=changed(e.row, metrics={name: v / 2 for name, v in e.row.metrics.items()}))
        if e.case.condition.family == "paper"
        else e
        for e in result.entries
    ]
    physical, paper = (
        table_1(DatasetResults.of(changed(result, entries=weaker), "made up", family))
        for family in ("physical", "paper")
    )
    assert [column.title for column in physical.columns] == [column.title for column in paper.columns]
    for ours, theirs in zip(physical.lines, paper.lines, strict=True):
        assert ours.cells[0] == theirs.cells[0]  # clean frames are nobody's corruption
        assert theirs.cells[1][0].mean == pytest.approx(ours.cells[1][0].mean / 2)
        assert theirs.cells[3][0].mean > ours.cells[3][0].mean
    assert paper.title == f"{physical.title}, corruptions as published"
    assert "Severity 3 of the published models." in paper.note and "Severity 3. " in physical.note


def test_a_report_of_all_methods_is_written_and_put_into_a_document(tmp_path):
    result = outcome_of(
        dict.fromkeys(METHODS, 1), name="Small", severities=(1, 3), sweeps=ParameterSweeps(agents=(1, 2))
    )
    out, document = tmp_path / "out", tmp_path / "docs" / "results.md"
    sections = write_report(result, out)
    names = {path.name for path in (out / "made-up").iterdir()}
    for table in ("table_1", "table_2", "table_3", "table_4", "agents", "severity"):
        assert {f"{table}.md", f"{table}.csv", f"{table}.png"} <= names
    assert {"figure_4.png", "figure_5.png", "traffic.png"} <= names
    assert len([sheet for sheet in tables_of(result, "made up") if isinstance(sheet, str)]) == 1  # visibility
    document.parent.mkdir()
    (out / "made-up" / "stale.csv").write_text("of a run before")
    begin, end = (f"<!-- {word} small/made-up/table_1 -->" for word in ("begin", "end"))
    document.write_text(f"# Results\n\nBefore.\n\n{begin}\nold\n{end}\n\nAfter.\n")
    folder = publish(sections, out, document, "Small", RESULTS)
    text = document.read_text()
    assert "old" not in text and text.index("Before.") < text.index("| dsrc |") < text.index("After.")
    assert "(results/small/made-up/table_1.png)" in text
    assert (folder / "results.json").read_bytes() == (out / "results.json").read_bytes()
    assert folder == tmp_path / "docs" / "results" / "small"
    publish(sections, out, document, "Small", RESULTS)
    assert document.read_text() == text
    document.write_bytes(text.encode().replace(b"\n", b"\r\n"))
    publish(sections, out, document, "Small", RESULTS)
    assert document.read_bytes() == text.encode().replace(b"\n", b"\r\n")  # its own line ends stay
    assert files_below(folder) == RESULT_FILES | set(sections[0].files) and "made-up/table_1.csv" in sections[0].files
    # Without a place for any section the document gets all of them.
    publish(sections, out, tmp_path / "all.md", "Small", RESULTS)
    assert all(f"<!-- begin small/{block.name} -->" in (tmp_path / "all.md").read_text() for block in sections)
    written = {name for block in sections for name in block.files} | RESULT_FILES
    assert "made-up/figure_4.png" in written and files_below(tmp_path / "all/small") == written


RESULT_FILES = {"results.json", "results.csv", "timings.csv"}


def files_below(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_parts_of_dsrc_alone_are_reported_too(tmp_path):
    result = outcome_of({"dsrc": 1})
    parts = replace(settings_of("dsrc"), pcp=False, rec=False)
    result.trained["dsrc"] = [changed(one, settings=parts) for one in result.trained["dsrc"]]
    assert compared_methods(DatasetResults.of(result, "made up")) == []
    assert write_report(result, tmp_path)


def test_results_may_lie_in_the_documents_own_folder(tmp_path):
    out = tmp_path / "results" / "small"
    sections = write_report(outcome_of({"dsrc": 1}, name="Small"), out)
    before = (out / "results.json").read_bytes()
    assert publish(sections, out, tmp_path / "results.md", "Small", RESULTS) == out
    assert (out / "results.json").read_bytes() == before
    assert (tmp_path / "results" / sections[0].picture).name == "table_1.png"
