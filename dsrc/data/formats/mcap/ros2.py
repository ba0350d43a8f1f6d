"""ROS 2 messages in MCAP: one file per drive with transforms, clouds and ground truth, for rosbag2, RViz and Foxglove.

    /tf                 tf2_msgs/TFMessage              world -> agent_ID -> lidar_ID
    /agents/ID/points   sensor_msgs/PointCloud2         x, y, z, intensity (0 to 1), ring, object_id in lidar_ID
    /truth              visualization_msgs/MarkerArray  a cube per object in the world: ns is its class, id its id

Needs the packages `rosbags` and `mcap`. Source: the message definitions of ROS 2 Humble; https://mcap.dev/spec/registry.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsrc.data.formats.mcap.file import (
    POINT,
    MessageFile,
    point_fields,
    point_table,
    quaternion,
    seconds_of,
    transform_steps,
)
from sensors.frame import AgentFrame, Frame
from sim.boxes import CLASSES
from sim.errors import SettingsError

TF, CLOUD, MARKERS = "tf2_msgs/msg/TFMessage", "sensor_msgs/msg/PointCloud2", "visualization_msgs/msg/MarkerArray"
_DATATYPES = {"<f4": 7, "<u2": 4, "<i4": 5}
"""Values of `sensor_msgs/PointField.datatype`."""
_CUBE = 1


class Ros2File(MessageFile):
    """MCAP file of ROS 2 messages that appears when it is closed."""

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            SettingsError: a package is missing.
        """
        try:
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            hint = "pip install 'dsrc-testbed[ros]'"
            raise SettingsError(f"ros2: expected the package rosbags, found none; {hint}") from None
        self._store: Any = get_typestore(Stores.ROS2_HUMBLE)
        texts = {kind: self._store.generate_msgdef(kind, ros_version=2)[0].encode() for kind in (TF, CLOUD, MARKERS)}
        super().__init__(path, "ros2", "cdr", "ros2msg", texts)

    def _write(self, frame: Frame) -> None:
        self._add("/tf", TF, frame.time_s, self._transforms(frame))
        for agent in frame.agents:
            self._add(f"/agents/{agent.agent_id}/points", CLOUD, frame.time_s, self._cloud(agent, frame.time_s))
        self._add("/truth", MARKERS, frame.time_s, self._markers(frame))

    def _add(self, topic: str, kind: str, time_s: float, message: object) -> None:
        self._message(topic, kind, time_s, bytes(self._store.serialize_cdr(message, kind)))

    def _of(self, kind: str, **values: object) -> Any:
        """Return a message of a kind; names without a package are of geometry_msgs."""
        return self._store.types[kind if "/" in kind else f"geometry_msgs/msg/{kind}"](**values)

    def _header(self, time_s: float, frame_id: str) -> Any:
        seconds, nanoseconds = seconds_of(time_s)
        stamp = self._of("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        return self._of("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)

    def _vector(self, values: NDArray[np.float64], kind: str = "Vector3") -> Any:
        return self._of(kind, **dict(zip("xyz", values.tolist(), strict=True)))

    def _transforms(self, frame: Frame) -> Any:
        transforms = [
            self._of(
                "TransformStamped",
                header=self._header(frame.time_s, parent),
                child_frame_id=child,
                transform=self._of(
                    "Transform",
                    translation=self._vector(matrix[:3, 3]),
                    rotation=self._of("Quaternion", **quaternion(matrix)),
                ),
            )
            for parent, child, matrix in transform_steps(frame)
        ]
        return self._of(TF, transforms=transforms)

    def _cloud(self, agent: AgentFrame, time_s: float) -> Any:
        table = point_table(agent)
        return self._of(
            CLOUD,
            header=self._header(time_s, f"lidar_{agent.agent_id}"),
            height=1,
            width=len(table),
            fields=[
                self._of("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=number, count=1)
                for name, offset, number in point_fields(_DATATYPES)
            ],
            is_bigendian=False,
            point_step=POINT.itemsize,
            row_step=POINT.itemsize * len(table),
            data=np.frombuffer(table.tobytes(), np.uint8),
            is_dense=True,
        )

    def _markers(self, frame: Frame) -> Any:
        boxes = frame.truth
        poses = frame.bodies()
        markers = [
            self._of(
                "visualization_msgs/msg/Marker",
                header=self._header(frame.time_s, "world"),
                ns=CLASSES[boxes.label[row]],
                id=int(boxes.object_id[row]),
                type=_CUBE,
                action=0,
                pose=self._of(
                    "Pose",
                    position=self._vector(poses[row, :3, 3], "Point"),
                    orientation=self._of("Quaternion", **quaternion(poses[row])),
                ),
                scale=self._vector(boxes.size[row]),
                color=self._of("std_msgs/msg/ColorRGBA", r=0.2, g=0.55, b=0.9, a=0.45),
                lifetime=self._of("builtin_interfaces/msg/Duration", sec=0, nanosec=200_000_000),
                frame_locked=False,
                points=[],
                colors=[],
                texture_resource="",
                texture=self._of(
                    "sensor_msgs/msg/CompressedImage",
                    header=self._header(frame.time_s, ""),
                    format="",
                    data=np.zeros(0, np.uint8),
                ),
                uv_coordinates=[],
                text="",
                mesh_resource="",
                mesh_file=self._of("visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8)),
                mesh_use_embedded_materials=False,
            )
            for row in range(len(boxes))
        ]
        return self._of(MARKERS, markers=markers)
