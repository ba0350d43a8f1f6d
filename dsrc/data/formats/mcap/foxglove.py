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
from sim.geometry import pose_matrix
from sim.traffic.base import lit

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


class McapFile(MessageFile):
    """MCAP file of Foxglove's messages that appears when it is closed."""

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            SettingsError: the package is missing.
        """
        schemas = {name: msgspec.json.encode({"title": name, **schema}) for name, schema in SCHEMAS.items()}
        super().__init__(path, "", "json", "jsonschema", schemas)
        self._shown: set[str] = set()

    def _write(self, frame: Frame) -> None:
        entities = _entities(frame)
        names = {entity["id"] for entity in entities}
        gone = [{"timestamp": _time(frame.time_s), "type": 0, "id": name} for name in sorted(self._shown - names)]
        self._add("/tf", "foxglove.FrameTransforms", frame.time_s, _transforms(frame))
        for agent in frame.agents:
            cloud = _cloud(agent, frame.time_s)
            self._add(f"/agents/{agent.agent_id}/points", "foxglove.PointCloud", frame.time_s, cloud)
        self._add("/truth", "foxglove.SceneUpdate", frame.time_s, {"deletions": gone, "entities": entities})
        self._shown = names

    def _add(self, topic: str, schema: str, time_s: float, message: dict[str, object]) -> None:
        self._message(topic, schema, time_s, msgspec.json.encode(message))


def _time(time_s: float) -> dict[str, int]:
    seconds, nanoseconds = seconds_of(time_s)
    return {"sec": seconds, "nsec": nanoseconds}


def _vector(xyz: NDArray[np.float64]) -> dict[str, float]:
    return dict(zip("xyz", xyz.tolist(), strict=True))


def _pose(matrix: NDArray[np.float64]) -> dict[str, Any]:
    return {"position": _vector(matrix[:3, 3]), "orientation": quaternion(matrix)}


def _transforms(frame: Frame) -> dict[str, Any]:
    transforms = [
        {
            "timestamp": _time(frame.time_s),
            "parent_frame_id": parent,
            "child_frame_id": child,
            "translation": _vector(matrix[:3, 3]),
            "rotation": quaternion(matrix),
        }
        for parent, child, matrix in transform_steps(frame)
    ]
    return {"transforms": transforms}


def _cloud(agent: AgentFrame, time_s: float) -> dict[str, Any]:
    return {
        # The frame's time, which the transforms have, not the sweep's own.
        "timestamp": _time(time_s),
        "frame_id": f"lidar_{agent.agent_id}",
        "pose": _pose(np.eye(4)),
        "point_stride": POINT.itemsize,
        "fields": [
            {"name": name, "offset": offset, "type": number} for name, offset, number in point_fields(_NUMBER_TYPES)
        ],
        "data": base64.b64encode(point_table(agent).tobytes()).decode("ascii"),
    }


def _entities(frame: Frame) -> list[dict[str, Any]]:
    boxes = frame.truth
    poses = frame.bodies()
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
