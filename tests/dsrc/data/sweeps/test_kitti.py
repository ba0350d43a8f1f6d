from pathlib import Path

import numpy as np
import pytest

from dsrc.data.datasets.check import check_dataset
from dsrc.data.datasets.convert import convert
from dsrc.data.datasets.corrupt import corrupt_dataset
from dsrc.data.drives import list_drives, open_drive, open_drives
from dsrc.data.sample import SampleRequest, make_sample
from dsrc.data.write import write_drive
from dsrc.ops.grid import GridSpec
from sim.boxes import Boxes
from sim.errors import DataError, notice
from tests.dsrc.data.sweeps.scene import FRAMES, HEIGHT_M, instant
from tests.dsrc.data.sweeps.trees import kitti_object
from tests.dsrc.data.toy import SETTINGS, ToySource


def test_kitti_frames_have_the_files_points_and_boxes(tmp_path: Path) -> None:
    drive = open_drives(kitti_object(tmp_path))[0]
    assert (drive.format, drive.agents, drive.frames) == ("KITTI object", (0,), tuple(range(FRAMES)))
    for i in range(FRAMES):
        frame, now = drive.read(i), instant(i)
        sweep = frame.agents[0].sweep
        assert np.array_equal(sweep.points, now.points[:, :3])
        assert np.array_equal(sweep.intensity, now.points[:, 3])
        # The world of a frame is its own, with the ground at 0. Labels are upright in the camera's frame, which is
        # tilted by 3 mrad.
        assert np.allclose(frame.truth.center - [0.0, 0.0, HEIGHT_M], now.local.center, atol=3e-3)
        assert np.allclose(frame.truth.array[:, 3:], now.local.array[:, 3:], atol=3e-3)
        assert frame.truth.label.tolist() == now.local.label.tolist()
        assert (frame.points_on >= 100).all()
    assert check_dataset(tmp_path) == []


def test_boxes_out_of_the_picture_and_in_dont_care_are_not_judged(tmp_path: Path) -> None:
    everywhere = "DontCare -1 -1 -10 0 0 1242 375 -1 -1 -1 -1000 -1000 -1000 -10\n"
    behind = Boxes.from_array([[-12.0, 0.0, 0.75, 4.0, 1.8, 1.5, 0.0], [12.0, -1.5, 0.75, 4.0, 1.8, 1.5, 0.0]])
    open_region = open_drives(kitti_object(tmp_path / "a"))[0].read(0).region
    shut_region = open_drives(kitti_object(tmp_path / "b", everywhere))[0].read(0).region
    assert open_region is not None
    assert shut_region is not None
    assert open_region.counts(behind).tolist() == [False, True]
    assert shut_region.counts(behind).tolist() == [False, False]


def test_misc_is_neither_found_nor_missed(tmp_path: Path) -> None:
    car = (kitti_object(tmp_path / "a") / "training/label_2/000000.txt").read_text().splitlines()[0]
    frame = open_drives(kitti_object(tmp_path / "b", car.replace("Car", "Misc") + "\n"))[0].read(0)
    assert len(frame.truth) == 2
    assert frame.region is not None
    assert frame.region.counts(frame.truth).tolist() == [False, True]


def test_types_that_kitti_lacks_and_a_missing_calibration_are_told_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    notice.cache_clear()
    car = (kitti_object(tmp_path / "a") / "training/label_2/000000.txt").read_text().splitlines()[0]
    tree = kitti_object(tmp_path / "b", car.replace("Car", "Rickshaw") + "\n")
    drive = open_drives(tree)[0]
    known, told = drive.read(0).truth, [f"{tree}/training/label_2: objects of type Rickshaw, which KITTI does not have"]
    (tree / "training/calib/000000.txt").unlink()
    told += [f"{tree}/training/calib: a calibration is missing"]
    truths = [open_drives(tree)[0].read(i).truth for i in (0, 0, 1)]
    assert [text.partition(", are")[0].partition(": labels")[0] for text in caplog.messages] == told
    assert [len(truth) for truth in (known, *truths)] == [2] * 4
    # The nominal camera is KITTI's to within 0.1 m, and 0.5 degrees.
    assert 0.01 < np.abs(truths[0].center - known.center).max() < 0.3


def test_a_sample_holds_the_judged_vehicles_of_a_frame(tmp_path: Path) -> None:
    grid = GridSpec((-51.2, -25.6, -3.0, 51.2, 25.6, 3.0))
    frame = open_drives(kitti_object(tmp_path))[0].read(0)
    sample = make_sample(frame, None, SampleRequest(grid))
    assert np.allclose(sample.boxes.array, instant(0).local.array[:1], atol=3e-3)
    assert sample.region is not None
    assert sample.region.counts(sample.boxes).all()


def test_a_tree_without_labels_is_a_drive_without_truth(tmp_path: Path) -> None:
    tree = kitti_object(tmp_path)
    for path in (tree / "training" / "label_2").iterdir():
        path.unlink()
    drive = open_drives(tree)[0]
    assert not drive.labelled(0)
    assert len(drive.read(0).truth) == 0


def test_a_corrupted_tree_keeps_its_layout(tmp_path: Path) -> None:
    tree = kitti_object(tmp_path / "tree")
    corrupt_dataset(data=tree, out=tmp_path / "foggy", corruption="fog")
    assert len(list((tmp_path / "foggy" / "training" / "velodyne").glob("*.bin"))) == FRAMES


def test_our_own_tree_comes_back_equal(tmp_path: Path) -> None:
    data = tmp_path / "data"
    write_drive(data / "toy_3", {**SETTINGS, "frames": 2}, ToySource().open)
    convert(data=data, out=tmp_path / "kitti", to="kitti", view="around")
    drive, back = open_drives(data)[0], open_drives(tmp_path / "kitti")[0]
    assert len(back) == len(drive)
    for i in range(len(drive)):
        frame, again = drive.read(i), back.read(i)
        ego, sweep = frame.agents[0], again.agents[0].sweep
        assert np.array_equal(sweep.points, ego.sweep.points)
        assert np.array_equal(sweep.intensity, ego.sweep.intensity)
        assert np.abs(sweep.world_from_lidar - ego.sweep.world_from_lidar).max() <= 1e-9
        assert again.time_s == frame.time_s
        assert again.region is None
        seen = frame.truth[(frame.points_on[0] >= 1) & (frame.truth.object_id != ego.agent_id)]
        assert len(seen) == len(again.truth) > 0
        order = np.argsort(seen.center[:, 0])
        found = again.truth[np.argsort(again.truth.center[:, 0])]
        assert np.abs(found.center - seen.center[order]).max() < 1e-6
        assert np.abs(found.size - seen.size[order]).max() < 1e-6


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("velodyne/000000.bin", b"\0" * 15, "whole points of 16 bytes, found 15 bytes"),
        ("velodyne/000000.bin", np.array([0, 0, 1, 7], "<f4").tobytes(), "intensity: expected 0 to 1, found 7"),
        ("velodyne/000000.bin", np.array([0, 0, np.nan, 1], "<f4").tobytes(), "finite coordinates, found 1 of 1"),
        ("label_2/000000.txt", b"Car 1 2\n", "line 1: expected 15 columns, found 3"),
        ("calib/000000.txt", b"P2: 1 2\n", "R0_rect: expected a line of numbers"),
    ],
)
def test_a_damaged_file_is_one_line(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    tree = kitti_object(tmp_path)
    (tree / "training" / name).write_bytes(content)
    with pytest.raises(DataError, match=message):
        open_drive(list_drives(tree)[0]).read(0)
