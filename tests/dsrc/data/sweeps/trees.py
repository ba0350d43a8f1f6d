"""Test files in the layouts of other data sets, written by their libraries, else by hand after their documents."""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sim.boxes import CLASSES, Boxes
from sim.geometry import invert, pose_matrix, transform_points
from tests.dsrc.data.sweeps.scene import FRAMES, HEIGHT_M, instant

# A calibration of KITTI's first recording day, as published with the object benchmark (000000.txt), to 6 digits.
P2 = np.array(
    [[707.0493, 0.0, 604.0814, 45.75831], [0.0, 707.0493, 180.5066, -0.3454157], [0.0, 0.0, 1.0, 0.004981016]]
)
CAMERA_FROM_VELO = np.array(
    [
        [6.927964e-03, -9.999722e-01, -2.757829e-03, -2.457729e-02],
        [-1.162982e-03, 2.749836e-03, -9.999955e-01, -6.127237e-02],
        [9.999753e-01, 6.931141e-03, -1.143899e-03, -3.321029e-01],
    ]
)
KITTI_NAMES = {"car": "Car", "pedestrian": "Pedestrian"}


def numbers(values: NDArray[np.float64]) -> str:
    """Return a row of numbers as KITTI's calibrations have them."""
    return " ".join(f"{value:.12e}" for value in np.ravel(values))


def kitti_line(boxes: Boxes, row: int, before: str = "") -> str:
    """Return a label after the development kit's readme.

    `type truncated occluded alpha left top right bottom height width length x y z rotation_y`, the location the
    middle of the bottom in the rectified camera's frame (x right, y down, z forward).
    """
    bottom = boxes.center[row] - [0.0, 0.0, boxes.size[row, 2] / 2]
    x, y, z = CAMERA_FROM_VELO @ [*bottom, 1.0]
    u, v, w = P2 @ [*(CAMERA_FROM_VELO @ [*boxes.center[row], 1.0]), 1.0]
    length, width, height = boxes.size[row]
    turn = -boxes.yaw[row] - np.pi / 2
    left, top = u / w - 30, v / w - 30
    return (
        f"{before}{KITTI_NAMES[CLASSES[boxes.label[row]]]} 0.00 0 {turn - np.arctan2(x, z):.2f} {left:.2f} {top:.2f}"
        f" {left + 60:.2f} {top + 60:.2f} {height:.6f} {width:.6f} {length:.6f} {x:.6f} {y:.6f} {z:.6f} {turn:.6f}\n"
    )


def kitti_calibration(sign: str = ":") -> str:
    """Return the text of a calibration of the object benchmark."""
    rows = {f"P{k}": P2 for k in range(4)} | {"R0_rect": np.eye(3), "Tr_velo_to_cam": CAMERA_FROM_VELO}
    rows["Tr_imu_to_velo"] = np.eye(4)[:3]
    return "".join(f"{name}{sign} {numbers(row)}\n" for name, row in rows.items()) + "\n"


def kitti_object(folder: Path, more: str = "") -> Path:
    """KITTI's object tree, after the development kit's readme; `more` is added to each label file."""
    for name in ("velodyne", "label_2", "calib"):
        (folder / "training" / name).mkdir(parents=True)
    for index in range(FRAMES):
        now = instant(index)
        (folder / f"training/velodyne/{index:06d}.bin").write_bytes(now.points.tobytes())
        text = "".join(kitti_line(now.local, row) for row in range(len(now.local)))
        (folder / f"training/label_2/{index:06d}.txt").write_text(text + more)
        (folder / f"training/calib/{index:06d}.txt").write_text(kitti_calibration())
    return folder


def scans(folder: Path, labelled: bool = True) -> Path:
    """Folder of `.npy` scans, and their boxes in JSON."""
    (folder / "scans").mkdir(parents=True)
    frames = []
    for index in range(FRAMES):
        now = instant(index)
        np.save(folder / "scans" / f"{index:04d}.npy", now.points)
        names = [CLASSES[one] for one in now.local.label]
        ids = now.local.object_id.tolist()
        frames.append({"frame": index, "boxes": now.local.array.tolist(), "classes": names, "ids": ids})
    if labelled:
        (folder / "scans" / "boxes.json").write_text(json.dumps({"frames": frames}))
    return folder


def world_points(index: int) -> NDArray[np.float64]:
    """(P, 3) points of a frame in the world."""
    now = instant(index)
    return np.asarray(transform_points(now.world_from_lidar, now.points[:, :3].astype(np.float64)))


def argoverse(folder: Path) -> Path:
    """Log of Argoverse 2 by pyarrow, columns and types as in the user guide of the API `av2` (sensor dataset)."""
    import pyarrow
    from pyarrow import feather

    log = folder / "adcf7d18-0510-35b0-a2fa-b4cea13a6d76"
    (log / "sensors" / "lidar").mkdir(parents=True)
    (log / "calibration").mkdir()
    body_from_lidar = pose_matrix([1.35, 0.0, HEIGHT_M - 0.33], 0.02)
    start, lists = 315_966_265_259_836_000, {name: [] for name in _AV2_BOX}
    cars: dict[str, list] = {name: [] for name in ("timestamp_ns", *_AV2_POSE)}
    for index in range(FRAMES):
        now, stamp = instant(index), start + index * 100_000_000
        cars["timestamp_ns"].append(stamp)
        _add_pose(cars, now.world_from_lidar @ invert(body_from_lidar))
        points = transform_points(body_from_lidar, now.points[:, :3].astype(np.float64))
        table = {name: pyarrow.array(points[:, k].astype(np.float16)) for k, name in enumerate("xyz")}
        table["intensity"] = pyarrow.array(np.round(now.points[:, 3] * 255).astype(np.uint8))
        table["laser_number"] = pyarrow.array(now.ring)
        table["offset_ns"] = pyarrow.array(np.zeros(len(points), np.int32))
        feather.write_feather(pyarrow.table(table), log / "sensors" / "lidar" / f"{stamp}.feather", compression="lz4")
        for row, box in enumerate(now.local.transform(body_from_lidar).array):
            lists["timestamp_ns"].append(stamp)
            lists["track_uuid"].append(f"00000000-0000-0000-0000-{now.local.object_id[row]:012d}")
            lists["category"].append({"car": "REGULAR_VEHICLE"}.get(CLASSES[now.local.label[row]], "PEDESTRIAN"))
            for name, value in zip(("length_m", "width_m", "height_m"), box[3:6], strict=True):
                lists[name].append(value)
            _add_pose(lists, pose_matrix(box[:3], box[6]))
            lists["num_interior_pts"].append(120)
    feather.write_feather(pyarrow.table(lists), log / "annotations.feather", compression="uncompressed")
    feather.write_feather(pyarrow.table(cars), log / "city_SE3_egovehicle.feather", compression="uncompressed")
    mounts: dict[str, list] = {name: [] for name in ("sensor_name", *_AV2_POSE)}
    for name, pose in (("down_lidar", np.diag([1.0, -1.0, -1.0, 1.0])), ("up_lidar", body_from_lidar)):
        mounts["sensor_name"].append(name)
        _add_pose(mounts, pose)
    feather.write_feather(pyarrow.table(mounts), log / "calibration" / "egovehicle_SE3_sensor.feather")
    return folder


_AV2_POSE = ("qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
_AV2_BOX = (
    *("timestamp_ns", "track_uuid", "category", "length_m", "width_m", "height_m"),
    *_AV2_POSE,
    "num_interior_pts",
)


def quaternion(pose: NDArray[np.float64]) -> list[float]:
    """Quaternion w, x, y, z of a pose, by scipy."""
    return [float(value) for value in Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)]


def _add_pose(table: dict[str, list], pose: NDArray[np.float64]) -> None:
    for name, value in zip(_AV2_POSE, [*quaternion(pose), *pose[:3, 3].tolist()], strict=True):
        table[name].append(value)


def nuscenes(folder: Path) -> Path:
    """Tables of nuScenes by hand, after docs/schema_nuscenes.md of nuscenes-devkit."""
    version = folder / "v1.0-mini"
    version.mkdir(parents=True)
    (folder / "samples" / "LIDAR_TOP").mkdir(parents=True)
    # The LiDAR's x points to the right there.
    body_from_lidar = pose_matrix([0.94, 0.0, 1.84], -np.pi / 2)
    ours_from_theirs = pose_matrix([0.0, 0.0, 0.0], -np.pi / 2)
    tables: dict[str, list] = {
        "log": [{"token": "l", "logfile": "x", "vehicle": "n", "date_captured": "2018-07-24", "location": "boston"}],
        "map": [{"token": "m", "log_tokens": ["l"], "category": "semantic_prior", "filename": ""}],
        "sensor": [
            {"token": "s0", "channel": "CAM_FRONT", "modality": "camera"},
            {"token": "s1", "channel": "LIDAR_TOP", "modality": "lidar"},
        ],
        "calibrated_sensor": [
            {
                "token": "c1",
                "sensor_token": "s1",
                "translation": body_from_lidar[:3, 3].tolist(),
                "rotation": quaternion(body_from_lidar),
                "camera_intrinsic": [],
            }
        ],
        "category": [
            {"token": "k1", "name": "vehicle.car", "description": ""},
            {"token": "k2", "name": "human.pedestrian.adult", "description": ""},
        ],
        "attribute": [],
        "visibility": [{"token": "4", "level": "v80-100", "description": ""}],
        "instance": [
            {
                "token": f"i{one}",
                "category_token": f"k{one}",
                "nbr_annotations": FRAMES,
                "first_annotation_token": f"a0_{one}",
                "last_annotation_token": f"a{FRAMES - 1}_{one}",
            }
            for one in (1, 2)
        ],
        "scene": [
            {
                "token": "w",
                "log_token": "l",
                "nbr_samples": FRAMES,
                "first_sample_token": "f0",
                "last_sample_token": f"f{FRAMES - 1}",
                "name": "scene-0061",
                "description": "",
            }
        ],
        "sample": [],
        "sample_data": [],
        "ego_pose": [],
        "sample_annotation": [],
    }
    for index in range(FRAMES):
        now, stamp = instant(index), 1_532_402_927_647_951 + index * 100_000
        name = f"samples/LIDAR_TOP/n015-2018-07-24__LIDAR_TOP__{stamp}.pcd.bin"
        theirs = transform_points(invert(ours_from_theirs), now.points[:, :3].astype(np.float64))
        rows = np.column_stack([theirs, np.round(now.points[:, 3] * 255), now.ring])
        (folder / name).write_bytes(rows.astype("<f4").tobytes())
        body = now.world_from_lidar @ ours_from_theirs @ invert(body_from_lidar)
        pose = {"timestamp": stamp, "rotation": quaternion(body), "translation": body[:3, 3].tolist()}
        tables["ego_pose"].append({"token": f"e{index}", **pose})
        around = {"prev": f"f{index - 1}" if index else "", "next": f"f{index + 1}" if index + 1 < FRAMES else ""}
        tables["sample"].append({"token": f"f{index}", "timestamp": stamp, "scene_token": "w", **around})
        tables["sample_data"].append(
            {
                "token": f"d{index}",
                "sample_token": f"f{index}",
                "ego_pose_token": f"e{index}",
                "calibrated_sensor_token": "c1",
                "filename": name,
                "fileformat": "pcd",
                "width": 0,
                "height": 0,
                "timestamp": stamp,
                "is_key_frame": True,
                "prev": "",
                "next": "",
            }
        )
        for row, box in enumerate(now.boxes.array):
            one = int(now.boxes.object_id[row])
            tables["sample_annotation"].append(
                {
                    "token": f"a{index}_{one}",
                    "sample_token": f"f{index}",
                    "instance_token": f"i{one}",
                    "attribute_tokens": [],
                    "visibility_token": "4",
                    "translation": box[:3].tolist(),
                    "size": [box[4], box[3], box[5]],
                    "rotation": quaternion(pose_matrix(box[:3], box[6])),
                    "num_lidar_pts": 120,
                    "num_radar_pts": 0,
                    "prev": f"a{index - 1}_{one}" if index else "",
                    "next": f"a{index + 1}_{one}" if index + 1 < FRAMES else "",
                }
            )
    for name, rows in tables.items():
        (version / f"{name}.json").write_text(json.dumps(rows))
    return folder


def rosbag(folder: Path, storage: str = "mcap", before: str = "") -> Path:
    """Bag of rosbag2 by `rosbags`: two LiDARs on a car, `/tf` and `/tf_static`; no boxes.

    Args:
        before: text before the names of the clouds' frames.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types

    def of(kind: str, **values: object) -> object:
        return types[kind](**values)

    def header(stamp: int, name: str) -> object:
        time = of("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        return of("std_msgs/msg/Header", stamp=time, frame_id=name)

    def transform(stamp: int, parent: str, child: str, pose: NDArray[np.float64]) -> object:
        w, x, y, z = quaternion(pose)
        turn = of("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
        place = of("geometry_msgs/msg/Vector3", **dict(zip("xyz", pose[:3, 3].tolist(), strict=True)))
        inner = of("geometry_msgs/msg/Transform", translation=place, rotation=turn)
        return of(
            "geometry_msgs/msg/TransformStamped", header=header(stamp, parent), child_frame_id=child, transform=inner
        )

    def cloud(stamp: int, name: str, points: NDArray[np.float32], ring: NDArray[np.uint8]) -> object:
        # As the driver of Velodyne writes it: x, y, z, intensity to 255, ring, 22 bytes a point with the time.
        table = np.zeros(
            len(points),
            np.dtype(
                [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")]
            ),
        )
        table["x"], table["y"], table["z"] = points[:, :3].T
        table["intensity"], table["ring"] = np.round(points[:, 3] * 255), ring
        fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("ring", 16, 4), ("time", 18, 7)]
        return of(
            "sensor_msgs/msg/PointCloud2",
            header=header(stamp, name),
            height=1,
            width=len(table),
            fields=[
                of("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=kind, count=1)
                for name, offset, kind in fields
            ],
            is_bigendian=False,
            point_step=22,
            row_step=22 * len(table),
            data=np.frombuffer(table.tobytes(), np.uint8),
            is_dense=True,
        )

    plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
    tf, points_kind = "tf2_msgs/msg/TFMessage", "sensor_msgs/msg/PointCloud2"
    mounts = {"top": pose_matrix([0.5, 0.0, HEIGHT_M]), "rear": pose_matrix([-2.0, 0.0, 0.8], np.pi)}
    folder.mkdir(parents=True, exist_ok=True)
    with Writer(folder / "bag", version=9, storage_plugin=plugin) as writer:
        moving = writer.add_connection("/tf", tf, typestore=store)
        fixed = writer.add_connection("/tf_static", tf, typestore=store)
        sensors = {
            name: writer.add_connection(f"/{name}/velodyne_points", points_kind, typestore=store) for name in mounts
        }
        start = 1_700_000_000_000_000_000
        steps = [transform(start, "base_link", name, pose) for name, pose in mounts.items()]
        writer.write(fixed, start, store.serialize_cdr(of(tf, transforms=steps), tf))
        for index in range(FRAMES):
            now, stamp = instant(index), start + index * 100_000_000
            body = now.world_from_lidar @ invert(mounts["top"])
            step = [transform(stamp, "map", "base_link", body)]
            writer.write(moving, stamp, store.serialize_cdr(of(tf, transforms=step), tf))
            for name, mount in mounts.items():
                local = transform_points(invert(mount) @ mounts["top"], now.points[:, :3].astype(np.float64))
                rows = np.column_stack([local, now.points[:, 3]]).astype(np.float32)
                # A message is written a while after the sweep that it holds.
                written = store.serialize_cdr(cloud(stamp, f"{before}{name}", rows, now.ring), points_kind)
                writer.write(sensors[name], stamp + 7_000_000, written)
    return folder


def kitti_tracking(folder: Path) -> Path:
    """KITTI's tracking tree, after the development kit's readme; names of its calibration as published."""
    split = folder / "training"
    for name in ("velodyne/0000", "label_02", "calib", "oxts"):
        (split / name).mkdir(parents=True)
    labels, oxts = "", ""
    # The inertial unit is put into the LiDAR; 49 degrees north, where KITTI was recorded.
    latitude, longitude, earth_m = 49.0, 8.4, 6378137.0
    for index in range(FRAMES):
        now, first = instant(index), instant(0)
        (split / f"velodyne/0000/{index:06d}.bin").write_bytes(now.points.tobytes())
        labels += "".join(kitti_line(now.local, row, f"{index} {now.local.object_id[row] - 1} ") for row in range(2))
        east, north = (now.world_from_lidar - first.world_from_lidar)[:2, 3]
        north_deg = np.degrees(north / earth_m)
        east_deg = np.degrees(east / (earth_m * np.cos(np.radians(latitude))))
        yaw = np.arctan2(now.world_from_lidar[1, 0], now.world_from_lidar[0, 0])
        numbers_of = [latitude + north_deg, longitude + east_deg, 115.0, 0.0, 0.0, yaw, *([0.0] * 24)]
        oxts += " ".join(f"{value:.14g}" for value in numbers_of) + "\n"
    labels += "0 -1 DontCare -1 -1 -10.0 219.3 188.5 245.5 218.6 -1000 -1000 -1000 -10 -1 -1 -1\n"
    (split / "label_02" / "0000.txt").write_text(labels)
    (split / "oxts" / "0000.txt").write_text(oxts)
    rows = {f"P{k}:": P2 for k in range(4)} | {"R_rect": np.eye(3), "Tr_velo_cam": CAMERA_FROM_VELO}
    rows["Tr_imu_velo"] = np.eye(4)[:3]
    (split / "calib" / "0000.txt").write_text("".join(f"{name} {numbers(row)}\n" for name, row in rows.items()))
    return folder


def semantic_kitti(folder: Path) -> Path:
    """Sequence of SemanticKITTI, after the readmes of its API and of KITTI's odometry development kit."""
    sequence = folder / "sequences" / "00"
    (sequence / "velodyne").mkdir(parents=True)
    camera = np.vstack([CAMERA_FROM_VELO, [0.0, 0.0, 0.0, 1.0]])
    poses, times = "", ""
    for index in range(FRAMES):
        now = instant(index)
        (sequence / f"velodyne/{index:06d}.bin").write_bytes(now.points.tobytes())
        moved = np.linalg.inv(instant(0).world_from_lidar) @ now.world_from_lidar
        poses += numbers((camera @ moved @ np.linalg.inv(camera))[:3]) + "\n"
        times += f"{now.time_s:.6e}\n"
    (sequence / "poses.txt").write_text(poses)
    (sequence / "times.txt").write_text(times)
    text = "".join(f"P{k}: {numbers(P2)}\n" for k in range(4)) + f"Tr: {numbers(CAMERA_FROM_VELO)}\n"
    (sequence / "calib.txt").write_text(text)
    return folder


def openlabel(folder: Path, merged_only: bool = False) -> Path:
    """Split of TUMTraf V2X by hand: a vehicle's LiDAR, one at the road, and the cloud that was merged of theirs.

    After the JSON schema of ASAM OpenLABEL 1.0.0 (`coordinate_systems`, `frames`, `frame_properties`, `cuboid`); names
    and places of fields after the TUM Traffic dataset development kit, whose transform of the LiDAR at the road to its
    base is the inverse of that in `coordinate_systems`. Labels are in the frame of the LiDAR at the road.
    """
    road, vehicle = "s110_lidar_ouster_south", "vehicle_lidar_robosense"
    merged = f"{road}_and_{vehicle}_registered"
    split = folder / "train"
    for name in (road, vehicle, merged):
        (split / "point_clouds" / name).mkdir(parents=True)
    (split / "labels_point_clouds" / merged).mkdir(parents=True)
    world_from_base, base_from_road = pose_matrix([90.0, 40.0, 0.0], 0.7), pose_matrix([-1.5, 2.0, 7.48], 1.3)
    world_from_road = world_from_base @ base_from_road
    systems = {
        "hd_map_origin": {"type": "scene_cs", "parent": "", "children": ["s110_base"]},
        "s110_base": {
            "type": "scene_cs",
            "parent": "hd_map_origin",
            "children": [road],
            "pose_wrt_parent": {"matrix4x4": world_from_base.ravel().tolist()},
        },
        road: {
            "type": "sensor_cs",
            "parent": "s110_base",
            "children": [],
            "pose_wrt_parent": {"matrix4x4": base_from_road.ravel().tolist()},
        },
    }
    for index in range(FRAMES):
        now, nanoseconds = instant(index), 146_525_143 + index * 100_000_000
        names = {name: f"1688625741_{nanoseconds}_{name}.pcd" for name in (road, vehicle, merged)}
        road_from_vehicle = invert(world_from_road) @ now.world_from_lidar
        at_road = np.asarray(transform_points(road_from_vehicle, now.points[:, :3].astype(np.float64)))
        seen = np.column_stack([at_road, now.points[:, 3]]).astype("<f4")
        clouds = {road: seen, vehicle: now.points, merged: np.concatenate([seen, seen])}
        for name, points in clouds.items():
            if name == merged or not merged_only:
                (split / "point_clouds" / name / names[name]).write_bytes(pcd(points))
        transforms = {
            f"{vehicle}_to_{road}": {
                "src": vehicle,
                "dst": road,
                "transform_src_to_dst": {"matrix4x4": road_from_vehicle.tolist()},
            },
            f"{road}_to_s110_base": {
                "src": road,
                "dst": "s110_base",
                "transform_src_to_dst": {"matrix4x4": invert(base_from_road).ravel().tolist()},
            },
        }
        objects = {}
        boxes = now.boxes.transform(invert(world_from_road))
        for row, (x, y, z, *size, yaw) in enumerate(boxes.array.tolist()):
            qw, qx, qy, qz = quaternion(pose_matrix([x, y, z], yaw))
            kind = CLASSES[boxes.label[row]].upper()
            cuboid = {"name": "shape3D", "val": [x, y, z, qx, qy, qz, qw, *size], "attributes": {"text": [], "num": []}}
            identity = f"0f6c3a54-0000-4000-8000-{boxes.object_id[row]:012d}"
            objects[identity] = {"object_data": {"name": f"{kind}_{row}", "type": kind, "cuboid": cuboid}}
        properties = {
            "timestamp": 1688625741 + nanoseconds * 1e-9,
            "image_file_names": [],
            "point_cloud_file_names": [names[name] for name in (vehicle, road, merged)],
            "transforms": transforms,
        }
        frame = {"frame_properties": properties, "objects": objects}
        content = {
            "metadata": {"schema_version": "1.0.0"},
            "coordinate_systems": systems,
            "frames": {str(index): frame},
        }
        place = split / "labels_point_clouds" / merged / f"{Path(names[merged]).stem}.json"
        place.write_text(json.dumps({"openlabel": content}))
    return folder


def pcd(points: NDArray[np.float32]) -> bytes:
    """Binary PCD of (P, 4) x, y, z, intensity, after PCL's documentation of version 0.7."""
    count = len(points)
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\n"
        f"COUNT 1 1 1 1\nWIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n"
    )
    return header.encode() + points.astype("<f4").tobytes()
