"""Results: the tables and the quoted numbers of the pages are those of the committed result files."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

from studies.numbers import FILE, PAGES, QUOTED, numbers
from tests.paths import ROOT

PAPER = ROOT / "studies/dsrc_paper"


def test_the_numbers_are_those_of_the_result_files() -> None:
    assert json.loads(FILE.read_text(encoding="utf-8")) == numbers()


@pytest.mark.parametrize("page", PAGES)
def test_a_page_quotes_numbers_as_they_are(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    known = json.loads(FILE.read_text(encoding="utf-8"))
    quoted = QUOTED.findall(text)
    assert len(quoted) == text.count("<!--n:")
    assert [(name, value) for name, value in quoted if known[name] != value] == []


@pytest.mark.parametrize(("page", "words"), {"docs/results.md": 1200, "docs/closed_loop.md": 3000}.items())
def test_a_page_is_short(page: str, words: int) -> None:
    assert len((ROOT / page).read_text(encoding="utf-8").split()) <= words


def test_verdicts_are_those_of_their_intervals() -> None:
    text = (ROOT / "docs/results.md").read_text(encoding="utf-8")
    told = {"resolved": 0, "not resolved": 0, "the opposite is resolved": 0}
    for line in (line for line in text.splitlines() if line.startswith("| ") and line.count(" | ") == 3):
        claim, measured, _, verdict = line.strip("| ").split(" | ")
        ours, _, twins = measured.partition("; the plain twin")
        said = verdict.removeprefix("DSRC: ").removeprefix("arrivals: ")
        kind = next((kind for kind in told if said.startswith(kind)), None)
        bounds = intervals(ours)
        if not bounds or kind is None:
            continue
        told[kind] += 1
        sides = {"resolved": {1}, "not resolved": {0}, "the opposite is resolved": {-1}}[kind]
        assert {side(*pair) for pair in bounds} == sides, claim
        if twins:
            assert [side(*pair) for pair in intervals(twins)] == [-1, 0] and "its twin pays a point at 0.5" in verdict
        if "From 0.2 behind, published at 0.5 only" in verdict:
            assert [side(*pair) for pair in intervals(verdict)] == [-1, 0, -1, -1, 1, 1]
    assert told == {"resolved": 5, "not resolved": 4, "the opposite is resolved": 1}


def intervals(text: str) -> list[tuple[float, float]]:
    """Return the intervals of a text, in order."""
    return [(float(low), float(high)) for low, high in re.findall(r"\[(-?[\d.]+), (-?[\d.]+)\]", text)]


def side(low: float, high: float) -> int:
    """Return the side of 0 on which an interval lies, 0 where it holds it."""
    return int(low > 0.0) - int(high < 0.0)


def test_the_zoo_has_every_kept_detector_with_its_hash() -> None:
    table = (ROOT / "docs/zoo.md").read_text().partition("<!-- begin zoo -->\n")[2].partition("\n<!-- end zoo -->")[0]
    rows = [line.strip("| ").split(" | ") for line in table.splitlines()[2:]]
    kept = dict(
        reversed(line.split()) for line in (ROOT / "studies/dsrc_paper/weights.sha256").read_text().splitlines()
    )
    detectors = {name.split("/")[0]: digest[:12] for name, digest in kept.items() if name.endswith("/detector.pt")}
    assert {row[0]: row[-1].strip("`") for row in rows} == detectors


def rows_of(file: Path) -> list[dict[str, str]]:
    """Return the rows of a benchmark's results: a training under a condition each."""
    lines = file.read_text(encoding="utf-8").splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


def test_the_gain_from_the_usual_score_is_the_one_of_the_twins_results() -> None:
    page = (PAPER / "report.md").read_text(encoding="utf-8")
    block = page.partition("<!-- begin score_thresholds_twins -->\n")[2].partition("<!-- end")[0]
    shown = {row[0]: row[1].strip("*") for row in (line.strip("| ").split(" | ") for line in block.splitlines()[2:])}
    rows = rows_of(PAPER / "report/dsrc-sim-twins/results.csv")
    whole = {
        "clean": ("physical", True),
        "mean of the corruptions as published": ("paper", False),
        "mean of our corruptions": ("physical", False),
    }
    for title, (family, clean) in whole.items():
        among = [row for row in rows if row["family"] == family and (row["condition"] == "clean") is clean]
        for iou in (50, 70):
            ours, plain = (
                np.mean([float(row[f"ap_opencood_bev_{iou}"]) for row in among if row["method"] == name])
                for name in ("DSRC", "AttFuse (plain student)")
            )
            value = shown[f"{title}, {iou / 100:g}"].partition(" ")[0]
            assert float(value) == pytest.approx(100.0 * (ours - plain), abs=0.051)


def test_every_table_that_a_page_names_is_closed() -> None:
    for page in (*PAGES, "studies/dsrc_paper/report.md", "studies/closed_loop/report.md"):
        text = (ROOT / page).read_text(encoding="utf-8")
        assert re.findall(r"<!-- begin (\S+) -->", text) == re.findall(r"<!-- end (\S+) -->", text), page
