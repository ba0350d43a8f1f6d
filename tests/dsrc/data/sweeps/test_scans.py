"""Folders of scans: order and times by the names of files, and boxes beside them."""

import json
from pathlib import Path

import numpy as np
import pytest

from dsrc.data.drives import Drive, open_drives
from sim.errors import DataError
from tests.dsrc.data.sweeps.scene import FRAMES, instant
from tests.dsrc.data.sweeps.trees import scans


def numbered(folder: Path, *names: str) -> Drive:
    """Scans by the names given, of which the n-th has its first point n m before the sensor."""
    folder.mkdir()
    for place, name in enumerate(names):
        points = instant(0).points[:200].copy()
        points[0] = [1.0 + place, 0.0, 0.0, 0.5]
        np.save(folder / f"{name}.npy", points)
    (drive,) = open_drives(folder)
    return drive


def order(drive: Drive) -> list[float]:
    return [float(drive.read(i).agents[0].sweep.points[0, 0]) for i in range(len(drive))]


@pytest.mark.parametrize(
    "names",
    [
        ("1700000000.850000000", "1700000000.950000000", "1700000001.050000000"),  # seconds.nanoseconds of ROS
        ("1700000000.85", "1700000000.95", "1700000001.05"),
        ("lidar_1700000000_850000000", "lidar_1700000000_950000000", "lidar_1700000001_050000000"),
        ("1700000000850000000", "1700000000950000000", "1700000001050000000"),  # nanoseconds
        ("1700000000850000", "1700000000950000", "1700000001050000"),
    ],
)
def test_times_in_names_are_those_of_the_scans(tmp_path: Path, names: tuple[str, ...]) -> None:
    drive = numbered(tmp_path / "scans", *names)
    assert order(drive) == [1.0, 2.0, 3.0]
    assert [drive.read(i).time_s for i in range(3)] == pytest.approx([0.0, 0.1, 0.2])


def test_a_date_before_a_number_is_no_time(tmp_path: Path) -> None:
    drive = numbered(tmp_path / "scans", "2023101512_000001", "2023101512_000002")
    assert [drive.read(i).index for i in range(2)] == [1, 2]


def test_boxes_of_other_scans_leave_a_single_one_unlabelled(tmp_path: Path) -> None:
    folder = scans(tmp_path) / "scans"
    file = folder / "boxes.json"
    file.write_text(json.dumps({"frames": json.loads(file.read_text())["frames"][:1]}))
    (drive,) = open_drives(folder / "0001.npy")
    assert len(drive.read(0).truth) == 0


def test_names_that_share_their_last_number_are_in_the_order_of_the_first(tmp_path: Path) -> None:
    drive = numbered(tmp_path / "scans", *(f"{number}_lidar0" for number in range(12)))
    assert order(drive) == [1.0 + number for number in range(12)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"yaw": 90.0}, r"boxes of frame 0: expected radians within 2 pi, found 90 in row 0; is it in degrees\?"),
        ({"frame": 1}, "frames: expected each frame once, found 1 twice"),
        ({"all": 100}, rf"frames: expected numbers of the scans, from 0 to {FRAMES - 1}, found 100 to"),
    ],
)
def test_boxes_that_cannot_be_meant_are_refused(tmp_path: Path, change: dict[str, float], message: str) -> None:
    file = scans(tmp_path) / "scans" / "boxes.json"
    content = json.loads(file.read_text())
    first = content["frames"][0]
    first["frame"] = change.get("frame", 0)
    first["boxes"][0][6] = change.get("yaw", 0.0)
    for frame in content["frames"]:
        frame["frame"] += change.get("all", 0)
    file.write_text(json.dumps(content))
    (drive,) = open_drives(tmp_path / "scans")
    with pytest.raises(DataError, match=message):
        drive.read(0)


def test_a_byte_order_mark_is_none_of_the_text(tmp_path: Path) -> None:
    file = scans(tmp_path) / "scans" / "boxes.json"
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    (tmp_path / "scans" / "scans.toml").write_bytes(b"\xef\xbb\xbfheight = 1.5\n")
    (drive,) = open_drives(tmp_path / "scans")
    frame = drive.read(0)
    assert len(frame.truth) == len(instant(0).boxes)
    assert frame.agents[0].sweep.world_from_lidar[2, 3] == 1.5
