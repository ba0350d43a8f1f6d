"""Every layout gives the scene that its files hold."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dsrc.data.datasets.check import check_dataset
from dsrc.data.drives import Drive, find_drives, open_drive, open_drives
from sim.errors import DataError
from tests.dsrc.data.sweeps import trees
from tests.dsrc.data.sweeps.scene import FRAMES, INTERVAL_S, SPEED_MPS, instant


def opened(make: Callable[[Path], Path], folder: Path) -> Drive:
    (drive,) = open_drives(make(folder))
    assert find_drives(drive.drive) == [drive.drive]
    assert check_dataset(folder) == []
    assert len(drive) == FRAMES
    assert open_drive(drive.drive).digest() == drive.digest()
    return drive


def check_tracks(drive: Drive, tolerance_m: float) -> None:
    """Check poses, boxes, ids, times and speeds against the scene; the map of a data set is the scene's world."""
    for i in range(FRAMES):
        frame, now = drive.read(i), instant(i)
        sweep = frame.agents[0].sweep
        assert np.abs(sweep.world_from_lidar - now.world_from_lidar).max() < tolerance_m
        assert np.abs(frame.truth.array - now.boxes.array).max() < tolerance_m
        assert frame.truth.label.tolist() == now.boxes.label.tolist()
        assert frame.truth.object_id.tolist() == [1, 2]
        assert frame.time_s == pytest.approx(now.time_s)
        assert frame.agents[0].speed == pytest.approx(SPEED_MPS)
        assert np.linalg.norm(frame.velocity[0]) == pytest.approx(SPEED_MPS, abs=1e-3)
        assert (frame.points_on[0] >= 100).all()
        assert np.abs(frame.agents[0].world_from_body[2, 3]) < 0.2


def test_argoverse(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    drive = opened(trees.argoverse, tmp_path)
    check_tracks(drive, 1e-9)
    for i in range(FRAMES):
        sweep, now = drive.read(i).agents[0].sweep, instant(i)
        # Coordinates of half precision: 1.6 cm beyond 32 m.
        assert np.abs(sweep.points - now.points[:, :3]).max() < 0.02
        assert np.array_equal(sweep.intensity, now.points[:, 3])
        assert np.array_equal(sweep.ring, 31 - now.ring.astype(int))


def test_a_laser_that_no_log_of_argoverse_has_is_refused(tmp_path: Path) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import feather

    drive = opened(trees.argoverse, tmp_path)
    scan = sorted(drive.drive.glob("sensors/lidar/*.feather"))[1]
    table = feather.read_table(scan, memory_map=False)
    lasers = pyarrow.array(np.full(len(table), 64, np.uint8))
    table = table.set_column(table.column_names.index("laser_number"), "laser_number", lasers)
    feather.write_feather(table, scan)
    with pytest.raises(DataError, match=f"{scan.name}: laser_number: expected whole numbers from 0 to 63"):
        open_drive(drive.drive).read(1)


def test_a_log_of_argoverse_without_lasers_has_no_rings_and_a_damaged_first_sweep_is_not_missed(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    from pyarrow import feather

    drive = opened(trees.argoverse, tmp_path).drive
    first, second, *_ = sorted(drive.glob("sensors/lidar/*.feather"))
    rings = open_drive(drive).read(1).agents[0].sweep.ring
    whole = first.read_bytes()
    first.write_bytes(b"damaged")
    assert np.array_equal(open_drive(drive).read(1).agents[0].sweep.ring, rings)
    first.write_bytes(whole)
    feather.write_feather(feather.read_table(second, memory_map=False).drop_columns(["laser_number"]), second)
    bare = open_drive(drive).read(1).agents[0].sweep
    assert len(bare) == len(rings) and not np.array_equal(bare.ring, rings)
    assert np.array_equal(bare.intensity, instant(1).points[:, 3])


def test_nuscenes(tmp_path: Path) -> None:
    drive = opened(trees.nuscenes, tmp_path)
    assert drive.drive.name == "scene-0061"
    check_tracks(drive, 1e-9)
    for i in range(FRAMES):
        sweep, now = drive.read(i).agents[0].sweep, instant(i)
        assert np.abs(sweep.points - now.points[:, :3]).max() < 1e-5
        assert np.array_equal(sweep.intensity, now.points[:, 3])
        assert np.array_equal(sweep.ring, 31 - now.ring.astype(int))
        assert sweep.spec is not None
        assert sweep.spec.name == "hdl-32e"


def test_kitti_tracking(tmp_path: Path) -> None:
    drive = opened(trees.kitti_tracking, tmp_path)
    assert drive.drive == tmp_path / "training" / "0000"
    for i in range(FRAMES):
        frame, now, start = drive.read(i), instant(i), instant(0)
        sweep = frame.agents[0].sweep
        assert np.array_equal(sweep.points, now.points[:, :3])
        moved = np.linalg.inv(drive.read(0).agents[0].sweep.world_from_lidar) @ sweep.world_from_lidar
        expected = np.linalg.inv(start.world_from_lidar) @ now.world_from_lidar
        assert np.abs(moved - expected).max() < 1e-4
        local = frame.truth.transform(np.linalg.inv(sweep.world_from_lidar))
        assert np.abs(local.array - now.local.array).max() < 3e-3
        assert frame.truth.object_id.tolist() == [1, 2]
        assert np.linalg.norm(frame.velocity[0]) == pytest.approx(SPEED_MPS, abs=0.05)
        assert frame.region is not None
        assert frame.region.counts(frame.truth).all()


def test_semantic_kitti(tmp_path: Path) -> None:
    drive = opened(trees.semantic_kitti, tmp_path)
    assert not drive.labelled(0)
    for i in range(FRAMES):
        sweep, now = drive.read(i).agents[0].sweep, instant(i)
        moved = np.linalg.inv(drive.read(0).agents[0].sweep.world_from_lidar) @ sweep.world_from_lidar
        expected = np.linalg.inv(instant(0).world_from_lidar) @ now.world_from_lidar
        assert np.abs(moved - expected).max() < 1e-6
        assert np.array_equal(sweep.points, now.points[:, :3])
        assert drive.read(i).time_s == pytest.approx(now.time_s)


@pytest.mark.parametrize(("storage", "before"), [("mcap", ""), ("sqlite3", ""), ("sqlite3", "/")])
def test_bags(tmp_path: Path, storage: str, before: str) -> None:
    """The transforms of a bag of ROS 1 have no slash before a frame's name, its clouds may have one."""
    pytest.importorskip("rosbags")
    drive = opened(lambda folder: trees.rosbag(folder, storage, before), tmp_path)
    assert drive.agents == (0, 1)
    assert not drive.labelled(0)
    for i in range(FRAMES):
        frame, now = drive.read(i), instant(i)
        rear, top = (agent.sweep for agent in frame.agents)  # by the names of their topics
        assert np.abs(top.world_from_lidar - now.world_from_lidar).max() < 1e-9
        assert np.array_equal(top.points, now.points[:, :3])
        assert np.array_equal(top.intensity, now.points[:, 3])
        assert np.array_equal(top.ring, now.ring)
        assert np.abs(rear.world_points - top.world_points).max() < 1e-4
        assert frame.time_s == pytest.approx(now.time_s)
        assert frame.agents[1].speed == pytest.approx(SPEED_MPS)


def test_openlabel(tmp_path: Path) -> None:
    drive = opened(trees.openlabel, tmp_path)
    assert drive.drive.parent == tmp_path / "train"
    assert drive.agents == (0, -1)
    for i in range(FRAMES):
        frame, now = drive.read(i), instant(i)
        assert [agent.kind for agent in frame.agents] == ["vehicle", "roadside"]
        vehicle, road = (agent.sweep for agent in frame.agents)
        assert np.abs(vehicle.world_from_lidar - now.world_from_lidar).max() < 1e-9
        assert np.array_equal(vehicle.points, now.points[:, :3])
        assert np.array_equal(vehicle.intensity, now.points[:, 3])
        assert np.abs(road.world_points - vehicle.world_points).max() < 1e-4
        assert np.abs(frame.truth.array - now.boxes.array).max() < 1e-9
        assert frame.truth.label.tolist() == now.boxes.label.tolist()
        assert frame.truth.object_id.tolist() == [1, 2]
        assert frame.time_s == pytest.approx(now.time_s, abs=1e-6)
        assert frame.agents[0].speed == pytest.approx(SPEED_MPS, abs=1e-3)
        assert np.linalg.norm(frame.velocity[0]) == pytest.approx(SPEED_MPS, abs=1e-3)
        assert (frame.points_on >= 100).all()


def test_openlabel_of_a_merged_cloud_alone_has_one_agent_where_its_labels_are(tmp_path: Path) -> None:
    trees.openlabel(tmp_path, merged_only=True)
    (drive,) = open_drives(tmp_path)
    assert drive.agents == (-1,)
    assert (drive.read(0).points_on >= 200).all()


def label_files(tree: Path) -> list[Path]:
    return sorted(tree.glob("train/labels_point_clouds/*/*.json"))


def test_openlabel_of_many_frames_in_one_file_as_the_standard_has_them(tmp_path: Path) -> None:
    """Classes in `objects` of the file, cuboids in lists with Euler angles, a type that is no road user."""
    trees.openlabel(tmp_path)
    before = [open_drives(tmp_path)[0].read(i) for i in range(FRAMES)]
    frames, objects = {}, {}
    for k, file in enumerate(label_files(tmp_path)):
        content = json.loads(file.read_text())["openlabel"]
        (frame,) = content["frames"].values()
        frames[str(10 + k)] = frame
        for name, one in frame["objects"].items():
            data = one["object_data"]
            objects[name] = {"name": data.pop("name"), "type": data.pop("type").capitalize()}
            x, y, z, *turn, length, width, height = data["cuboid"]["val"]
            angles = Rotation.from_quat(turn).as_euler("xyz").tolist()
            data["cuboid"] = [{"name": "shape", "val": [x, y, z, *angles, length, width, height]}]
        frame["objects"]["tree"] = {"object_data": {"cuboid": [{"name": "shape", "val": [1.0] * 9}]}}
        objects["tree"] = {"name": "tree", "type": "Tree"}
        file.unlink()
    content["frames"], content["objects"] = frames, objects
    file.with_name("all.json").write_text(json.dumps({"openlabel": content}))
    (drive,) = open_drives(tmp_path)
    assert drive.frames == (10, 11, 12)
    for i in range(FRAMES):
        assert np.abs(drive.read(i).truth.array - before[i].truth.array).max() < 1e-9
        assert drive.read(i).truth.label.tolist() == before[i].truth.label.tolist()


def test_openlabel_of_a_trailer_is_neither_found_nor_missed(tmp_path: Path) -> None:
    trees.openlabel(tmp_path)
    for file in label_files(tmp_path):
        file.write_text(file.read_text().replace('"CAR"', '"TRAILER"'))
    frame = open_drives(tmp_path)[0].read(0)
    assert len(frame.truth) == 1
    assert frame.region is not None
    assert len(frame.region.ignored) == 1


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"val": [', '"val": [1.0, ', r"\.cuboid\.val: expected x, y, z, a quaternion .*, found 11 numbers"),
        ('"val": [', '"val": ["x", ', r"objects\[\.\.\.\].*val.*: expected float, found str"),
        ('"frames": {"0"', '"frames": {"first"', r"openlabel\.frames: expected whole numbers as names, found first"),
        ('"src": "vehicle_lidar_robosense"', '"src": 3', r"src: expected str, found int"),
        ('"parent": ""', '"parent": "s110_base", "pose_wrt_parent": {"matrix4x4": [1]}', "matrix4x4 of 16 numbers"),
        (
            '"parent": ""',
            '"parent": "s110_base", "pose_wrt_parent": POSE',
            "parents that end in a root, found a circle",
        ),
        (
            '"cuboid": {',
            '"cuboid": {"coordinate_system": "moon", ',
            r"coordinate_system: expected one of .*, found moon",
        ),
        (".pcd", ".PCD", r"point_cloud_file_names: expected a file in point_clouds, found "),
    ],
)
def test_a_damaged_openlabel_file_is_one_line_with_file_and_field(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    trees.openlabel(tmp_path)
    file = label_files(tmp_path)[0]
    pose = '{"quaternion": [0, 0, 0, 1], "translation": [0, 0, 0]}'
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new.replace("POSE", pose)))
    if old == ".pcd":
        file = file.rename(file.with_name("other.json"))
    with pytest.raises(DataError, match=message) as caught:
        [drive.read(0) for drive in open_drives(tmp_path)]
    assert file.name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_folder_of_scans(tmp_path: Path) -> None:
    drive = opened(trees.scans, tmp_path)
    for i in range(FRAMES):
        frame, now = drive.read(i), instant(i)
        assert np.array_equal(frame.agents[0].sweep.points, now.points[:, :3])
        assert np.abs(frame.truth.array - now.local.array).max() < 1e-9
        assert frame.truth.label.tolist() == now.local.label.tolist()
        assert frame.time_s == pytest.approx(i * INTERVAL_S)


@pytest.mark.parametrize("odd", [np.nan, -0.5])
def test_a_scan_with_an_intensity_that_is_none_is_one_line_with_its_file(tmp_path: Path, odd: float) -> None:
    trees.scans(tmp_path)
    file = tmp_path / "scans" / "0001.npy"
    points = np.load(file)
    points[4, 3] = odd
    np.save(file, points)
    (drive,) = open_drives(tmp_path)
    with pytest.raises(
        DataError, match=r"0001\.npy: intensity: expected numbers from 0 on, found 1 of \d+ that are not"
    ):
        drive.read(1)


@pytest.mark.parametrize("make", [trees.argoverse, trees.nuscenes])
def test_intensities_that_are_fractions_where_a_data_set_has_bytes_are_kept(
    tmp_path: Path, make: Callable[[Path], Path]
) -> None:
    if make is trees.argoverse:
        pytest.importorskip("pyarrow")
    drive = opened(make, tmp_path).drive
    for file in tmp_path.glob("samples/LIDAR_TOP/*"):
        rows = np.fromfile(file, "<f4").reshape(-1, 5)
        rows[:, 3] /= 255
        rows.tofile(file)
    for file in drive.glob("sensors/lidar/*"):
        import pyarrow
        from pyarrow import feather

        table = feather.read_table(file, memory_map=False)
        values = pyarrow.array(table["intensity"].to_numpy().astype(np.float32) / 255)
        table = table.set_column(table.column_names.index("intensity"), "intensity", values)
        feather.write_feather(table, file)
    assert np.allclose(open_drive(drive).read(0).agents[0].sweep.intensity, instant(0).points[:, 3], atol=1e-6)


def test_scans_without_boxes_and_a_single_scan_are_drives_without_truth(tmp_path: Path) -> None:
    trees.scans(tmp_path, labelled=False)
    for path in (tmp_path, tmp_path / "scans" / "0001.npy"):
        (drive,) = open_drives(path)
        assert not any(drive.labelled(i) for i in range(len(drive)))
        assert len(drive.read(0).truth) == 0
