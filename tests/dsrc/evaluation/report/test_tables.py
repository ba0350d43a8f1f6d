"""Tables of hand-made rows: every number is in its place, and missing methods are listed."""

import csv
import io
import math
import statistics
from dataclasses import replace as changed
from pathlib import Path

import pytest
from msgspec.structs import replace

from dsrc.evaluation.config import Benchmark, Case, DatasetSpec, Footnote, MethodSpec, ParameterSweeps, cases_of
from dsrc.evaluation.report.dataset_results import DatasetResults
from dsrc.evaluation.report.report import RESULTS, write_report
from dsrc.evaluation.report.tables import axes_of, severity_table, sweep_table, table_1
from dsrc.evaluation.results import Row
from dsrc.evaluation.runner import BenchmarkResult, CaseResult, TrainedDetector
from dsrc.models.settings import ModelSettings
from dsrc.tables.document import publish
from dsrc.tables.table import Stat, Table
from dsrc.training.recipes import METHODS, debug, of_method
from sensors.corruptions import Condition

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
CHOICE = {
    "dsrc": {"helped_recall": 0.5, "first_sight_m": 50.0, "false_boxes": 0.7, "ece": 0.2},
    "v2vnet": {"helped_recall": 0.6, "first_sight_m": 40.0, "false_boxes": 1.2, "ece": 0.3},
}
KINDS = ("clean", "beam_missing", "motion_blur", "fog", "snow", "crosstalk", "cross_sensor")


def settings_of(name: str) -> ModelSettings:
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
        name: [TrainedDetector(f"{name}{i}.pt", f"{name}{i}", settings_of(name), i, {}) for i in range(count)]
        for name, count in methods.items()
    }
    entries = []
    for case in cases_of(plan):
        metrics = {"ap_bev_50": number(case, 0), "ap_bev_70": number(case, 1)}
        metrics |= {"ap_opencood_bev_50": metrics["ap_bev_50"] - 0.1, "ap_opencood_bev_70": 0.0}
        metrics |= CHOICE.get(case.method, {})
        condition = case.condition
        row = Row(case.method, condition.kind, condition.severity, 10, 40, 35, metrics, 0.02, 1500.0, 0.0, 1.0)
        entries.append(CaseResult(case, row, ("ab",), (Path("drive"),)))
    return BenchmarkResult(
        plan, trained, {"made up": {"drive": "cd"}}, {"made up": (10,)}, {"made up": (0,)}, entries, 0
    )


def view_of(methods: dict[str, int], **settings: object) -> DatasetResults:
    return DatasetResults.of(outcome_of(methods, **settings), "made up")


def tables_of(result: BenchmarkResult, dataset: str) -> dict[str, Table]:
    results = DatasetResults.of(result, dataset)
    sheets = [table_1(results), table_1(results, opencood=True), severity_table(results, result.plan.severity)]
    return {sheet.name: sheet for sheet in [*sheets, *(sweep_table(results, axis) for axis in axes_of(result))]}


def test_table_1_has_the_papers_mce_and_mean_of_the_papers_numbers() -> None:
    sheet = table_1(view_of({"v2vnet": 1, "dsrc": 1}))
    v2vnet, dsrc = sheet.rows
    assert [column.title for column in sheet.columns][:4] == ["Clean", "Beam missing", "Motion blur", "Fog"]
    assert [cell[0].mean for cell in dsrc.cells[:7]] == pytest.approx([x / 100 for x in PAPER["dsrc"][0]])
    # mCE as recomputed from the paper's Table 1 (0.5 / 0.7), and the mean that its Table 2 prints.
    assert [100 * stat.mean for stat in dsrc.cells[7]] == pytest.approx([8.87, 15.53], abs=0.01)
    assert [100 * stat.mean for stat in v2vnet.cells[7]] == pytest.approx([13.13, 18.93], abs=0.01)
    assert [100 * stat.mean for stat in dsrc.cells[8]] == pytest.approx([85.54, 76.67], abs=0.01)
    text = sheet.markdown().splitlines()
    assert text[2].startswith("| Method | Clean | Beam missing |")
    assert text[5].startswith("| dsrc | **92.6** / **88.5** | **85.8** / **79.6** | **86.2** / **69.4** |")
    assert text[4].endswith("| 13.1 / 18.9 | 81.9 / 69.7 | **60.0** | 40.0 | 1.2 | 30.0 | 1.5 | 20 |")
    assert text[5].endswith(
        "| **8.9** / **15.5** | **85.5** / **76.7** | 50.0 | **50.0** | **0.7** | **20.0** | 1.5 | 20 |"
    )


def test_several_trainings_are_a_mean_and_a_spread() -> None:
    sheet = table_1(view_of({"dsrc": 3, "v2vnet": 1}))
    clean = sheet.rows[0].cells[0][0]
    assert clean.mean == pytest.approx(0.9258 - 0.01) and clean.spread == pytest.approx(0.01)
    each = [
        statistics.mean(1 - (x / 100 - 0.01 * k) / (0.9258 - 0.01 * k) for x in PAPER["dsrc"][0][1:]) for k in range(3)
    ]
    assert sheet.rows[0].cells[7][0] == pytest.approx((statistics.mean(each), statistics.stdev(each)))
    assert math.isnan(sheet.rows[1].cells[0][0].spread)
    assert "| dsrc | 91.6 ± 1.0 / **87.4 ± 1.0** |" in sheet.markdown()
    assert "± is the standard deviation between trainings" in sheet.note
    first = next(csv.DictReader(io.StringIO(sheet.csv())))
    assert float(first["Clean 0.5"]) == pytest.approx(0.9158)
    assert float(first["Clean 0.5 spread"]) == pytest.approx(0.01)
    assert Stat.of([]).text(100, 1) == "-" and Stat.of([0.5, math.nan]).text(100, 1) == "-"


def test_the_other_order_has_its_own_table() -> None:
    sheet = table_1(view_of({"dsrc": 1}), opencood=True)
    assert sheet.rows[0].cells[0][0].mean == pytest.approx(0.8258)
    assert sheet.name == "table_1_opencood" and "inside each frame" in sheet.note


def test_curves_hold_what_is_varied_in_ascending_order() -> None:
    result = outcome_of({"dsrc": 2}, sweeps=ParameterSweeps(agents=(3, 1, 2), pose_error=(0.4, 0.2)))
    agents, errors = axes_of(result)
    results = DatasetResults.of(result, "made up")
    assert [column.title for column in sweep_table(results, agents).columns] == ["1", "2", "3"]
    line = sweep_table(results, agents).rows[0]
    assert [cell[0].mean for cell in line.cells] == pytest.approx([0.9258 - 0.005 - 0.01 * (5 - n) for n in (1, 2, 3)])
    assert agents.places == [1, 2, 3] and errors.places == [0, 0.2, 0.4]
    assert [text for text, _ in errors.values] == ["0", "0.2", "0.4"]
    line = sweep_table(results, errors).rows[0]
    assert [cell[0].mean for cell in line.cells] == pytest.approx([0.9208, 0.9008, 0.8808])


def test_a_severity_that_is_not_the_papers_is_shown_where_it_is_the_only_one() -> None:
    results = view_of({"dsrc": 1}, severity=(5, 1), corruption=("fog",))
    assert results.severity == 5 and results.kinds() == ["fog"]
    assert view_of({"dsrc": 1}, severity=(1, 3)).severity == 3
    assert len(results.rows("dsrc", "fog")) == 1 and results.rows("dsrc", "fog", severity=2) == []
    entry = results.entries[-1]
    assert entry.case.condition == Condition("fog", 1)


def test_clean_frames_alone_have_no_mce() -> None:
    sheet = table_1(view_of({"dsrc": 1}, corruption=("clean",)))
    beside = ["helped", "first sight", "false per frame", "ECE", "kB / frame", "ms / frame"]
    assert [column.title for column in sheet.columns] == ["Clean", "mCE", "mAP", *beside]
    assert "| dsrc | 92.6 / 88.5 | - / - | - / - | 50.0 | 50.0 | 0.7 | 20.0 | 1.5 | 20 |" in sheet.markdown()


def test_every_table_says_what_its_numbers_come_from() -> None:
    methods = {"late": 1, "where2comm": 1, "attfuse": 1, "dsrc": 3, "f-cooper": 1, "dsrc-max": 1}
    result = outcome_of(methods, severity=(1, 3), sweeps=ParameterSweeps(agents=(1, 2)), channel=("ideal", "its-g5-6"))
    for name, several in result.trained.items():
        result.trained[name] = [changed(one, recipe="debug") for one in several]
    x0, y0, _, x1, y1, _ = settings_of("dsrc").grid.range_m
    sheets = tables_of(result, "made up")
    assert {"table_1", "agents", "channels", "severity"} <= set(sheets)
    for sheet in sheets.values():
        assert "10 frames with 40 boxes" in sheet.note
        assert f"debug, x {x0:g} to {x1:g} m, y {y0:g} to {y1:g} m" in sheet.note
        assert "0, 1, 2 (dsrc); 0 (the others)" in sheet.note
    for name in ("table_1", "channels"):
        assert "That of where2comm is an upper bound" in sheets[name].note
        assert "That of late is of the objects of the ground truth" in sheets[name].note
    assert "upper bound" not in sheets["agents"].note
    results = DatasetResults.of(result, "made up")
    result.trained["late"] = [changed(one, recipe="", seed=None) for one in result.trained["late"]]
    assert "not known (late)" in table_1(results).note


def test_notes_mark_the_lines_of_their_methods_in_every_table(tmp_path: Path) -> None:
    notes = (
        Footnote(methods=("dsrc", "no rec"), text="To be made anew."),
        Footnote(methods=("late",), text="Early, too."),
        Footnote(methods=("dsrc",), text="Twice."),
    )
    methods = {"late": 1, "attfuse": 1, "no rec": 1, "dsrc": 1, "f-cooper": 1, "dsrc-max": 1}
    result = outcome_of(methods, notes=notes, severity=(1, 3), sweeps=ParameterSweeps(agents=(1, 2)))
    sheets = tables_of(result, "made up")
    for name in ("table_1", "table_1_opencood", "severity", "agents"):
        text = sheets[name].markdown()
        assert "| dsrc †. | " in text and "| late ‡ | " in text and "| attfuse | " in text
        assert "\n\n† To be made anew.\n\n‡ Early, too.\n\n. Twice.\n\n" in text
    # Keys of CSV and of figures stay the methods' names.
    assert [row["Method"] for row in csv.DictReader(io.StringIO(sheets["table_1"].csv()))][-3] == "dsrc"
    assert write_report(result, tmp_path)


def test_a_start_has_a_column_where_a_method_says_so() -> None:
    result = outcome_of({"v2vnet": 1, "dsrc": 1})
    assert table_1(DatasetResults.of(result, "made up")).columns[0].title == "Clean"
    first, second = result.plan.methods
    plan = replace(result.plan, methods=(replace(first, start="own, maximum"), second))
    sheet = table_1(DatasetResults.of(changed(result, plan=plan), "made up"))
    text = sheet.markdown().splitlines()
    assert text[2].startswith("| Method | Start | Clean |")
    assert text[4].startswith("| v2vnet | own, maximum | 92.3") and text[5].startswith("| dsrc |  | **92.6**")
    rows = list(csv.DictReader(io.StringIO(sheet.csv())))
    assert [row["Start"] for row in rows] == ["own, maximum", ""]
    assert float(rows[1]["Clean 0.5"]) == pytest.approx(0.9258)


def test_each_family_of_corruptions_has_its_own_table_1() -> None:
    result = outcome_of({"dsrc": 1, "attfuse": 1}, family=("physical", "paper"), corruption=("fog", "snow"))
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
    for ours, theirs in zip(physical.rows, paper.rows, strict=True):
        assert ours.cells[0] == theirs.cells[0]  # clean frames are nobody's corruption
        assert theirs.cells[1][0].mean == pytest.approx(ours.cells[1][0].mean / 2)
        assert theirs.cells[3][0].mean > ours.cells[3][0].mean
    assert paper.title == f"{physical.title}, corruptions as published"
    assert "Severity 3 of the published models." in paper.note and "Severity 3. " in physical.note


@pytest.mark.slow
def test_a_report_of_all_methods_is_written_and_put_into_a_document(tmp_path: Path) -> None:
    result = outcome_of(dict.fromkeys(METHODS, 1), name="Small", severity=(1, 3), sweeps=ParameterSweeps(agents=(1, 2)))
    out, document = tmp_path / "out", tmp_path / "docs" / "results.md"
    sections = write_report(result, out)
    names = {path.name for path in (out / "made-up").iterdir()}
    for table in ("table_1", "agents", "severity"):
        assert {f"{table}.md", f"{table}.csv", f"{table}.png"} <= names
    assert {"figure_5.png", "traffic.png"} <= names
    assert "visibility.md" not in names  # unknown
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
    assert "made-up/figure_5.png" in written and files_below(tmp_path / "all/small") == written


RESULT_FILES = {"results.json", "results.csv", "timings.csv"}


def files_below(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_results_may_lie_in_the_documents_own_folder(tmp_path: Path) -> None:
    out = tmp_path / "results" / "small"
    sections = write_report(outcome_of({"dsrc": 1}, name="Small"), out)
    before = (out / "results.json").read_bytes()
    assert publish(sections, out, tmp_path / "results.md", "Small", RESULTS) == out
    assert (out / "results.json").read_bytes() == before
    assert (tmp_path / "results" / sections[0].picture).name == "table_1.png"
