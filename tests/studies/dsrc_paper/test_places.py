"""A gain place by place."""

from pathlib import Path

import yaml

from dsrc.data.drives import open_drive
from tests.commands import run_study, study
from tests.dsrc.evaluation.small import write_drives
from tests.studies.dsrc_paper.test_score_thresholds import write_results


def test_a_place_has_the_gain_on_its_own_frames_and_all_have_intervals(tmp_path: Path) -> None:
    """Two drives are of one place, another is of its own; of the rival's two trainings one finds nothing."""
    drives = write_drives(tmp_path / "data", drives=3)
    paths = sorted(drives.iterdir())
    for path, (place, seed) in zip(paths, (("crossing", 1), ("crossing", 2), ("bend", 1)), strict=True):
        protocol = {"world": {"seed": seed}, "testbed": {"scenario": {"name": place}}}
        (path / "data_protocol.yaml").write_text(yaml.safe_dump({**open_drive(path).protocol, **protocol}))
    write_results(
        tmp_path / "toy", drives, {"DSRC": dict.fromkeys((0, 1), (0.3, 0.0)), "rival": {0: (0.5, 0.0), 1: (0.5, 20.0)}}
    )
    lines = study("dsrc_paper.places", str(tmp_path / "toy"), "--baseline", "rival").splitlines()
    head, *rows = ([cell.strip() for cell in line.strip("| ").split(" | ")] for line in lines if " --- " not in line)
    assert head == ["place", "drives", "frames", "boxes", "clean, 0.5 / 0.7"]
    *places, by_drive, by_place = rows
    assert [row[:3] for row in places] == [["crossing", "2", "4"], ["bend", "1", "2"]]
    assert [row[4] for row in places] == ["+50.0 / +50.0"] * 2
    boxes = [sum(len(open_drive(path).read(i).truth) for i in (0, 1)) for path in paths]
    assert sum(int(row[3]) for row in places) == int(by_drive[3]) <= sum(boxes)
    assert by_drive[4] == "**+50.0 [+50.0, +50.0]** / **+50.0 [+50.0, +50.0]**"
    assert by_place[:3] == ["all, by place", "3", "6"]


def test_an_unknown_method_is_refused(tmp_path: Path) -> None:
    write_results(
        tmp_path / "toy", write_drives(tmp_path / "data"), {"DSRC": {0: (0.3, 0.0)}, "rival": {0: (0.5, 0.0)}}
    )
    found = run_study("dsrc_paper.places", str(tmp_path / "toy"), "--baseline", "other")
    assert found.returncode == 2 and "--baseline: expected one of DSRC, rival, found other" in found.stderr
