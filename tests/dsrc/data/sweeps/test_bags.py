"""Foxglove's messages in MCAP, written by its own package, as others write them than we do."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dsrc.data.datasets.convert import convert
from dsrc.data.drives import Drive, open_drives
from dsrc.data.formats.opv2v.reader import write_frame
from sim.errors import DataError
from tests.dsrc.data.toy import toy_frame

reader = pytest.importorskip("mcap.reader")
writer = pytest.importorskip("mcap.writer")
CLOUD = "foxglove.PointCloud"


def rewritten(folder: Path, change: Callable[[str, dict[str, Any]], None], encoding: str = "json") -> Path:
    """Write a drive as a bag, then each message anew after a change; a cloud's channel names its encoding."""
    write_frame(folder / "data" / "toy", toy_frame(0))
    convert(folder / "data", folder / "out", "mcap")
    path = folder / "changed.mcap"
    with (folder / "out" / "toy.mcap").open("rb") as source, path.open("wb") as target:
        out, channels = writer.Writer(target), dict[int, int]()
        out.start()
        for schema, channel, message in reader.make_reader(source).iter_messages():
            if channel.id not in channels:
                kind = out.register_schema(schema.name, schema.encoding, schema.data)
                said = encoding if schema.name == CLOUD else "json"
                channels[channel.id] = out.register_channel(channel.topic, said, kind)
            content = json.loads(message.data)
            change(schema.name, content)
            out.add_message(channels[channel.id], message.log_time, json.dumps(content).encode(), message.publish_time)
        out.finish()
    return path


def opened(path: Path) -> Drive:
    (drive,) = open_drives(path)
    return drive


def test_a_slash_before_the_frame_of_a_cloud_or_a_transform_is_none_of_its_name(tmp_path: Path) -> None:
    def slash(kind: str, content: dict[str, Any]) -> None:
        if kind == CLOUD:
            content["frame_id"] = f"/{content['frame_id']}"
        for one in content.get("transforms", ())[::2]:
            one["child_frame_id"] = f"/{one['child_frame_id']}"

    plain, changed = opened(rewritten(tmp_path / "a", lambda *_: None)), opened(rewritten(tmp_path / "b", slash))
    poses = [[agent.sweep.world_from_lidar for agent in drive.read(0).agents] for drive in (plain, changed)]
    assert np.abs(poses[0][1][:3, 3]).max() > 1.0
    assert np.array_equal(poses[0], poses[1])


@pytest.mark.parametrize(("turn", "moved"), [(0.0, False), (1e-17, False), (0.1, True)])
def test_a_cloud_with_a_pose_of_its_own_is_refused(tmp_path: Path, turn: float, moved: bool) -> None:
    def turned(kind: str, content: dict[str, Any]) -> None:
        if kind == CLOUD:
            orientation = {"x": 0.0, "y": 0.0, "z": turn, "w": 1.0}
            content["pose"] = {"position": dict.fromkeys("xyz", 0.0), "orientation": orientation}

    path = rewritten(tmp_path, turned)
    if not moved:
        assert len(opened(path).read(0).agents) == 3
        return
    with pytest.raises(DataError, match=r"changed\.mcap: /agents/.*/points: pose: expected none"):
        opened(path)


def test_another_encoding_than_json_is_named(tmp_path: Path) -> None:
    path = rewritten(tmp_path, lambda *_: None, encoding="protobuf")
    with pytest.raises(DataError, match=r"changed\.mcap: /agents/.*: expected messages in json, .*found protobuf"):
        opened(path)
