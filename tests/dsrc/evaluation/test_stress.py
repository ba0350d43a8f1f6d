"""A stress test ranks what breaks a detector, names critical severities and worst frames, and fails for CI."""

import json
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from dsrc.evaluation.evaluate import evaluate_drives
from dsrc.evaluation.results import find_row
from dsrc.evaluation.stored import read_index
from dsrc.evaluation.stress import Stress, StressRow, junit, stress, stress_table
from dsrc.options.detection import Evaluation, Stressing
from dsrc.review.page.output.worst import worst_pages
from sim.errors import SettingsError
from tests.commands import dsrc
from tests.dsrc.data.sweeps.trees import kitti_object
from tests.dsrc.evaluation.small import write_detector, write_drives


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("stress")
    write_drives(root / "data", drives=2)
    write_detector(root / "small.pt", "attfuse")
    return root


def config_of(world: Path, out: str = "out", **settings: object) -> Stressing:
    chosen = {"data": world / "data", "corruption": ("point_dropping", "pose_error"), "severity": (1, 5), **settings}
    return Stressing(detector=str(world / "small.pt"), out=world / out, **chosen)


@pytest.fixture(scope="module")
def found(world: Path) -> Stress:
    return stress(config_of(world))


def row(kind: str, severity: int, ap: float, who: str = "all") -> StressRow:
    return StressRow(kind, who, severity, ap, ap - 0.1, ap + 0.1, 0.5, 0.1, ())


def test_every_condition_has_a_row_and_the_numbers_of_an_evaluation(found: Stress, world: Path) -> None:
    conditions = {(one.corruption, one.who, one.severity) for one in found.rows}
    groups = {("point_dropping", who) for who in ("all", "ego", "helpers")}
    groups |= {("pose_error", who) for who in ("all", "helpers")}  # an ego has no error relative to itself
    assert conditions == {("clean", "", 0)} | {(kind, who, level) for kind, who in groups for level in (1, 5)}
    rows = evaluate_drives(
        Evaluation(
            checkpoint=(str(world / "small.pt"),),
            data=world / "data",
            out=world / "evaluated",
            corruption=("point_dropping",),
            severity=5,
            ego_alone=False,
        )
    )
    for kind in ("clean", "point_dropping"):
        mine = next(one for one in found.rows if (one.corruption, one.who, one.severity) in
                    ((kind, "", 0), (kind, "all", 5)))  # fmt: skip
        assert mine.ap == find_row(rows, "small", kind).metrics["ap_bev_50"]
        assert mine.low <= mine.ap <= mine.high and 0 <= mine.calibration_error <= 1


def test_the_folder_opens_and_a_second_run_computes_nothing(found: Stress, world: Path) -> None:
    assert len(read_index(world / "out").runs) == len(found.rows)
    assert {"results.json", "stress.csv", "stress.md", "stress.png"} <= {
        path.name for path in (world / "out").iterdir()
    }
    steps: list[int] = []
    again = stress(config_of(world), progress=lambda done, of: steps.append(of))
    assert not any(steps) and again.rows == found.rows and again.worst == found.worst


def test_worst_frames_lose_most_and_have_a_page(found: Stress, world: Path) -> None:
    assert found.worst and [one.harm for one in found.worst] == sorted((one.harm for one in found.worst), reverse=True)
    assert len({(one.drive, one.position) for one in found.worst}) == len(found.worst)
    pages = worst_pages(world / "out", found)
    assert pages and all(b"__REVIEW__" in page.read_bytes() for page in pages)


def test_the_critical_severity_is_the_least_below_the_share_of_clean() -> None:
    rows = (
        row("clean", 0, 0.8, ""),
        *(row("fog", level, ap) for level, ap in ((1, 0.7), (2, 0.5), (3, 0.3), (4, 0.5))),
    )
    found = Stress("x", (*rows, row("snow", 1, 0.1), row("rain", 1, 0.79)), (), 0.5, {})
    assert {kind: found.critical(own) for (kind, _), own in found.curves().items()} == {
        "snow": 1,
        "fog": 3,
        "rain": None,
    }
    assert [line.label for line in stress_table(found).rows] == ["clean", "snow", "fog", "rain"]


def test_junit_names_what_failed() -> None:
    found = Stress("x", (row("clean", 0, 0.8, ""), row("fog", 3, 0.3), row("snow", 3, float("nan"))), (), 0.5, {})
    suite = ElementTree.fromstring(junit(found, 0.4))
    assert (suite.get("tests"), suite.get("failures")) == ("3", "2")
    names: Iterator[str] = (case.get("name", "") for case in suite if case.find("failure") is not None)
    assert list(names) == ["fog 3 all", "snow 3 all"]
    assert ElementTree.fromstring(junit(found, None)).get("failures") == "0"


def test_the_command_exits_with_1_below_the_bound(found: Stress, world: Path) -> None:
    words = ["stress", str(world / "small.pt"), str(world / "data"), "--out", str(world / "out"), "--no-pages"]
    words += ["--corruption", "point_dropping", "pose_error", "--severity", "1", "5", "--workers", "1"]
    bad = dsrc(*words, "--fail-under", "1.1", "--junit", str(world / "stress.xml"))
    assert bad.returncode == 1 and "conditions are below AP 1.1" in bad.stderr
    assert dsrc(*words, "--fail-under", "0", "--junit", str(world / "stress.xml")).returncode == 0


@pytest.mark.slow
def test_a_fault_is_a_line_without_severities_and_with_the_numbers_of_its_corruption(world: Path) -> None:
    mixed = "point_dropping:5 on helpers + loss:1"
    config = config_of(
        world, "faults", severity=(5,), corruption=("point_dropping",), fault=("point_dropping:5", mixed)
    )
    found = stress(config)
    rows = {(one.corruption, one.who, one.severity): one.ap for one in found.rows}
    assert rows["point_dropping:5", "", 0] == rows["point_dropping", "all", 5] != rows[mixed, "", 0]
    line = next(line for line in stress_table(found).rows if line.label == mixed)
    assert line.cells[:2] == ("", "-") and line.cells[3] == "-"
    names = [case.get("name") for case in ElementTree.fromstring(junit(found, None))]
    assert names[0] == "clean" and {mixed, "point_dropping 5 all"} <= set(names)


def test_settings_out_of_range_are_refused(world: Path) -> None:
    with pytest.raises(SettingsError, match=r"stress: share: expected more than 0, less than 1, found 1\.5"):
        stress(config_of(world, "x", share=1.5))
    assert not (world / "x").exists()


def test_drives_of_one_agent_have_no_groups_of_agents(world: Path) -> None:
    data = kitti_object(world / "kitti")
    config = Stressing(
        detector=str(world / "small.pt"), data=data, out=world / "alone", corruption=("point_dropping",), severity=(5,)
    )
    assert [(one.corruption, one.who) for one in stress(config).rows] == [("clean", ""), ("point_dropping", "all")]


@pytest.mark.parametrize("command", ["stress", "benchmark"])
def test_a_named_corruption_that_the_sweeps_do_not_take_is_refused_before_the_work(world: Path, command: str) -> None:
    """Points of a KITTI tree have no rings, and those of this one no comb of elevations either."""
    data, out = kitti_object(world / command), world / f"refused_{command}"
    detector = [str(world / "small.pt"), str(data)]
    words = detector if command == "stress" else ["--checkpoint", detector[0], "--data", detector[1]]
    done = dsrc(command, *words, "--out", str(out), "--corruption", "fog", "beam_missing", "--workers", "1")
    assert done.returncode == 2
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("dsrc: ")]
    assert "frame 0: agent" in line and "beam_missing: expected points with their rings" in line
    assert not (out / "cells").exists()


def test_a_corruption_of_a_group_that_the_sweeps_do_not_take_is_left_out(
    world: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = kitti_object(world / "ringless")
    given = {"data": data, "corruption": ("paper_six",), "severity": (5,), "frames": 1}
    rows = stress(config_of(world, "group", **given)).rows
    kinds = {one.corruption for one in rows}
    assert "beam_missing" not in kinds and {"clean", "fog"} <= kinds
    assert "stress: leaves out beam_missing" in caplog.text
    # One frame has no interval, and what is not known is null.
    written = json.loads((world / "group" / "results.json").read_text())["rows"]
    assert all(np.isnan(row.low) for row in rows) and [row["low"] for row in written] == [None] * len(rows)
