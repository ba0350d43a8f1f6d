"""The table of a split counts what an evaluation is of, and takes its place in a document."""

from pathlib import Path

import numpy as np
import pytest

from dsrc.data.drives import open_drive
from dsrc.data.write import write_drive
from dsrc.ops.grid import GridSpec
from dsrc.training.recipes import small
from studies.dsrc_paper.drive_table import GRID, count, main, table
from tests.dsrc.data.toy import PLACES, SETTINGS, ToySource, truth_at


@pytest.fixture(scope="module")
def split(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("toy") / "test"
    write_drive(folder / "toy_3", SETTINGS, ToySource().open)
    return folder


def test_a_row_counts_boxes_in_range_and_those_that_only_helpers_see(split: Path) -> None:
    drive = open_drive(split / "toy_3")
    row = count(drive, GRID)
    frames = [drive.read(i) for i in range(len(drive))]
    # Of the toy's vehicles the ego is no box of its own and one is far away: truck, car and bus are left.
    near = [1001, 1002, 1004]
    seen = [frame.points_on[:, np.isin(frame.truth.object_id, near)] >= 1 for frame in frames]
    # The car 1002 is an agent, whose returns on itself make no box.
    for part in seen:
        part[1, 1] = False
    assert (row.drive, row.frames, row.vehicles, row.roadside) == ("toy_3", 5, 2, 1)
    assert row.boxes == sum(int(part.any(axis=0).sum()) for part in seen) > 0
    assert row.unseen == sum(int((part.any(axis=0) & ~part[0]).sum()) for part in seen)
    path = np.linalg.norm(truth_at(4).center[0, :2] - PLACES[0])
    assert row.path_m == pytest.approx(path, abs=0.05)


def test_a_narrower_range_holds_fewer_boxes(split: Path) -> None:
    drive = open_drive(split / "toy_3")
    wide, narrow = count(drive, GRID), count(drive, GridSpec(range_m=(-22.0, -25.6, -3.0, 51.2, 25.6, 2.6)))
    # The bus is 25 m behind the ego.
    assert wide.boxes - narrow.boxes == len(drive)


def test_the_last_line_of_a_table_is_its_sum(split: Path) -> None:
    row = count(open_drive(split / "toy_3"), GRID)
    lines = table([row, row]).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert len({len(line) for line in cells}) == 1
    assert cells[2][:4] == ["`toy_3`", "5", "2 + 1 roadside", f"{row.boxes}"]
    assert cells[-1][:2] == ["2 drives", "10"] and cells[-1][3] == f"{2 * row.boxes}"
    assert cells[-1][4] == cells[2][4]


def test_a_table_goes_between_its_markers_and_nowhere_else(split: Path, tmp_path: Path) -> None:
    document = tmp_path / "page.md"
    document.write_text("before\n<!-- begin toy/drives -->\nold\n<!-- end toy/drives -->\nafter\n")
    main([str(split), "--docs", str(document), "--name", "toy"])
    first = document.read_text()
    assert first.startswith("before\n<!-- begin") and first.endswith("-->\nafter\n")
    assert "old" not in first and "| `toy_3` |" in first
    main([str(split), "--docs", str(document), "--name", "toy"])
    assert document.read_text() == first


def test_a_mistake_is_one_line_and_exit_code_2(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main([str(tmp_path / "nowhere")])
    assert caught.value.code == 2
    assert capsys.readouterr().err == f"drive_table: {tmp_path / 'nowhere'}: no such folder\n"


def test_boxes_are_counted_in_the_range_of_the_recipe_of_the_tables() -> None:
    assert small().model.grid == GRID
