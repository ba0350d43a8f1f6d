"""Loaders by the rules of two datasets' tools, written from descriptions of their files without our code.

Both follow the rules to the letter and give plain numbers, so that what they find is what other people find.
"""

import json
from pathlib import Path

import numpy as np
import yaml


def pcd(path: Path) -> dict[str, np.ndarray]:
    """Fields of a binary PCD file."""
    content = path.read_bytes()
    head, _, body = content.partition(b"DATA binary\n")
    lines = {line.split()[0]: line.split()[1:] for line in head.decode().splitlines() if not line.startswith("#")}
    kinds = {"F": "f", "U": "u", "I": "i"}
    dtype = np.dtype(
        [
            (name, f"<{kinds[kind]}{size}")
            for name, kind, size in zip(lines["FIELDS"], lines["TYPE"], lines["SIZE"], strict=True)
        ]
    )
    table = np.frombuffer(body, dtype, int(lines["POINTS"][0]))
    return {name: table[name] for name in lines["FIELDS"]}


def x_to_world(pose: list[float]) -> np.ndarray:
    """OPV2V's pose matrix: Rz(yaw) Ry(-pitch) Rx(-roll) of [x, y, z, roll, yaw, pitch], m and deg."""
    x, y, z, roll, yaw, pitch = pose
    a, b, c = np.radians([yaw, -pitch, -roll])
    rz = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    ry = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    rx = np.array([[1, 0, 0], [0, np.cos(c), -np.sin(c)], [0, np.sin(c), np.cos(c)]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rz @ ry @ rx, [x, y, z]
    return matrix


def apply(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]


def outside(points: np.ndarray, pose: np.ndarray, half: np.ndarray) -> np.ndarray:
    """How far points are out of a box with this pose and half size, m; 0 inside."""
    local = np.abs(apply(np.linalg.inv(pose), points)) - half
    return np.linalg.norm(np.maximum(local, 0.0), axis=1)


def opv2v(split: Path) -> list[dict]:
    """Samples of a split: per scenario and timestamp every agent's cloud in its own frame, pose and boxes."""
    samples = []
    for scenario in sorted(p for p in split.iterdir() if p.is_dir()):
        cavs = sorted(p.name for p in scenario.iterdir() if p.is_dir())
        assert cavs and all(str(int(name)) == name for name in cavs)
        if int(cavs[0]) < 0:  # a roadside unit is no ego
            cavs = [*cavs[1:], cavs[0]]
        stamps = sorted(
            p.name.removesuffix(".yaml") for p in (scenario / cavs[0]).glob("*.yaml") if "additional" not in p.name
        )
        assert len({len(stamp) for stamp in stamps}) == 1
        for stamp in stamps:
            agents = {}
            for cav in cavs:
                content = yaml.load((scenario / cav / f"{stamp}.yaml").read_text(), yaml.SafeLoader)
                assert "yaml_parser" not in content and isinstance(content["ego_speed"], float)
                for key in ("lidar_pose", "true_ego_pos", "predicted_ego_pos"):
                    assert len(content[key]) == 6 and all(type(v) is float for v in content[key])
                boxes = {}
                for number, vehicle in content["vehicles"].items():
                    assert type(number) is int
                    place = np.array(vehicle["location"]) + np.array(vehicle["center"])
                    pose = x_to_world([*place, *vehicle["angle"]])
                    boxes[number] = (pose, np.array(vehicle["extent"]))
                fields = pcd(scenario / cav / f"{stamp}.pcd")
                colors = np.stack([(fields["rgb"] >> shift & 255) / 255.0 for shift in (16, 8, 0)], axis=1)
                agents[int(cav)] = {
                    "points": np.stack([fields["x"], fields["y"], fields["z"]], axis=1),
                    "intensity": colors[:, 0],
                    "object_id": fields["object_id"],
                    "world_from_lidar": x_to_world(content["lidar_pose"]),
                    "boxes": boxes,
                }
            samples.append({"scenario": scenario.name, "stamp": stamp, "agents": agents})
    return samples


def dair(root: Path, frames: list[str]) -> list[dict]:
    """Samples of these vehicle frames: both clouds, their poses in the world and the cooperative boxes."""
    pairs = json.loads((root / "cooperative/data_info.json").read_text())
    by_frame = {pair["vehicle_pointcloud_path"].split("/")[-1].removesuffix(".pcd"): pair for pair in pairs}
    samples = []
    for frame in frames:
        pair = by_frame[frame]
        other = pair["infrastructure_pointcloud_path"].split("/")[-1].removesuffix(".pcd")
        first = rigid(json.loads((root / f"vehicle-side/calib/lidar_to_novatel/{frame}.json").read_text())["transform"])
        second = rigid(json.loads((root / f"vehicle-side/calib/novatel_to_world/{frame}.json").read_text()))
        infra = rigid(json.loads((root / f"infrastructure-side/calib/virtuallidar_to_world/{other}.json").read_text()))
        if pair["system_error_offset"] != "":
            infra[0, 3] += pair["system_error_offset"]["delta_x"]
            infra[1, 3] += pair["system_error_offset"]["delta_y"]
        agents = []
        for path, pose in (
            (pair["vehicle_pointcloud_path"], second @ first),
            (pair["infrastructure_pointcloud_path"], infra),
        ):
            fields = pcd(root / path)
            agents.append(
                {
                    "points": np.stack([fields["x"], fields["y"], fields["z"]], axis=1),
                    "intensity": fields["intensity"] / 256.0,
                    "object_id": fields["object_id"],
                    "world_from_lidar": pose,
                }
            )
        boxes = {}
        for label in json.loads((root / pair["cooperative_label_path"]).read_text()):
            corners = np.array(label["world_8_points"])
            along = corners[[0, 1, 4, 5]].mean(axis=0) - corners[[2, 3, 6, 7]].mean(axis=0)
            # Right of the front comes second: the corners go around clockwise, seen from above.
            across = corners[[0, 3, 4, 7]].mean(axis=0) - corners[[1, 2, 5, 6]].mean(axis=0)
            up = corners[4:].mean(axis=0) - corners[:4].mean(axis=0)
            pose, size = np.eye(4), np.array([np.linalg.norm(v) for v in (along, across, up)])
            pose[:3, :3] = np.stack([along, across, up], axis=1) / size
            pose[:3, 3] = corners.mean(axis=0)
            assert np.linalg.det(pose[:3, :3]) > 0.99
            boxes[int(label["track_id"])] = (pose, size / 2, label["type"])
        samples.append({"frame": frame, "agents": agents, "boxes": boxes})
    return samples


def rigid(table: dict) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(table["rotation"])
    matrix[:3, 3] = np.array(table["translation"]).reshape(3)
    return matrix
