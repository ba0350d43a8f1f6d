import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from dsrc.data.datasets.convert import convert
from dsrc.data.formats.kitti import HEIGHT, WIDTH, encode_labels
from dsrc.data.formats.opv2v.reader import write_frame
from sim.boxes import CLASSES, Boxes
from sim.errors import DataError
from sim.geometry import invert
from tests.dsrc.data.toy import toy_frame


@pytest.fixture
def data(tmp_path: Path) -> Path:
    for name in ("train/one", "test/two"):
        for index in range(2):
            write_frame(tmp_path / "data" / name, toy_frame(index, seed=len(name)))
    return tmp_path / "data"


def calibration(path: Path) -> dict[str, np.ndarray]:
    rows = (line.split(":") for line in path.read_text().splitlines())
    found = {name: np.array(values.split(), float) for name, values in rows}
    return {name: values.reshape(3, -1) if len(values) > 1 else values for name, values in found.items()}


def labels(path: Path) -> list[tuple[str, np.ndarray]]:
    return [(line.split()[0], np.array(line.split()[1:], float)) for line in path.read_text().splitlines()]


def in_velodyne(row: np.ndarray, calib: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, float]:
    """Centre, size (l, w, h) and yaw of a label's box as KITTI's tools take it."""
    height, width, length, x, y, z, turn = row[7:14]
    lidar_to_camera = np.vstack([calib["Tr_velo_to_cam"], [0, 0, 0, 1]])
    center = np.linalg.inv(lidar_to_camera) @ [x, y - height / 2, z, 1]
    return center[:3], np.array([length, width, height]), -turn - np.pi / 2


def test_points_lie_in_the_boxes_as_kittis_tools_take_them(data: Path, tmp_path: Path) -> None:
    root = convert(data / "train", tmp_path / "out", "kitti", view="around") / "training"
    frame = toy_frame(1, seed=len("train/one"))
    sweep = frame.agents[0].sweep
    cloud = np.fromfile(root / "velodyne" / "000001.bin", "<f4").reshape(-1, 4)
    assert np.array_equal(cloud[:, :3], sweep.points) and np.array_equal(cloud[:, 3], sweep.intensity)
    calib = calibration(root / "calib" / "000001.txt")
    kittis = {"P0", "P1", "P2", "P3", "R0_rect", "Tr_velo_to_cam", "Tr_imu_to_velo"}
    assert set(calib) == {*kittis, "Tr_velo_to_world", "time"}
    rows = labels(root / "label_2" / "000001.txt")
    seen = frame.truth[(frame.points_on[0] >= 1) & (frame.truth.object_id != 1000)]
    assert [name for name, _ in rows] == ["Truck", "Car", "Pedestrian", "Misc"]
    for (_, row), box, number in zip(
        rows, seen.transform(invert(sweep.world_from_lidar)).array, seen.object_id, strict=True
    ):
        center, size, yaw = in_velodyne(row, calib)
        assert np.allclose(center, box[:3], atol=1e-3) and np.allclose(size, box[3:6], atol=1e-3)
        assert np.exp(1j * yaw) == pytest.approx(np.exp(1j * box[6]), abs=1e-5)
        # The toy's first car is pitched by 0.01 rad, which an upright box cannot follow.
        inside = Boxes.from_array([[*center, *size, yaw]]).contains(sweep.points[sweep.object_id == number], 0.1)
        assert inside.all()


def test_the_picture_decides_what_is_labelled_and_its_box_holds_the_projected_corners() -> None:
    boxes = Boxes.from_array(
        [
            [20.0, 3.0, -0.8, 4.5, 1.8, 1.5, 0.4],  # ahead
            [-20.0, 3.0, -0.8, 4.5, 1.8, 1.5, 0.4],  # behind
            [5.0, 30.0, -0.8, 4.5, 1.8, 1.5, 0.4],  # far to the left
            [6.0, -6.0, -0.8, 4.5, 1.8, 1.5, 0.0],  # cut by the right edge
        ],
        label=[CLASSES.index(name) for name in ("car", "van", "bicycle", "pedestrian")],
    )
    shown = [line.split() for line in encode_labels(boxes, "camera", np.array([0, 0, 0, 2])).splitlines()]
    assert [line[0] for line in shown] == ["Car", "Pedestrian"]
    assert [line[2] for line in shown] == ["0", "2"]
    ahead, cut = (np.array(line[1:], float) for line in shown)
    left, top, right, bottom = ahead[3:7]
    # 20 m ahead, 3 m to the left: left of the middle of the picture, below the horizon.
    assert 0 < left < right < WIDTH / 2 and 165 < top < 175 < bottom < HEIGHT
    assert ahead[0] == 0.0 and 0.0 < cut[0] < 1.0 and cut[5] == WIDTH - 1
    assert ahead[2] == pytest.approx(ahead[13] - np.arctan2(ahead[10], ahead[12]), abs=1e-3)
    around = [line.split() for line in encode_labels(boxes, "around", np.zeros(4, int)).splitlines()]
    assert [line[0] for line in around] == ["Car", "Van", "Cyclist", "Pedestrian"]
    assert around[1][1:3] == ["1.00", "3"] and around[1][4:8] == ["0.00"] * 4


def test_every_agent_can_be_the_car(data: Path, tmp_path: Path) -> None:
    out = convert(data, tmp_path / "out", "kitti", agent_id="all")
    rows = [line.split(",") for line in (out / "frames.csv").read_text().splitlines()]
    assert rows[0] == ["number", "split", "drive", "frame", "agent"]
    assert rows[1] == ["000000", "test", "test/two", "0", "1000"]
    assert [row[4] for row in rows[1:4]] == ["1000", "1002", "-1"] and len(rows) == 1 + 2 * 2 * 3
    listed = {
        name: (out / "ImageSets" / f"{name}.txt").read_text().split() for name in ("train", "val", "trainval", "test")
    }
    assert listed["test"] == [f"{k:06d}" for k in range(6)] and listed["val"] == []
    assert listed["train"] == listed["trainval"] == [f"{k:06d}" for k in range(6, 12)]
    # KITTI's folder of frames without labels has none of ours: test drives have labels too.
    assert not (out / "testing").exists()
    for kind, ending in (("velodyne", "bin"), ("label_2", "txt"), ("calib", "txt"), ("image_2", "png")):
        names = sorted(path.name for path in (out / "training" / kind).iterdir())
        assert names == [f"{number}.{ending}" for number in listed["test"] + listed["train"]]


def test_one_agent_of_a_drive_that_has_it(data: Path, tmp_path: Path) -> None:
    out = convert(data, tmp_path / "out", "kitti", agent_id="-1", view="around")
    cloud = np.fromfile(out / "training/velodyne/000002.bin", "<f4").reshape(-1, 4)
    # The roadside unit's sensor looks down; its cloud is level: the ground is flat, 5 m below.
    ground = cloud[toy_frame(0, seed=len("train/one")).agents[2].sweep.object_id == -1]
    assert np.ptp(ground[:, 2]) < 1e-3 and ground[0, 2] == pytest.approx(-5.02, abs=0.01)
    with pytest.raises(DataError, match=r"agent: expected one of \[1000, 1002, -1\], found 8"):
        convert(data, tmp_path / "other", "kitti", agent_id="8")


def test_the_pictures_are_black_and_of_kittis_size(data: Path, tmp_path: Path) -> None:
    content = (convert(data, tmp_path / "out", "kitti") / "training/image_2/000002.png").read_bytes()
    assert content[:8] == b"\x89PNG\r\n\x1a\n" and struct.unpack(">II", content[16:24]) == (WIDTH, HEIGHT)
    start = content.index(b"IDAT") + 4
    (length,) = struct.unpack(">I", content[start - 8 : start - 4])
    assert zlib.decompress(content[start : start + length]) == bytes((1 + 3 * WIDTH) * HEIGHT)
