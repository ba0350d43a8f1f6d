"""One drive through each format and back, equal: points, poses and boxes."""

import json
from pathlib import Path

import numpy as np
import pytest

from dsrc.data.datasets.check import check_dataset
from dsrc.data.datasets.convert import convert
from dsrc.data.drives import open_drives
from dsrc.data.write import write_drive
from tests.dsrc.data.sweeps import trees
from tests.dsrc.data.toy import SETTINGS, ToySource


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("out") / "data"
    write_drive(folder / "toy_3", {**SETTINGS, "frames": 2}, ToySource().open)
    return folder


@pytest.mark.parametrize(("to", "package"), [("mcap", "mcap"), ("ros2", "rosbags"), ("nuscenes", "numpy")])
def test_a_drive_comes_back_equal(data: Path, tmp_path: Path, to: str, package: str) -> None:
    pytest.importorskip(package)
    pytest.importorskip("mcap")
    convert(data=data, out=tmp_path / to, to=to)
    (drive,), (back,) = open_drives(data), open_drives(tmp_path / to)
    assert check_dataset(tmp_path / to) == []
    assert len(back) == len(drive)
    alone = to == "nuscenes"
    assert len(back.agents) == (1 if alone else len(drive.agents))
    for i in range(len(drive)):
        frame, again = drive.read(i), back.read(i)
        for before, after in zip(frame.agents, again.agents, strict=not alone):
            assert np.array_equal(after.sweep.points, before.sweep.points)
            # In nuScenes' scale, to 255, some float32 of ours are none.
            assert np.abs(after.sweep.intensity - before.sweep.intensity).max() <= (1e-7 if alone else 0.0)
            assert np.abs(after.sweep.world_from_lidar - before.sweep.world_from_lidar).max() < 1e-9
            assert np.array_equal(after.sweep.ring, before.sweep.ring)
        assert again.time_s - back.read(0).time_s == pytest.approx(frame.time_s - drive.read(0).time_s)
        truth = frame.truth[frame.truth.object_id != frame.agents[0].agent_id] if alone else frame.truth
        assert again.truth.object_id.tolist() == truth.object_id.tolist()
        assert again.truth.label.tolist() == truth.label.tolist()
        assert np.abs(again.truth.array - truth.array).max() < 1e-6


def test_the_library_of_ros_reads_what_we_write(data: Path, tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    decoder = pytest.importorskip("mcap_ros2.decoder")
    reader = pytest.importorskip("mcap.reader")
    convert(data=data, out=tmp_path / "ros", to="ros2")
    (drive,) = open_drives(data)
    found: dict[str, list] = {}
    with (tmp_path / "ros" / "toy_3.mcap").open("rb") as file:
        messages = reader.make_reader(file, decoder_factories=[decoder.DecoderFactory()]).iter_decoded_messages()
        for _, channel, _, message in messages:
            found.setdefault(channel.topic, []).append(message)
    frame = drive.read(0)
    cloud = found[f"/agents/{frame.agents[0].agent_id}/points"][0]
    assert (cloud.width, cloud.point_step) == (len(frame.agents[0].sweep), 22)
    xyz = np.frombuffer(bytes(cloud.data), np.uint8).reshape(-1, 22)[:, :12].copy().view("<f4")
    assert np.array_equal(xyz, frame.agents[0].sweep.points)
    assert {marker.id for marker in found["/truth"][0].markers} == set(frame.truth.object_id.tolist())
    step = found["/tf"][0].transforms[0]
    assert (step.header.frame_id, step.child_frame_id) == ("world", f"agent_{frame.agents[0].agent_id}")
    assert step.transform.translation.x == pytest.approx(frame.agents[0].world_from_body[0, 3], abs=1e-9)


def test_tables_link_as_nuscenes_schema_says(data: Path, tmp_path: Path) -> None:
    convert(data=data, out=tmp_path / "n", to="nuscenes", agent_id="all")
    version = tmp_path / "n" / "v1.0-trainval"
    tables = {path.stem: json.loads(path.read_text()) for path in version.glob("*.json")}
    tokens = {name: {row["token"] for row in rows} for name, rows in tables.items()}
    assert all(len(tokens[name]) == len(rows) for name, rows in tables.items())
    links = {
        ("sample", "scene_token"): "scene",
        ("sample_data", "sample_token"): "sample",
        ("sample_data", "ego_pose_token"): "ego_pose",
        ("sample_data", "calibrated_sensor_token"): "calibrated_sensor",
        ("calibrated_sensor", "sensor_token"): "sensor",
        ("sample_annotation", "sample_token"): "sample",
        ("sample_annotation", "instance_token"): "instance",
        ("instance", "category_token"): "category",
        ("scene", "log_token"): "log",
    }
    for (table, column), other in links.items():
        assert {row[column] for row in tables[table]} <= tokens[other]
    for row in tables["sample_annotation"]:
        assert row["next"] in {"", *tokens["sample_annotation"]}
    assert len(open_drives(tmp_path / "n")) == 3


@pytest.mark.parametrize("ours", [True, False])
def test_the_development_kit_of_nuscenes_reads_what_we_read(data: Path, tmp_path: Path, ours: bool) -> None:
    """Both our tables and those by hand after its schema; its requirements exclude ours, so no extra installs it."""
    pytest.importorskip("nuscenes.nuscenes")
    from nuscenes.nuscenes import NuScenes
    from nuscenes.utils.data_classes import LidarPointCloud
    from pyquaternion import Quaternion

    if ours:
        convert(data=data, out=tmp_path, to="nuscenes", agent_id="all")
    else:
        trees.nuscenes(tmp_path)
    drives = open_drives(tmp_path)
    kit = NuScenes(drives[0].drive.parent.name, str(tmp_path), verbose=False)
    assert {scene["name"] for scene in kit.scene} == {drive.drive.name for drive in drives}
    for scene in kit.scene:
        (drive,) = (drive for drive in drives if drive.drive.name == scene["name"])
        assert scene["nbr_samples"] == len(drive)
        token = scene["first_sample_token"]
        for i in range(len(drive)):
            frame, sample = drive.read(i), kit.get("sample", token)
            row = kit.get("sample_data", sample["data"]["LIDAR_TOP"])
            cloud = LidarPointCloud.from_file(kit.get_sample_data_path(row["token"]))
            sweep = frame.agents[0].sweep
            assert np.allclose(cloud.points[3] / 255.0, sweep.intensity, atol=1e-7)
            for table in ("calibrated_sensor", "ego_pose"):
                pose = kit.get(table, row[f"{table}_token"])
                cloud.rotate(Quaternion(pose["rotation"]).rotation_matrix)
                cloud.translate(np.array(pose["translation"]))
            assert np.abs(cloud.points[:3].T - sweep.world_points).max() < 1e-4
            boxes = [kit.get_box(one) for one in sample["anns"]]
            assert len(boxes) == (frame.truth.object_id != frame.agents[0].agent_id).sum()
            for box, one in zip(boxes, sample["anns"], strict=True):
                k = int(np.argmin(np.linalg.norm(frame.truth.center - box.center, axis=1)))
                assert np.abs(frame.truth.center[k] - box.center).max() < 1e-6
                assert np.abs(frame.truth.size[k] - box.wlh[[1, 0, 2]]).max() < 1e-6
                assert box.orientation.yaw_pitch_roll[0] == pytest.approx(frame.truth.yaw[k], abs=1e-6)
                assert box.name.startswith(("vehicle.", "human.pedestrian."))
                assert np.abs(kit.box_velocity(one)[:2] - frame.velocity[k]).max() < 1e-3
            token = sample["next"]
        assert token == ""
