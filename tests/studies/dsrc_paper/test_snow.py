"""Snow is taken apart line by line, of the same cells as an evaluation's."""

import csv
from pathlib import Path

import numpy as np
import pytest

from dsrc.evaluation.evaluate import evaluate_drives
from dsrc.evaluation.results import CLEAN, find_row
from dsrc.options.detection import Evaluation
from sensors.corruptions import Condition
from sensors.sweep import SCATTERED
from studies.dsrc_paper.snow import TALL_M, Changed, heights
from tests.commands import study
from tests.dsrc.evaluation.small import write_detector, write_drives
from tests.sensors.corruptions.frames import frame


@pytest.mark.slow
def test_lines_are_those_of_an_evaluation_and_a_second_run_has_them_all(tmp_path: Path) -> None:
    drives, detector = write_drives(tmp_path / "data"), write_detector(tmp_path / "detector.pt", "attfuse")
    arguments = ("--data", str(drives), "--out", str(tmp_path / "out"), "--checkpoint", str(detector))
    printed = study("dsrc_paper.snow", *arguments)
    with (tmp_path / "out" / "snow.csv").open(encoding="utf-8") as file:
        file.readline()  # provenance
        lines = {line["line"]: line for line in csv.DictReader(file)}
    rows = evaluate_drives(
        Evaluation(checkpoint=(str(detector),), data=drives, out=tmp_path / "evaluated", corruption=(CLEAN,))
    )
    for who, name in (("team", "detector"), ("alone", "detector, ego alone")):
        row = find_row(rows, name, CLEAN)
        assert row is not None
        assert abs(float(lines["clear air"][f"{who}_0.5"]) - 100.0 * row.metrics["ap_bev_50"]) < 1e-6
    assert float(lines["clear air"]["team_0.5"]) > 0.0
    cells = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "cells").iterdir()}
    assert study("dsrc_paper.snow", *arguments) == printed
    assert {path: path.stat().st_mtime_ns for path in cells} == cells


def test_an_edit_changes_the_flakes_alone() -> None:
    whole = Condition("snow", 5).apply(frame(), 7)
    flakes = [agent.sweep.fate == SCATTERED for agent in whole.agents]
    assert all(mask.any() for mask in flakes)
    for edit in ("bare", "low", "laid"):
        made = Changed("snow", 5, edit=edit).apply(frame(), 7)
        for before, after, mask in zip(whole.agents, made.agents, flakes, strict=True):
            left = after.sweep.fate == SCATTERED
            assert np.array_equal(after.sweep.points[~left], before.sweep.points[~mask])
            if edit == "bare":
                assert not left.any()
            elif edit == "low":
                assert np.count_nonzero(left) == np.count_nonzero(mask & (heights(before) < TALL_M))
            else:
                assert np.abs(heights(after)[left]).max() < 1e-4
                assert np.array_equal(after.sweep.points[left, :2], before.sweep.points[mask, :2])
