"""MCAP file of a drive's messages, whatever their encoding; see https://mcap.dev/spec."""

from abc import ABC, abstractmethod
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sensors.frame import AgentFrame, Frame
from sim.errors import SettingsError
from sim.files import named, replacing
from sim.geometry import invert

POINT = np.dtype(
    [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4"), ("ring", "<u2"), ("object_id", "<i4")]
)
"""Record of a point: intensity from 0 to 1."""


class MessageFile(ABC):
    """MCAP file that appears when it is closed."""

    def __init__(
        self, path: Path, profile: str, encoding: str, schema_encoding: str, schemas: dict[str, bytes]
    ) -> None:
        """Open the file.

        Args:
            profile: of the file, such as `ros2`.
            encoding: of the messages, such as `cdr`.
            schema_encoding: of the schemas, such as `ros2msg`.
            schemas: by name.

        Raises:
            SettingsError: the package `mcap` is missing.
        """
        try:
            from mcap.writer import Writer
        except ImportError:
            raise SettingsError("mcap: expected the package mcap, found none; pip install mcap") from None
        self.path, self._encoding = path, encoding
        self._replacing = replacing(path)
        self._file = self._replacing.__enter__().open("wb")
        self._writer = Writer(self._file)
        self._writer.start(profile=profile, library="dsrc-testbed")
        self._schemas = {
            name: self._writer.register_schema(name, schema_encoding, content) for name, content in schemas.items()
        }
        self._channels: dict[str, int] = {}
        self._frames = 0

    def write(self, frame: Frame) -> None:
        """Append a frame."""
        with named(self.path):
            self._write(frame)
        self._frames += 1

    @abstractmethod
    def _write(self, frame: Frame) -> None:
        """Append a frame's messages."""

    def close(self) -> None:
        """Finish the file and move it to its path."""
        with named(self.path):
            self._writer.finish()
            self._file.close()
            self._replacing.__exit__(None, None, None)

    def _message(self, topic: str, schema: str, time_s: float, content: bytes) -> None:
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, self._encoding, self._schemas[schema])
        nanoseconds = round(time_s * 1e9)
        self._writer.add_message(self._channels[topic], nanoseconds, content, nanoseconds, self._frames)


def transform_steps(frame: Frame) -> list[tuple[str, str, NDArray[np.float64]]]:
    """Return parent, child and (4, 4) parent_from_child: world to each agent's body, and on to its LiDAR."""
    steps = []
    for agent in frame.agents:
        body, name = agent.world_from_body, f"agent_{agent.agent_id}"
        steps.append(("world", name, body))
        steps.append((name, f"lidar_{agent.agent_id}", invert(body) @ agent.sweep.world_from_lidar))
    return steps


def point_table(agent: AgentFrame) -> NDArray[np.void]:
    """Return the (P,) records of a sweep."""
    sweep = agent.sweep
    table = np.zeros(len(sweep), POINT)
    table["x"], table["y"], table["z"] = sweep.points.T
    table["intensity"], table["object_id"] = sweep.intensity, sweep.object_id
    table["ring"] = np.maximum(sweep.ring, 0)
    return table


def point_fields(types: dict[str, int]) -> list[tuple[str, int, int]]:
    """Return name, offset and number of the type of each field of a point; types by numpy's names."""
    return [(name, POINT.fields[name][1], types[POINT[name].str]) for name in POINT.names or () if POINT.fields]


def seconds_of(time_s: float) -> tuple[int, int]:
    """Return whole seconds and nanoseconds."""
    return divmod(round(time_s * 1e9), 10**9)


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
