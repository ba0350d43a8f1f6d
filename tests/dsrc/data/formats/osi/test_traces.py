"""OSI traces, read back by betterosi: ids, classes, boxes, motion and times of the drive."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsrc.data.datasets.convert import convert
from dsrc.data.formats.opv2v.reader import DriveReader, write_frame
from sensors.frame import Frame
from sim.boxes import CLASSES
from sim.errors import SettingsError
from sim.geometry import invert, pose_matrix
from tests.dsrc.data.toy import toy_frame

pytest.importorskip("betterosi", reason="the package betterosi is not installed: pip install betterosi")


@pytest.fixture
def drive(tmp_path: Path) -> list[Frame]:
    for index in range(3):
        write_frame(tmp_path / "data" / "toy", toy_frame(index))
    reader = DriveReader(tmp_path / "data" / "toy")
    return [reader.read(row) for row in range(3)]


def read(path: Path, **options: Any) -> list[Any]:
    import betterosi

    return list(betterosi.read(path, **options))


def place(vector: Any) -> list[float]:
    return [vector.x, vector.y, vector.z]


def size(base: Any) -> list[float]:
    return [base.dimension.length, base.dimension.width, base.dimension.height]


def pose(position: Any, orientation: Any) -> np.ndarray:
    return pose_matrix(np.array(place(position)), orientation.yaw, orientation.pitch, orientation.roll)


def class_of(one: Any) -> str:
    names = {"CAR": "car", "DELIVERY_VAN": "van", "HEAVY_TRUCK": "truck", "MOTORBIKE": "motorcycle"}
    name = one.type.name if one.type.name == "PEDESTRIAN" else one.vehicle_classification.type.name
    return names.get(name, name.lower())


def check_truth(found: list[Any], drive: list[Frame]) -> None:
    assert len(found) == len(drive)
    for message, frame in zip(found, drive, strict=True):
        truth, objects = frame.truth, message.moving_object
        assert message.timestamp.seconds + 1e-9 * message.timestamp.nanos == pytest.approx(frame.time_s, abs=1e-9)
        assert [one.id.value for one in objects] == truth.object_id.tolist()
        assert [class_of(one) for one in objects] == [CLASSES[label] for label in truth.label]
        np.testing.assert_allclose([place(one.base.position) for one in objects], truth.center, atol=1e-9)
        np.testing.assert_allclose([size(one.base) for one in objects], truth.size, atol=1e-9)
        np.testing.assert_allclose([one.base.orientation.yaw for one in objects], truth.yaw, atol=1e-9)
        known = np.isfinite(frame.velocity).all(axis=1)
        assert [one.base.velocity is not None for one in objects] == known.tolist()
        moving = [place(one.base.velocity)[:2] for one in objects if one.base.velocity is not None]
        np.testing.assert_allclose(np.reshape(moving, (-1, 2)), frame.velocity[known], atol=1e-9)


def test_an_mcap_holds_truth_views_and_data(tmp_path: Path, drive: list[Frame]) -> None:
    convert(tmp_path / "data", tmp_path / "out", "osi-mcap")
    path = tmp_path / "out" / "toy.mcap"
    check_truth(read(path, mcap_topics=["ground_truth"]), drive)
    for row, agent in enumerate(drive[0].agents):
        views = read(path, mcap_topics=[f"sensor_view/{agent.agent_id}"])
        check_truth([view.global_ground_truth for view in views], drive)
        for view, frame in zip(views, drive, strict=True):
            own = frame.agents[row]
            mounting = pose(view.mounting_position.position, view.mounting_position.orientation)
            body = own.world_from_body if own.agent_id >= 0 else np.eye(4)
            np.testing.assert_allclose(body @ mounting, own.sweep.world_from_lidar, atol=1e-6)
            host = view.host_vehicle_id
            assert (None if host is None else host.value) == (own.agent_id if own.agent_id >= 0 else None)
    again = tmp_path / "again"
    convert(tmp_path / "data", again, "osi-mcap")
    assert (again / "toy.mcap").read_bytes() == path.read_bytes()


def test_sensor_data_are_the_objects_that_a_lidar_meets_in_its_frame(tmp_path: Path, drive: list[Frame]) -> None:
    convert(tmp_path / "data", tmp_path / "out", "osi-mcap")
    met = 0
    for row, agent in enumerate(drive[0].agents):
        data = read(tmp_path / "out" / "toy.mcap", mcap_topics=[f"sensor_data/{agent.agent_id}"])
        for message, frame in zip(data, drive, strict=True):
            expected = np.flatnonzero(frame.points_on[row] > 0)
            ids = [one.header.ground_truth_id[0].value for one in message.moving_object]
            assert ids == frame.truth.object_id[expected].tolist()
            for one, k in zip(message.moving_object, expected, strict=True):
                found = frame.agents[row].sweep.world_from_lidar @ pose(one.base.position, one.base.orientation)
                box = pose_matrix(frame.truth.center[k], frame.truth.yaw[k])
                np.testing.assert_allclose(found, box, atol=1e-6)
                assert class_of(one.candidate[0]) == CLASSES[frame.truth.label[k]]
                met += 1
    assert met > 0


def test_binary_traces_are_named_as_the_standard_says(tmp_path: Path, drive: list[Frame]) -> None:
    convert(tmp_path / "data", tmp_path / "out", "osi")
    files = sorted((tmp_path / "out" / "toy").iterdir())
    assert len(files) == 1 + 2 * len(drive[0].agents)
    (truth,) = (path for path in files if "_gt_" in path.name)
    assert truth.name == "19700101T000000Z_gt_380_700_3_toy.osi"
    check_truth(read(truth), drive)
    for path in files:
        if "_sv_" in path.name:
            check_truth(read(path, return_ground_truth=True), drive)


def test_relative_motion_is_that_between_object_and_vehicle(tmp_path: Path, drive: list[Frame]) -> None:
    convert(tmp_path / "data", tmp_path / "out", "osi-mcap")
    frame = drive[0]
    agent = frame.agents[0]
    (message, *_) = read(tmp_path / "out" / "toy.mcap", mcap_topics=[f"sensor_data/{agent.agent_id}"])
    own = frame.velocity[frame.truth.object_id == agent.agent_id]
    turn = invert(agent.sweep.world_from_lidar)[:3, :2]
    for one in message.moving_object:
        k = int(np.flatnonzero(frame.truth.object_id == one.header.tracking_id.value)[0])
        if one.base.velocity is not None:
            relative = frame.velocity[k] - (own[0] if len(own) else 0.0)
            np.testing.assert_allclose(place(one.base.velocity), turn @ relative, atol=1e-9)


def test_without_the_package_one_line_names_the_extra(
    tmp_path: Path, drive: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "betterosi", None)
    with pytest.raises(SettingsError, match=r"pip install 'dsrc-testbed\[osi\]'"):
        convert(tmp_path / "data", tmp_path / "out", "osi")
