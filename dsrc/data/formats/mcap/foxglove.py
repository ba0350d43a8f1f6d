"""MCAP writer for Foxglove: one file per drive with transforms, clouds and ground truth, in Foxglove's JSON schemas.

    /tf                 foxglove.FrameTransforms   world -> agent_ID -> lidar_ID
    /agents/ID/points   foxglove.PointCloud        x, y, z, intensity, ring, object_id in lidar_ID
    /truth              foxglove.SceneUpdate       a box per object in the world, coloured by class, and its velocity

Needs the package `mcap`: pip install mcap.

Source: https://docs.foxglove.dev/docs/sdk/schemas, https://mcap.dev/spec
"""

import base64
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from sensors.frame import AgentFrame, Frame
from sim.boxes import CLASSES
from sim.errors import SettingsError
from sim.files import named, replacing
from sim.geometry import invert, pose_matrix
from sim.traffic.base import lit

_POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("object_id", "<i4")]
)
_NUMBER_TYPES = {"<f4": 7, "<u2": 3, "<i4": 6}
"""Numbers of `foxglove.NumericType`."""
_COLORS = {
    "car": (0.20, 0.55, 0.90),
    "van": (0.15, 0.70, 0.75),
    "truck": (0.90, 0.55, 0.15),
    "bus": (0.85, 0.30, 0.30),
    "motorcycle": (0.65, 0.40, 0.85),
    "bicycle": (0.35, 0.75, 0.35),
    "pedestrian": (0.90, 0.80, 0.25),
}
_LIFETIME = {"sec": 0, "nsec": 0}

_TIME: dict[str, Any] = {
    "type": "object",
    "title": "time",
    "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
}


def _object(**properties: object) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


def _list(items: dict[str, object]) -> dict[str, Any]:
    return {"type": "array", "items": items}


_TEXT, _REAL, _WHOLE, _TRUTH = ({"type": name} for name in ("string", "number", "integer", "boolean"))
_VECTOR = _object(x=_REAL, y=_REAL, z=_REAL)
_TURN = _object(x=_REAL, y=_REAL, z=_REAL, w=_REAL)
_POSE = _object(position=_VECTOR, orientation=_TURN)
_COLOR = _object(r=_REAL, g=_REAL, b=_REAL, a=_REAL)
_CUBE = _object(pose=_POSE, size=_VECTOR, color=_COLOR)
_ARROW = _object(
    pose=_POSE, shaft_length=_REAL, shaft_diameter=_REAL, head_length=_REAL, head_diameter=_REAL, color=_COLOR
)
_ENTITY = _object(
    timestamp=_TIME,
    frame_id=_TEXT,
    id=_TEXT,
    lifetime=_object(sec=_WHOLE, nsec=_WHOLE),
    frame_locked=_TRUTH,
    metadata=_list(_object(key=_TEXT, value=_TEXT)),
    arrows=_list(_ARROW),
    cubes=_list(_CUBE),
)
SCHEMAS: dict[str, dict[str, Any]] = {
    "foxglove.FrameTransforms": _object(
        transforms=_list(
            _object(timestamp=_TIME, parent_frame_id=_TEXT, child_frame_id=_TEXT, translation=_VECTOR, rotation=_TURN)
        )
    ),
    "foxglove.PointCloud": _object(
        timestamp=_TIME,
        frame_id=_TEXT,
        pose=_POSE,
        point_stride=_WHOLE,
        fields=_list(_object(name=_TEXT, offset=_WHOLE, type=_WHOLE)),
        data={"type": "string", "contentEncoding": "base64"},
    ),
    "foxglove.SceneUpdate": _object(
        deletions=_list(_object(timestamp=_TIME, type=_WHOLE, id=_TEXT)), entities=_list(_ENTITY)
    ),
}


class McapFile:
    """MCAP file that appears when it is closed."""

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            SettingsError: the package is missing.
        """
        try:
            from mcap.writer import Writer
        except ImportError:
            raise SettingsError("mcap: expected the package mcap, found none; pip install mcap") from None
        self.path = path
        self._replacing = replacing(path)
        self._file = self._replacing.__enter__().open("wb")
        self._writer = Writer(self._file)
        self._writer.start(profile="", library="dsrc-testbed")
        self._schemas = {
            name: self._writer.register_schema(name, "jsonschema", msgspec.json.encode({"title": name, **schema}))
            for name, schema in SCHEMAS.items()
        }
        self._channels: dict[str, int] = {}
        self._frames = 0
        self._shown: set[str] = set()

    def write(self, frame: Frame) -> None:
        """Append a frame."""
        entities = _entities(frame)
        names = {entity["id"] for entity in entities}
        gone = [{"timestamp": _time(frame.time_s), "type": 0, "id": name} for name in sorted(self._shown - names)]
        with named(self.path):
            self._message("/tf", "foxglove.FrameTransforms", frame.time_s, _transforms(frame))
            for agent in frame.agents:
                topic = f"/agents/{agent.agent_id}/points"
                self._message(topic, "foxglove.PointCloud", frame.time_s, _cloud(agent, frame.time_s))
            self._message("/truth", "foxglove.SceneUpdate", frame.time_s, {"deletions": gone, "entities": entities})
        self._shown = names
        self._frames += 1

    def close(self) -> None:
        """Finish the file and move it to its path."""
        with named(self.path):
            self._writer.finish()
            self._file.close()
            self._replacing.__exit__(None, None, None)

    def _message(self, topic: str, schema: str, time_s: float, message: dict[str, object]) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, "json", self._schemas[schema])
        nanoseconds = round(time_s * 1e9)
        self._writer.add_message(
            self._channels[topic], nanoseconds, msgspec.json.encode(message), nanoseconds, self._frames
        )


def _time(time_s: float) -> dict[str, int]:
    seconds, nanoseconds = divmod(round(time_s * 1e9), 10**9)
    return {"sec": seconds, "nsec": nanoseconds}


def _vector(xyz: NDArray[np.float64]) -> dict[str, float]:
    return dict(zip("xyz", xyz.tolist(), strict=True))


def quaternion(matrix: NDArray[np.float64]) -> dict[str, float]:
    """Return the rotation of a (4, 4) transform as a unit quaternion."""
    m = matrix[:3, :3]
    # Of the four forms the one with the largest divisor (Shepperd, 1978).
    squares = np.array([1 + m[0, 0] - m[1, 1] - m[2, 2], 1 - m[0, 0] + m[1, 1] - m[2, 2]])
    squares = np.append(squares, [1 - m[0, 0] - m[1, 1] + m[2, 2], 1 + m[0, 0] + m[1, 1] + m[2, 2]])
    x, y, z, w = squares
    a, b, c = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    d, e, f = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    rows = np.array([[x, d, e, a], [d, y, f, b], [e, f, z, c], [a, b, c, w]])
    best = rows[int(np.argmax(squares))]
    return dict(zip("xyzw", (best / np.linalg.norm(best)).tolist(), strict=True))


def _pose(matrix: NDArray[np.float64]) -> dict[str, Any]:
    return {"position": _vector(matrix[:3, 3]), "orientation": quaternion(matrix)}


def _transforms(frame: Frame) -> dict[str, Any]:
    transforms = []
    for agent in frame.agents:
        body = agent.world_from_body
        steps = [("world", f"agent_{agent.agent_id}", body)]
        steps.append((steps[0][1], f"lidar_{agent.agent_id}", invert(body) @ agent.sweep.world_from_lidar))
        transforms += [
            {
                "timestamp": _time(frame.time_s),
                "parent_frame_id": parent,
                "child_frame_id": child,
                "translation": _vector(matrix[:3, 3]),
                "rotation": quaternion(matrix),
            }
            for parent, child, matrix in steps
        ]
    return {"transforms": transforms}


def _cloud(agent: AgentFrame, time_s: float) -> dict[str, Any]:
    sweep = agent.sweep
    table = np.zeros(len(sweep), _POINT)
    table["x"], table["y"], table["z"] = sweep.points.T
    table["intensity"], table["object_id"] = sweep.intensity, sweep.object_id
    table["ring"] = np.maximum(sweep.ring, 0)
    fields = _POINT.names or ()
    return {
        # The frame's time, which the transforms have, not the sweep's own.
        "timestamp": _time(time_s),
        "frame_id": f"lidar_{agent.agent_id}",
        "pose": _pose(np.eye(4)),
        "point_stride": _POINT.itemsize,
        "fields": [
            {"name": name, "offset": offset, "type": _NUMBER_TYPES[_POINT[name].str]}
            for name, offset in zip(
                fields, np.cumsum([0, *(_POINT[name].itemsize for name in fields[:-1])]).tolist(), strict=True
            )
        ],
        "data": base64.b64encode(table.tobytes()).decode("ascii"),
    }


def _entities(frame: Frame) -> list[dict[str, Any]]:
    boxes = frame.truth
    poses = pose_matrix(boxes.center, boxes.yaw)
    agents = [agent.agent_id for agent in frame.agents]
    entities = []
    for row, object_id in enumerate(boxes.object_id.tolist()):
        name = CLASSES[boxes.label[row]]
        color = dict(zip("rgb", _COLORS[name], strict=True))
        points = {f"points_{agent}": int(frame.points_on[k, row]) for k, agent in enumerate(agents)}
        velocity = frame.velocity[row]
        speed = float(np.hypot(*velocity))
        facts = {
            "class": name,
            "speed_mps": f"{speed:.2f}",
            "acceleration_mps2": " ".join(f"{value:.2f}" for value in frame.acceleration[row]),
            "lane": frame.lane[row],
            "signals": ", ".join(lit(int(frame.signals[row]))),
            **points,
            **{f"visible_{agent}": f"{frame.visible_fraction[k, row]:.2f}" for k, agent in enumerate(agents)},
        }
        arrows = []
        if np.isfinite(speed) and speed > 0.1:
            heading = pose_matrix(boxes.center[row], np.arctan2(velocity[1], velocity[0]))
            arrows.append(
                {
                    "pose": _pose(heading),
                    "shaft_length": 0.8 * speed,
                    "shaft_diameter": 0.15,
                    "head_length": 0.2 * speed,
                    "head_diameter": 0.4,
                    "color": {**color, "a": 1.0},
                }
            )
        entities.append(
            {
                "timestamp": _time(frame.time_s),
                "frame_id": "world",
                "id": str(object_id),
                "lifetime": _LIFETIME,
                "frame_locked": False,
                "metadata": [{"key": key, "value": str(value)} for key, value in facts.items()],
                "arrows": arrows,
                "cubes": [{"pose": _pose(poses[row]), "size": _vector(boxes.size[row]), "color": {**color, "a": 0.45}}],
            }
        )
    return entities
