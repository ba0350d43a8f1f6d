"""A V2V4Real tree made by hand: matrices as poses, boxes in the LiDAR's frame, association ids, nothing mirrored."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from dsrc.data.drives import open_drives
from dsrc.data.formats.pcd import encode_table
from dsrc.data.formats.yaml import read_yaml
from dsrc.data.sample import SampleRequest, make_sample
from dsrc.ops.grid import GridSpec
from sim.boxes import CLASSES
from sim.errors import DataError
from tests.dsrc.data.dair_tree import pose, turn

BOXES = np.array(
    [[20.0, 6.0, 0.9, 4.6, 1.9, 1.6, 0.3], [35.0, -4.0, 1.7, 9.0, 2.6, 3.4, -2.9], [8, 9, 0.9, 0.7, 0.7, 1.8, 0]]
)
"""In the world, at the first frame; the first drives 8 m/s along its heading."""
KINDS = ("Car", "Truck", "Pedestrian")


def world_boxes(frame: int) -> np.ndarray:
    boxes = BOXES.copy()
    boxes[0, :2] += 0.1 * frame * 8.0 * np.array([np.cos(0.3), np.sin(0.3)])
    return boxes


def lidar(agent: int, frame: int) -> np.ndarray:
    return pose([1.0 + frame, 0.5, 1.9], 0.2) if agent == 0 else pose([45.0, 2.0 + frame, 2.1], 2.8)


def vehicle(frame: int, row: int, world_from_lidar: np.ndarray, ass_id: int) -> dict:
    box = world_boxes(frame)[row]
    local = np.linalg.inv(world_from_lidar) @ [*box[:3], 1.0]
    yaw = box[6] - np.arctan2(world_from_lidar[1, 0], world_from_lidar[0, 0])
    return {
        "angle": [0.0, float(np.degrees(yaw)), 0.0],
        "ass_id": ass_id,
        "center": [0.0, 0.0, 0.0],
        "extent": (box[3:6] / 2).tolist(),
        "location": local[:3].tolist(),
        "obj_type": KINDS[row],
    }


@pytest.fixture(params=["plain", "numpy.core", "numpy._core"])
def drive(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    """Both see the car (7), the first alone the truck, which has no association, the second alone the pedestrian.

    The download's files were dumped with numpy's arrays and numbers in them.
    """
    rng = np.random.default_rng(0)
    folder = tmp_path / "train" / "testoutput_CAV_data_2022-03-15-09-54-40_0"
    for frame in range(3):
        for agent, rows in ((0, {3: (0, 7), 5: (1, -1)}), (1, {3: (2, -1), 4: (0, 7)})):
            matrix = lidar(agent, frame)
            content = {
                "ego_speed": 36.0,
                "gps": [np.float64(1e-3), np.float64(2.0)],
                "lidar_pose": matrix,
                "true_ego_pos": matrix,
                "vehicles": {key: vehicle(frame, row, matrix, ass) for key, (row, ass) in rows.items()},
            }
            points = []
            for row, _ in rows.values():
                box = world_boxes(frame)[row]
                points.append((rng.uniform(-0.45, 0.45, (50, 3)) * box[3:6]) @ turn(box[6]).T + box[:3])
            local = (np.concatenate(points) - matrix[:3, 3]) @ matrix[:3, :3]
            table = np.zeros(101, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")])
            for k, name in enumerate("xyz"):
                table[name] = np.append(local[:, k], np.nan)
            table["intensity"] = np.arange(101) * 2.0
            (folder / str(agent)).mkdir(parents=True, exist_ok=True)
            if request.param == "plain":
                content |= {"gps": [1e-3, 2.0], "lidar_pose": matrix.tolist(), "true_ego_pos": matrix.tolist()}
            text = yaml.dump(content).replace("numpy._core", request.param)
            (folder / str(agent) / f"{frame:06d}.yaml").write_text(text)
            (folder / str(agent) / f"{frame:06d}.pcd").write_bytes(encode_table(table))
    return folder


def test_both_cars_see_one_world(drive: Path) -> None:
    (reader,) = open_drives(drive.parent)
    assert reader.agents == (0, 1) and reader.frames == (0, 1, 2)
    frame = reader.read(1)
    assert frame.time_s == pytest.approx(0.1)
    assert [CLASSES[i] for i in frame.truth.label] == ["car", "truck", "pedestrian"]
    assert np.allclose(frame.truth.array, world_boxes(1), atol=1e-6)
    assert frame.points_on.tolist() == [[50, 50, 0], [50, 0, 50]]
    for agent, rows in zip(frame.agents, ((0, 1), (2, 0)), strict=True):
        assert len(agent.sweep) == 100 and agent.kind == "vehicle" and agent.speed == pytest.approx(10.0)
        inside = frame.truth.contains(agent.sweep.world_points, 0.01)
        assert np.array_equal(inside.argmax(axis=0), np.repeat(rows, 50)) and inside.any(axis=0).all()
        assert agent.sweep.intensity.max() == pytest.approx(198 / 255)


def test_ids_follow_an_object_and_are_nobodys_own(drive: Path) -> None:
    (reader,) = open_drives(drive)
    ids = [reader.read(i).truth.object_id.tolist() for i in range(3)]
    assert ids[0] == ids[1] == ids[2] and len(set(ids[0])) == 3
    assert not set(ids[0]) & set(reader.agents)
    sample = make_sample(
        reader.read(0), 0, SampleRequest(GridSpec((-100, -100, -10, 100, 100, 10)), comm_range_m=100.0)
    )
    assert len(sample.boxes) == 2  # the car and the truck; people are no vehicles


def test_an_agents_own_car_has_its_id(drive: Path) -> None:
    path = drive / "0" / "000000.yaml"
    content = read_yaml(path)
    other = np.linalg.inv(lidar(0, 0)) @ lidar(1, 0)
    yaw = float(np.degrees(np.arctan2(other[1, 0], other[0, 0])))
    own = {"angle": [0, yaw, 0], "center": [0, 0, 0], "extent": [2.4, 1.0, 0.8], "location": other[:3, 3].tolist()}
    content["vehicles"][9] = own | {"ass_id": 12, "obj_type": "Car"}
    content["vehicles"][9]["location"][2] -= 1.2
    path.write_text(yaml.dump(content))
    frame = open_drives(drive)[0].read(0)
    assert frame.truth.object_id[0] == 1 and len(frame.truth) == 4
    assert np.allclose(frame.truth.center[0, :2], lidar(1, 0)[:2, 3])
    wide = SampleRequest(GridSpec((-100, -100, -10, 100, 100, 10)), comm_range_m=100.0)
    assert len(make_sample(frame, 0, wide).boxes) == 3  # the other car is one for the first
    assert len(make_sample(frame, 1, wide).boxes) == 2  # and none for itself


def test_velocities_are_differences_of_places(drive: Path) -> None:
    (reader,) = open_drives(drive)
    for i in range(3):
        velocity = reader.read(i).velocity
        assert np.allclose(velocity[0], 8.0 * np.array([np.cos(0.3), np.sin(0.3)]), atol=1e-6)
        assert np.allclose(velocity[1:], 0.0, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"lidar_pose": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0]]}, "lidar_pose: expected 4 numbers"),
        ({"lidar_pose": np.diag([2.0, 1, 1, 1]).tolist()}, "lidar_pose: expected a rigid transform"),
        ({"lidar_pose": np.diag([1.0, -1, 1, 1]).tolist()}, "lidar_pose: expected a rigid transform"),
        ({"vehicles": {"a": {}}}, "vehicles: expected whole numbers as ids, found a"),
        ({"vehicles": {3: {"location": [0, 0]}}}, "vehicles.3.location: expected 3 numbers"),
        ({"vehicles": [1]}, "vehicles: expected a mapping"),
        (
            {"vehicles": {3: {"location": [0, 0, 0], "center": [0, 0, 0], "extent": [1, 1, 1], "ass_id": 10**30}}},
            "vehicles.3.ass_id: expected a number of an object",
        ),
    ],
)
def test_a_broken_file_gets_one_line(drive: Path, change: dict, message: str) -> None:
    path = drive / "1" / "000001.yaml"
    content = read_yaml(path)
    path.write_text(yaml.dump(content | change))
    with pytest.raises(DataError) as caught:
        open_drives(drive)[0].read(1)
    assert str(caught.value).startswith(str(path)) and message in str(caught.value) and "\n" not in str(caught.value)
