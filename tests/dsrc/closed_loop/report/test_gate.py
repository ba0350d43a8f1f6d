"""Gate of a campaign: conditions, the baseline, JUnit."""

import csv
import math
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import msgspec
import numpy as np
import pytest

from dsrc.closed_loop.campaign.episode import EpisodeResult
from dsrc.closed_loop.campaign.run import CampaignResult, results_csv
from dsrc.closed_loop.causes.cause import Cause
from dsrc.closed_loop.report.baseline import changes, read_baseline
from dsrc.closed_loop.report.conditions import Condition, check_conditions, judged
from dsrc.closed_loop.report.findings import Findings
from dsrc.closed_loop.report.gate import Gate, campaign_junit
from dsrc.closed_loop.report.report import markdown, write_report
from dsrc.evaluation.metrics.calibration import reliability
from sim.errors import DataError, SettingsError
from tests.commands import dsrc
from tests.dsrc.closed_loop.results import PLAN, RESULTS, one

RESULT = CampaignResult(PLAN, tuple(RESULTS), (), (), 0, 0.0)


def verdicts(text: str, results: list[EpisodeResult]) -> dict[str, bool]:
    return {found.perception: found.holds for found in judged([Condition.parse(text)], results)}


def test_a_condition_is_about_each_perception_or_the_one_it_names() -> None:
    assert verdicts("crashed<=5%", RESULTS) == {"truth": True, "alone": False, "together": True}
    assert verdicts("together: crashed<=5%", RESULTS) == {"together": True}
    assert verdicts("crashed <= 0.5", RESULTS) == {"truth": True, "alone": True, "together": True}, "3 of 7"


def test_shares_leave_out_what_tells_nothing() -> None:
    results = [one("a", 0, "crashed"), one("a", 1, "desynchronised"), one("a", 2, "perception failed", collision=0.0)]
    (crashed,) = judged([Condition.parse("crashed<=99%")], results)
    assert not crashed.holds and crashed.episodes == 1, "a failed perception is no episode without a crash"
    (arrived,) = judged([Condition.parse("arrived>=1%")], results)
    assert not arrived.holds and arrived.episodes == 2
    (lost,) = judged([Condition.parse("lost<=0.33")], results)
    assert not lost.holds and lost.episodes == 3


def test_what_is_unknown_fails() -> None:
    nothing = [one("a", 0, "desynchronised")]
    assert verdicts("crashed<=100%", nothing) == {"a": False}
    assert verdicts("pdms>=0", [one("a", 0, "arrived")]) == {"a": False}, "a metric that no episode has"
    assert verdicts("pdms>=0.5", [one("a", 0, "arrived", pdms=0.5), one("a", 1, "arrived", pdms=0.5)]) == {"a": True}
    assert verdicts("pdms>0.5", [one("a", 0, "arrived", pdms=0.5)]) == {"a": False}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("crashed=5", "a condition such as"),
        ("crashd<=5%", "did you mean 'crashed'"),
        ("pdms>=5%", "without %"),
        ("crashed<=500%", "0% to 100%"),
        ("pdms>=nan", "a finite number"),
        ("pdms>=much", "a finite number"),
        ("other: crashed<=5%", "a perception of the campaign"),
        ("broken<=0", "--baseline"),
    ],
)
def test_a_bad_condition_is_told_in_one_line(text: str, expected: str) -> None:
    with pytest.raises(SettingsError, match=expected) as told:
        check_conditions([text], ["alone"], has_baseline=False)
    assert str(told.value).startswith("drive: --fail-under: expected ") and "\n" not in str(told.value)


def test_episodes_are_paired_with_those_of_the_baseline() -> None:
    before = [
        one("a", 0, "crashed"),
        one("a", 1, "arrived"),
        one("a", 2, "arrived"),
        one("a", 3, "arrived"),
        one("a", 4, "crashed"),
        one("a", 6, "crashed"),
        one("b", 0, "arrived"),
    ]
    now = [
        one("a", 0, "arrived"),
        one("a", 1, "crashed"),
        one("a", 2, "timeout"),
        one("a", 3, "desynchronised"),
        one("a", 4, "stuck"),
        one("a", 5, "arrived"),
        one("a", 6, "timeout"),
        one("a", 0, "arrived", "fog"),
    ]
    found = changes(now, before)
    kinds = ["fixed", "broken", "broken", "uncounted", "unchanged", "new", "fixed", "new"]
    assert [change.kind for change in found] == [*kinds, "gone"]
    assert not {change.kind for change in changes(before, before)} - {"unchanged"}
    assert [c.holds for c in judged([Condition.parse("broken<=1"), Condition.parse("fixed>=2")], now, found)] == [
        False,
        True,
    ]


def test_a_baseline_may_be_of_older_code(tmp_path: Path) -> None:
    path = tmp_path / "results.csv"
    results = [msgspec.structs.replace(each, key=f"{number:032x}") for number, each in enumerate(RESULTS)]
    path.write_text(results_csv(results))  # it has three metrics
    assert [(each.seed, each.outcome) for each in read_baseline(tmp_path)] == [(r.seed, r.outcome) for r in results]
    twice = [results[0], msgspec.structs.replace(results[0], key="f" * 32)]
    path.write_text(results_csv(twice))
    with pytest.raises(DataError, match="baseline: expected one result of each episode, found two of ima_building"):
        read_baseline(path)
    path.write_text("a,b\n1,2\n")
    with pytest.raises(DataError, match="expected those of results"):
        read_baseline(path)


def test_with_conditions_they_alone_can_fail() -> None:
    results = [
        one("a", 0, "crashed", duration_s=4.5),
        one("a", 1, "desynchronised"),
        one("a", 2, "perception failed"),
        one("a", 3, "timeout"),
    ]
    results = [msgspec.structs.replace(each, key=str(each.seed)) for each in results]
    result = CampaignResult(PLAN, tuple(results), (), (), 0, 0.0)
    bare = ElementTree.fromstring(campaign_junit(result, Gate(), {"0": "seen late"}))
    assert [bare.get(name) for name in ("tests", "failures", "errors", "skipped")] == ["4", "1", "1", "1"]
    crash = bare[0]
    assert crash.get("classname") == "dsrc.drive.ima_building" and crash.get("time") == "4.500"
    assert crash[0].get("message") == "crashed: seen late"
    held, failed = (
        ElementTree.fromstring(campaign_junit(result, Gate.of(result, [Condition.parse(text)], None)))
        for text in ("crashed<=100%", "crashed<=5%")
    )
    assert (held.get("failures"), held.get("errors")) == ("0", "0")
    assert (failed.get("failures"), failed.get("errors")) == ("1", "0")


def test_the_report_begins_with_its_gate() -> None:
    better = [replace_outcome(each, "arrived") if each.perception == "alone" else each for each in RESULTS]
    gate = Gate.of(replace(RESULT, results=tuple(better)), [Condition.parse("broken<=0")], RESULTS)
    assert gate.holds and not math.isnan(gate.verdicts[0].found.value)
    text = markdown(RESULT, Findings(gate))
    assert text.index("## Conditions") < text.index("## Against the baseline") < text.index("## All scenarios")
    assert "| alone | clean | 3 | 0 | 0 | 0 | 0 | 0 | -100 %" in text
    assert "Conditions" not in markdown(RESULT)


def replace_outcome(each: EpisodeResult, outcome: str) -> EpisodeResult:
    metrics = each.metrics | {"collision": float(outcome == "crashed")}
    return msgspec.structs.replace(each, outcome=outcome, metrics=metrics)


def test_the_command_exits_with_1_where_a_condition_fails(tmp_path: Path) -> None:
    words = ["drive", "four_way", "--perception", "truth", "--duration-s", "1", "--workers", "1"]
    first = dsrc(*words, "--out", str(tmp_path / "old"), "--fail-under", "arrived>=100%", "crashed<=0%")
    assert first.returncode == 1 and first.stderr.endswith("1 of 2 conditions fail\n")
    again = [*words, "--out", str(tmp_path / "old"), "--baseline", str(tmp_path / "old")]
    second = dsrc(*again, "--fail-under", "broken<=0", "--junit", str(tmp_path / "drive.xml"))
    assert second.returncode == 0, second.stderr
    cases = ElementTree.parse(tmp_path / "drive.xml").findall(".//testcase")
    assert [case.get("name") for case in cases] == ["broken<=0, truth", "seed 0"]


def test_causes_stand_in_a_table_a_plot_and_a_file(tmp_path: Path) -> None:
    crashed = [msgspec.structs.replace(one("alone", seed, "crashed"), key=str(seed)) for seed in range(3)]
    crashed += [msgspec.structs.replace(one("alone", 0, "crashed", "fog"), key="3")]
    causes = {
        "0": Cause(kind="missed", sentence="missed: the car 1001", chance_s=1.5),
        "1": Cause(kind="seen late", sentence="seen late by 200 ms: the car 1001", late_s=0.2),
        "3": Cause(kind="missed", sentence="missed: the car 1002"),
    }
    result = CampaignResult(PLAN, tuple(crashed), (), (), 0, 0.0)
    write_report(result, tmp_path, Findings(causes=causes))
    text = (tmp_path / "report.md").read_text()
    assert "| alone | clean | 2 | 1 | 1 |\n| alone | fog 3 | 1 | 1 | 0 |" in text.replace("fog, severity 3", "fog 3")
    assert (tmp_path / "shares.png").stat().st_size > 1000
    lines = list(csv.DictReader((tmp_path / "causes.csv").read_text().splitlines()))
    assert [(line["seed"], line["kind"], line["late_s"]) for line in lines] == [
        ("0", "missed", ""),
        ("1", "seen late", "0.2"),
        ("0", "missed", ""),
    ]
    write_report(result, tmp_path)
    assert not (tmp_path / "causes.csv").exists() and not (tmp_path / "shares.png").exists()


def test_calibration_stands_in_a_table_and_a_plot_of_who_has_scores(tmp_path: Path) -> None:
    driven = [
        msgspec.structs.replace(one(name, seed, "arrived"), key=f"{name} {seed}")
        for name in ("alone", "truth")
        for seed in (0, 1)
    ]
    right = np.array([True, False])
    curves = {f"alone {seed}": reliability(np.array([0.9, 0.9]), right) for seed in (0, 1)}
    curves["truth 0"] = reliability(np.ones(2), np.ones(2, bool))
    result = CampaignResult(PLAN, tuple(driven), (), (), 0, 0.0)
    write_report(result, tmp_path, Findings(calibrations=curves))
    rows = [line for line in (tmp_path / "report.md").read_text().splitlines() if line.endswith("40 % |")]
    assert rows == ["| alone | clean | 2 | 4 | 50 % | 40 % |"]
    assert (tmp_path / "reliability.png").stat().st_size > 1000
    write_report(result, tmp_path)
    assert not (tmp_path / "reliability.png").exists()
