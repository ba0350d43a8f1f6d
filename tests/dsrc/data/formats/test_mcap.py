import base64
import json
from pathlib import Path

import numpy as np
import pytest

from dsrc.data.datasets.convert import convert
from dsrc.data.formats.mcap.file import quaternion
from dsrc.data.formats.opv2v.reader import write_frame
from sim.geometry import pose_matrix, transform_points
from tests.dsrc.data.toy import toy_frame

POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("object_id", "<i4")]
)


def rotation(q: dict[str, float]) -> np.ndarray:
    x, y, z, w = q["x"], q["y"], q["z"], q["w"]
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrix(place: dict[str, float], turn: dict[str, float]) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation(turn), [place[k] for k in "xyz"]
    return out


@pytest.mark.parametrize("angles", [(0.3, -0.2, 0.1), (3.1, 0.0, 0.0), (0.1, 0.2, 3.1), (0.4, 1.5, -0.3), (0, 0, 0)])
def test_a_quaternion_turns_as_its_matrix_does(angles: tuple[float, float, float]) -> None:
    turn = pose_matrix(np.zeros(3), *angles)
    found = quaternion(turn)
    assert np.linalg.norm(list(found.values())) == pytest.approx(1.0)
    assert np.allclose(rotation(found), turn[:3, :3], atol=1e-9)
    half_turn = pose_matrix(np.zeros(3), np.pi) @ pose_matrix(np.zeros(3), 0.0, np.pi)
    assert np.allclose(rotation(quaternion(half_turn)), half_turn[:3, :3], atol=1e-9)


def test_a_drive_is_one_file_that_the_mcap_reader_reads(tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap.reader")
    for index in range(2):
        write_frame(tmp_path / "data" / "toy", toy_frame(index))
    convert(tmp_path / "data", tmp_path / "out", "mcap")
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["conversion.json", "toy.mcap"]
    with (tmp_path / "out" / "toy.mcap").open("rb") as file:
        found = [
            (
                schema.name,
                schema.encoding,
                channel.topic,
                channel.message_encoding,
                message.log_time,
                json.loads(message.data),
            )
            for schema, channel, message in reader.make_reader(file).iter_messages()
        ]
    assert {row[1] for row in found} == {"jsonschema"} and {row[3] for row in found} == {"json"}
    assert {(row[0], row[2]) for row in found} == {
        ("foxglove.FrameTransforms", "/tf"),
        ("foxglove.SceneUpdate", "/truth"),
        *(("foxglove.PointCloud", f"/agents/{agent}/points") for agent in (1000, 1002, -1)),
    }
    second = {row[2]: row[5] for row in found if row[4] == 100_000_000}
    frame = toy_frame(1)
    poses = {
        t["child_frame_id"]: (t["parent_frame_id"], matrix(t["translation"], t["rotation"]))
        for t in second["/tf"]["transforms"]
    }
    for agent in frame.agents:
        parent, body_from_lidar = poses[f"lidar_{agent.agent_id}"]
        root, world_from_body = poses[parent]
        assert root == "world"
        cloud = second[f"/agents/{agent.agent_id}/points"]
        assert cloud["frame_id"] == f"lidar_{agent.agent_id}" and cloud["point_stride"] == POINT.itemsize
        assert [(f["name"], f["offset"], f["type"]) for f in cloud["fields"]] == [
            ("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("ring", 16, 3), ("object_id", 18, 6)
        ]  # fmt: skip
        points = np.frombuffer(base64.b64decode(cloud["data"]), POINT)
        world = transform_points(
            world_from_body @ body_from_lidar, np.stack([points[k] for k in "xyz"], axis=1).astype(float)
        )
        assert np.allclose(world, agent.sweep.world_points, atol=1e-5)
        assert np.array_equal(points["object_id"], agent.sweep.object_id)
    entities = {entity["id"]: entity for entity in second["/truth"]["entities"]}
    assert set(entities) == {str(i) for i in frame.truth.object_id}
    truck = entities["1001"]
    assert {"key": "class", "value": "truck"} in truck["metadata"] and truck["frame_id"] == "world"
    assert {"key": "lane", "value": "main_1"} in truck["metadata"]
    assert {"key": "visible_1000", "value": f"{frame.visible_fraction[0, 1]:.2f}"} in truck["metadata"]
    assert truck["cubes"][0]["size"] == {"x": 9.0, "y": 2.5, "z": 3.0}
    arrow = rotation(truck["arrows"][0]["pose"]["orientation"])[:, 0]
    assert np.allclose(arrow[:2] * np.hypot(*frame.velocity[1]), frame.velocity[1])
    assert entities["1005"]["arrows"] == []  # it stands


def test_without_the_package_one_line_names_the_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    from sim.errors import SettingsError

    write_frame(tmp_path / "data" / "toy", toy_frame(0))
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    with pytest.raises(SettingsError, match=r"pip install mcap"):
        convert(tmp_path / "data", tmp_path / "out", "mcap")
