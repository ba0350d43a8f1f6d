"""Table of differences: values of the rows, with intervals by frame and by drive."""

import csv
import io
import json
import math
import re
from dataclasses import replace as changed
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from dsrc.evaluation.config import DifferenceSpec, Footnote, ParameterSweeps
from dsrc.evaluation.figures.bars import difference_map
from dsrc.evaluation.figures.points import difference_dots
from dsrc.evaluation.metrics.ap import evaluate_matches
from dsrc.evaluation.metrics.intervals import Interval, RankedDetections
from dsrc.evaluation.metrics.robustness import mce
from dsrc.evaluation.report.dataset_results import DatasetResults
from dsrc.evaluation.report.differences import DifferenceTable, _by_drive, difference_table, stored_differences
from dsrc.evaluation.report.report import write_report
from dsrc.evaluation.runner import BenchmarkResult, run_plan
from tests.dsrc.evaluation.metrics.test_intervals import judged_of
from tests.dsrc.evaluation.report.test_tables import outcome_of
from tests.dsrc.evaluation.small import make_plan, write_drives

SKILL = {"dsrc": 0.8, "attfuse": 0.6, "late": 0.6}
LOSS = {"clean": 0.0, "fog": 0.1, "snow": 0.4}
PAIRS = (DifferenceSpec(method="dsrc", baseline="attfuse"), DifferenceSpec(method="late", baseline="attfuse"))


def found_in(frames: tuple[int, ...], trainings: int = 1, **settings: object) -> BenchmarkResult:
    """Return detections, ten boxes a frame, whose AP under a corruption is worse; and rows that say the same."""
    result = outcome_of(dict.fromkeys(SKILL, trainings), corruption=("fog", "snow"), differences=PAIRS, **settings)
    entries = []
    for entry in result.entries:
        case = entry.case
        seed = 100 * case.training + 10 * list(SKILL).index(case.method) + list(LOSS).index(case.condition.kind)
        judged = judged_of(sum(frames), SKILL[case.method] - LOSS[case.condition.kind], seed)
        curves = evaluate_matches(judged).curves
        metrics = {**entry.row.metrics, "ap_bev_50": curves["bev", 0.5].ap, "ap_bev_70": curves["bev", 0.7].ap}
        entries.append(changed(entry, row=changed(entry.row, metrics=metrics), ranked=RankedDetections.of(judged)))
    return changed(result, entries=entries, frames={"made up": frames}, runs={"made up": tuple(range(len(frames)))})


def table_of(result: BenchmarkResult) -> DifferenceTable:
    found = DatasetResults.of(result, "made up")
    return difference_table(found, result.plan.differences, result.frames["made up"], result.runs["made up"])


@pytest.fixture(scope="module")
def result() -> BenchmarkResult:
    return found_in((20, 15, 15, 10), trainings=2)


@pytest.fixture(scope="module")
def table(result: BenchmarkResult) -> DifferenceTable:
    return table_of(result)


def test_the_differences_are_those_of_the_rows(result: BenchmarkResult, table: DifferenceTable) -> None:
    results = DatasetResults.of(result, "made up")
    own = {(one.method, one.condition, one.iou): one for one in table.differences}
    assert len(own) == len(table.differences) == 2 * 5 * 2

    def ap(method: str, kind: str) -> float:
        return float(np.mean([row.metrics["ap_bev_50"] for row in results.rows(method, kind)]))

    for method in ("dsrc", "late"):
        for kind in LOSS:
            assert own[method, kind, 0.5].value.mean == pytest.approx(ap(method, kind) - ap("attfuse", kind), abs=1e-12)
        mean = np.mean([ap(method, kind) - ap("attfuse", kind) for kind in ("fog", "snow")])
        assert own[method, "mean_corrupted", 0.5].value.mean == pytest.approx(mean, abs=1e-12)
        errors = [results.summary(name, mce)[0].mean for name in (method, "attfuse")]
        assert own[method, "mce", 0.5].value.mean == pytest.approx(errors[0] - errors[1], abs=1e-12)
    clean = own["dsrc", "clean", 0.5]
    each = [
        a.metrics["ap_bev_50"] - b.metrics["ap_bev_50"]
        for a, b in zip(results.rows("dsrc"), results.rows("attfuse"), strict=True)
    ]
    assert clean.value.spread == pytest.approx(np.std(each, ddof=1))
    for one in table.differences:
        for low, high in (one.by_frame, one.by_drive):
            assert low < high
            assert low - 0.01 < one.value.mean < high + 0.01


def test_what_differs_is_resolved_and_what_does_not_is_not_claimed(table: DifferenceTable) -> None:
    by_pair = {name: [one for one in table.differences if one.method == name] for name in ("dsrc", "late")}
    assert all(one.resolved for one in by_pair["dsrc"] if one.condition in ("clean", "fog", "snow", "mean_corrupted"))
    assert not any(one.resolved for one in by_pair["late"] if one.condition == "mean_corrupted")
    claims = table.claims()
    claimed = set(re.findall(r"[,:] (mCE|[a-z ]+) at (0\.\d)", claims.split("late − attfuse")[0]))
    resolved = [one for one in by_pair["dsrc"] if one.resolved]
    assert {iou for _, iou in claimed} == {"0.5", "0.7"} and len(claimed) == len(resolved)
    none = changed(table, differences=tuple(one for one in by_pair["late"] if not one.resolved))
    assert none.claims().startswith("No difference is resolved")


def test_bold_is_what_excludes_0(table: DifferenceTable) -> None:
    lines = [line for line in table.markdown().splitlines() if line.startswith("| dsrc") or line.startswith("| late")]
    assert len(lines) == 10
    for line, start in zip(lines, range(0, 20, 2), strict=True):
        cells = [cell.strip() for cell in line.strip("|").split("|")][2:]
        for one, group in zip(table.differences[start : start + 2], (cells[:3], cells[3:]), strict=True):
            wanted = [one.resolved, one.by_frame.excludes_zero, one.by_drive.excludes_zero]
            assert [cell.startswith("**") for cell in group] == wanted
            assert f"{100 * one.value.mean:+.1f}" in group[0]
            assert float(group[2].strip("*[").partition(",")[0]) == pytest.approx(100 * one.by_drive.low, abs=0.051)


def test_the_same_rows_have_the_same_intervals_whatever_else_is_asked_for(
    result: BenchmarkResult, table: DifferenceTable
) -> None:
    alone = changed(result, plan=replace(result.plan, differences=PAIRS[1:]))
    assert table_of(alone).differences == table.differences[10:]


def test_a_drive_without_a_frame_is_none(result: BenchmarkResult, table: DifferenceTable) -> None:
    more = changed(result, frames={"made up": (20, 0, 15, 15, 10)}, runs={"made up": (0, 4, 1, 2, 3)})
    assert table_of(more) == table


def test_drives_of_one_run_of_traffic_are_drawn_together(result: BenchmarkResult) -> None:
    joined = changed(result, frames={"made up": (35, 25)}, runs={"made up": (0, 1)})
    apart = changed(result, runs={"made up": (0, 0, 1, 1)})
    assert table_of(apart).differences == table_of(joined).differences
    assert "of the 2 runs of traffic that 4 drives show (expanded" in table_of(apart).note
    assert "of 2 drives (expanded" in table_of(joined).note


def test_of_a_single_drive_nothing_is_known_by_drive() -> None:
    table = table_of(found_in((30,)))
    assert all(math.isnan(one.by_drive.low) and not math.isnan(one.by_frame.low) for one in table.differences)
    assert not any(one.resolved for one in table.differences)
    assert all(math.isnan(one.value.spread) for one in table.differences)  # one training
    assert "| - |" in table.markdown() and table.claims().endswith("frames of one drive say nothing of other drives.")
    assert next(csv.DictReader(io.StringIO(table.csv())))["by_drive_low"] == ""


def test_the_summary_has_a_line_per_pair_with_the_intervals_by_drive(table: DifferenceTable) -> None:
    lines = [line for line in table.summary().splitlines() if line.startswith(("| dsrc", "| late"))]
    assert len(lines) == 2
    own = {(one.method, one.condition, one.iou): one for one in table.differences}
    wanted = [(condition, iou) for condition in ("clean", "mean_corrupted", "mce") for iou in (0.5, 0.7)]
    for method, line in zip(("dsrc", "late"), lines, strict=True):
        cells = [cell.strip() for cell in line.strip("|").split("|")][1:]
        for (condition, iou), cell in zip(wanted, cells, strict=True):
            one = own[method, condition, iou]
            assert cell.strip("*").startswith(f"{100 * one.value.mean:+.1f} [")
            shown = [float(bound) for bound in cell.partition("[")[2].strip("*]").split(", ")]
            assert shown == pytest.approx([100 * bound for bound in one.by_drive], abs=0.051)
            assert cell.startswith("**") == one.resolved


def test_trainings_are_paired_by_their_seeds_or_not_at_all(result: BenchmarkResult, table: DifferenceTable) -> None:
    swapped = {**result.trained, "dsrc": [changed(one, seed=1 - i) for i, one in enumerate(result.trained["dsrc"])]}
    crossed = table_of(changed(result, trained=swapped)).differences[0]
    a, b = (
        [entry.row.metrics["ap_bev_50"] for entry in DatasetResults.of(result, "made up").found(name)]
        for name in ("dsrc", "attfuse")
    )
    assert crossed.value.mean == table.differences[0].value.mean
    assert crossed.value.spread == pytest.approx(np.std([a[1] - b[0], a[0] - b[1]], ddof=1))
    for seeds in ((0, 7), (None, None)):
        others = [changed(one, seed=seed) for one, seed in zip(result.trained["dsrc"], seeds, strict=True)]
        unpaired = table_of(changed(result, trained={**result.trained, "dsrc": others})).differences[0]
        assert math.isnan(unpaired.value.spread) and unpaired.value.mean == table.differences[0].value.mean


def test_only_trainings_of_common_seeds_count_where_there_are_two() -> None:
    result = found_in((20, 15, 15, 10), trainings=3)
    seeds = {"dsrc": (0, 1, 2), "attfuse": (2, 0, 7), "late": (5, 6, 7)}
    trained = {
        name: [changed(one, seed=seed) for one, seed in zip(result.trained[name], seeds[name], strict=True)]
        for name in seeds
    }
    result = changed(result, trained=trained)
    first = table_of(result).differences[0]
    dsrc, attfuse, late = (
        [entry.row.metrics["ap_bev_50"] for entry in DatasetResults.of(result, "made up").found(name)]
        for name in ("dsrc", "attfuse", "late")
    )
    each = [dsrc[0] - attfuse[1], dsrc[2] - attfuse[0]]
    assert first.value.mean == pytest.approx(np.mean(each)) and first.value.spread == pytest.approx(
        np.std(each, ddof=1)
    )
    assert first.seeds == (0, 2) and first.listed()["seeds"] == "0 2"
    unpaired = next(one for one in table_of(result).differences if one.method == "late")  # one common seed
    assert unpaired.value.mean == pytest.approx(np.mean(late) - np.mean(attfuse)) and math.isnan(unpaired.value.spread)
    twice = [changed(one, seed=seed) for one, seed in zip(trained["dsrc"], (0, 0, 2), strict=True)]
    unclear = table_of(changed(result, trained={**trained, "dsrc": twice})).differences[0]
    assert unclear.value.mean == pytest.approx(np.mean(dsrc) - np.mean(attfuse)) and unclear.seeds == ()


def test_a_bound_near_0_tells_its_side() -> None:
    near = changed(table_of(found_in((20, 15))).differences[0], by_drive=Interval(-0.0004, 0.02))
    assert _by_drive(near).endswith(" [-0.04, +2.0]")


def test_footnotes_and_provenance_are_below_the_table(result: BenchmarkResult) -> None:
    note = Footnote(methods=("dsrc",), text="To be made anew.")
    text = table_of(changed(result, plan=replace(result.plan, notes=(note,)))).markdown()
    assert "| dsrc † − attfuse | Clean |" in text and "\n† To be made anew.\n" in text
    assert "60 frames and of 4 drives" in text and "1000 resamples" in text


def test_dots_stand_at_the_differences_full_where_resolved(table: DifferenceTable) -> None:
    axes = difference_dots(table.differences[:10], "Differences").axes
    assert len(axes) == 2
    for k, panel in enumerate(axes):
        shown = [one for one in table.differences[:10] if one.iou == (0.5, 0.7)[k]]
        dots = [line for line in panel.lines if line.get_marker() == "o"]
        assert [dot.get_xdata()[0] for dot in dots] == pytest.approx([100 * one.value.mean for one in shown])
        assert [dot.get_markerfacecolor() != "white" for dot in dots] == [one.resolved for one in shown]
    assert [t.get_text() for t in axes[0].get_yticklabels()][-2:] == ["mean of the corruptions", "mCE"]


def test_the_map_has_a_number_per_difference_and_a_colour_where_it_is_resolved(table: DifferenceTable) -> None:
    axes = difference_map(table.differences, "Differences").axes[:2]
    for panel, iou in zip(axes, (0.5, 0.7), strict=True):
        shown = [one for one in table.differences if one.iou == iou]
        assert [text.get_text() for text in panel.texts] == [f"{100 * one.value.mean:+.1f}" for one in shown]
        for patch, one in zip(panel.patches, shown, strict=True):
            red, _, blue, _ = patch.get_facecolor()
            gain = -one.value.mean if one.condition == "mce" else one.value.mean
            assert np.sign(round(blue - red, 6)) == (np.sign(gain) if one.resolved else 0)


@pytest.mark.slow
def test_a_page_sums_up_many_pairs_and_links_the_whole_table(tmp_path: Path) -> None:
    write_drives(tmp_path / "test")
    methods = {name: [(method, 0)] for name, method in (("DSRC", "dsrc"), ("plain", "attfuse"), ("late", "late"))}
    pairs = tuple(DifferenceSpec(method=name, baseline="plain") for name in ("DSRC", "late"))
    for count in (2, 1):
        plan = make_plan(tmp_path, methods, corruption=("fog",), differences=pairs[:count])
        result = run_plan(plan, tmp_path / "out")
        section = next(one for one in write_report(result, tmp_path / "out") if one.name == "made-up/differences")
        page, whole = section.markdown(Path("results")), (tmp_path / "out/made-up/differences.md").read_text()
        assert ("| DSRC − plain | Fog |" in page) is (count == 1) and "| DSRC − plain | Fog |" in whole
        assert ("[The whole table](results/made-up/differences.md)" in page) is (count == 2)


@pytest.mark.slow
def test_a_benchmark_writes_the_differences_of_what_it_ran(tmp_path: Path) -> None:
    write_drives(tmp_path / "test")
    pair = DifferenceSpec(method="DSRC", baseline="plain")
    settings = {"corruption": ("beam_missing",), "differences": (pair,), "family": ("physical", "paper")}
    methods = {"DSRC": [("dsrc", 0), ("dsrc", 1)], "plain": [("attfuse", 0)], "alone": [("no-collaboration", 0)]}
    result = run_plan(make_plan(tmp_path, methods, sweeps=ParameterSweeps(loss=(0.5,)), **settings), tmp_path / "out")
    assert result.frames == {"made up": (2, 2)}
    kept = [entry for entry in result.entries if entry.ranked is not None]
    assert {(entry.case.method, entry.case.loss) for entry in kept} == {("DSRC", 0.0), ("plain", 0.0)}
    names = {block.name for block in write_report(result, tmp_path / "out")}
    wanted = {"differences", "table_1", "table_1_opencood", "figure_5"}
    assert names >= {f"made-up/{name}{suffix}" for name in wanted for suffix in ("", "_paper")}
    assert "made-up/loss" in names and "made-up/loss_paper" not in names
    folder = tmp_path / "out" / "made-up"
    assert all((folder / f"differences{end}").is_file() for end in (".md", ".csv", ".png", "_paper.md", "_paper.png"))
    listed = json.loads((tmp_path / "out" / "results.json").read_text())["differences"]
    assert len(listed) == 2 * 2 * 4  # families x IoU x (clean, beam missing, their mean, mCE)
    for family in ("physical", "paper"):
        rows = {
            (e.case.method, e.case.training): e.row.metrics["ap_bev_50"]
            for e in result.entries
            if (e.case.condition.kind, e.case.condition.family, e.case.loss) == ("beam_missing", family, 0.0)
        }
        one = next(d for d in listed if (d["family"], d["condition"], d["iou"]) == (family, "beam_missing", 0.5))
        difference = (rows["DSRC", 0] + rows["DSRC", 1]) / 2 - rows["plain", 0]
        assert one["difference"] == pytest.approx(difference, abs=1e-12)


def test_stored_differences_are_those_that_were_written(table: DifferenceTable, tmp_path: Path) -> None:
    path = tmp_path / "results.json"
    path.write_text(json.dumps({"differences": [one.listed() for one in table.differences]}))
    stored = stored_differences(path)
    assert [one.listed() | {"seeds": ""} for one in stored.differences] == [
        one.listed() | {"seeds": ""} for one in table.differences
    ]
    assert [row.cells[0] for row in stored.terminal().rows] == ["Clean", "Mean of the corruptions"] * 2
    resolved = any(one.resolved for one in table.differences)
    assert stored.terminal().caption.startswith("Resolved" if resolved else "No difference")
