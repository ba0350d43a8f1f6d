"""A gain place by place."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from dsrc.data.drives import open_drive
from dsrc.evaluation.stored import StoredRun
from studies.dsrc_paper import places
from studies.dsrc_paper.stored_pairs import StoredPairs
from tests.commands import run_study, study
from tests.dsrc.evaluation.small import write_drives
from tests.studies.dsrc_paper.test_score_thresholds import write_results


def write_places(root: Path, places: tuple[str, ...], seeds: tuple[int, ...] = ()) -> tuple[Path, list[Path]]:
    """Write results of a method that finds all and of one of which one training of two does; a drive for each place."""
    drives = write_drives(root / "data", drives=len(places))
    paths = sorted(drives.iterdir())
    for path, place, seed in zip(paths, places, seeds or range(len(places)), strict=True):
        protocol = {"world": {"seed": seed}, "testbed": {"scenario": {"name": place}}}
        (path / "data_protocol.yaml").write_text(yaml.safe_dump({**open_drive(path).protocol, **protocol}))
    rival = {0: (0.5, 0.0), 1: (0.5, 20.0)}
    write_results(root / "toy", drives, {"DSRC": dict.fromkeys((0, 1), (0.3, 0.0)), "rival": rival})
    return root / "toy", paths


def test_a_place_has_the_gain_on_its_own_frames(tmp_path: Path) -> None:
    results, paths = write_places(tmp_path, ("crossing", "crossing", "bend"))
    lines = study("dsrc_paper.places", str(results), "--baseline", "rival").splitlines()
    head, *rows = ([cell.strip() for cell in line.strip("| ").split(" | ")] for line in lines if " --- " not in line)
    assert head == ["place", "drives", "frames", "boxes", "clean, 0.5 / 0.7"]
    *places, by_drive, by_place = rows
    assert [row[:3] for row in places] == [["crossing", "2", "4"], ["bend", "1", "2"]]
    assert [row[4] for row in places] == ["+50.0 / +50.0"] * 2
    boxes = [sum(len(open_drive(path).read(i).truth) for i in (0, 1)) for path in paths]
    assert 0 < sum(int(row[3]) for row in places) == int(by_drive[3]) <= sum(boxes)
    assert by_drive[4] == by_place[4] == "**+50.0 [+50.0, +50.0]** / **+50.0 [+50.0, +50.0]**"
    assert by_place[:3] == ["all, by place", "3", "6"]


def test_of_one_place_nothing_is_known_of_others(tmp_path: Path) -> None:
    results, _ = write_places(tmp_path, ("crossing", "crossing"))
    *_, by_drive, by_place = study("dsrc_paper.places", str(results), "--baseline", "rival").splitlines()
    assert "**+50.0 [+50.0, +50.0]**" in by_drive and by_place.endswith("| +50.0 / +50.0 |")


def test_drives_of_one_run_of_traffic_are_one(tmp_path: Path) -> None:
    results, _ = write_places(tmp_path, ("crossing", "crossing", "bend"), (1, 1, 1))
    *_, by_drive, _ = study("dsrc_paper.places", str(results), "--baseline", "rival").splitlines()
    assert by_drive.startswith("| all, by drive (2 runs of traffic) | 3 |")


def test_places_are_drawn_with_all_their_drives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a gain in all nine drives of one place and none in that of another, places may miss all, drives hardly."""
    results, _ = write_places(tmp_path, (*["crossing"] * 9, "bend"))
    stored, value = StoredPairs.read(results), np.repeat([*[1.0] * 9, 0.0], 2)

    def mean_ap(stored: StoredPairs, runs: list[StoredRun], weights: np.ndarray) -> np.ndarray:
        gain = weights @ value / weights.sum(axis=1) if runs[0].method == "DSRC" else np.zeros(len(weights))
        return np.stack([gain, gain])

    monkeypatch.setattr(places, "mean_ap", mean_ap)
    *_, by_drive, by_place = places.rows_of(stored, stored.pairs("DSRC", "rival"))
    assert by_place[4] == "+90.0 [+0.00, +100.0] / +90.0 [+0.00, +100.0]"
    assert by_drive[4].startswith("**+90.0 [")


def test_a_document_that_is_missing_is_one_line(tmp_path: Path) -> None:
    results, _ = write_places(tmp_path, ("crossing", "bend"))
    found = run_study("dsrc_paper.places", str(results), "--baseline", "rival", "--docs", str(tmp_path / "page.md"))
    assert found.returncode == 2 and found.stderr.endswith("page.md: no such file\n")


def test_an_unknown_method_is_refused(tmp_path: Path) -> None:
    write_results(
        tmp_path / "toy", write_drives(tmp_path / "data"), {"DSRC": {0: (0.3, 0.0)}, "rival": {0: (0.5, 0.0)}}
    )
    found = run_study("dsrc_paper.places", str(tmp_path / "toy"), "--baseline", "other")
    assert found.returncode == 2 and "--baseline: expected one of DSRC, rival, found other" in found.stderr
