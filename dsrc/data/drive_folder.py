"""Folder of a drive while it is being written: its files, its protocol, its complete frames."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from dsrc.data.formats.opv2v.reader import PROTOCOL, Clouds, frame_files
from dsrc.data.formats.yaml import emit, read_yaml
from sim.errors import DataError, complaint
from sim.files import write_file

TRAFFIC_LOG = "traffic.npz"
WORLD = "world.npz"
"""File of the static world, beside the traffic log."""


def write_protocol(drive: Path, protocol: dict) -> None:
    """Write `data_protocol.yaml` atomically; other tools' values that we do not write, such as dates, become text."""
    own = {key: value for key, value in protocol.items() if key == "testbed"}
    write_file(drive / PROTOCOL, emit(_plain(protocol) | own))


def _plain(value: object) -> Any:
    if isinstance(value, dict):
        return {key if isinstance(key, int | str) else str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    known = value is None or isinstance(value, bool | int | str) or (isinstance(value, float) and math.isfinite(value))
    return value if known else str(value)


def read_settings(drive: Path) -> dict | None:
    """Return the `testbed` table of the protocol; None when the folder has no protocol yet.

    Raises:
        DataError: the protocol is another tool's.
    """
    path = drive / PROTOCOL
    if not path.exists():
        return None
    settings = read_yaml(path).get("testbed")
    if not isinstance(settings, dict):
        raise DataError(
            complaint(path, "testbed", "the settings of dsrc generate", "none; the folder is another tool's")
        )
    return settings


def is_complete(drive: Path, agent_ids: Sequence[int], index: int, clouds: Clouds = "pcd") -> bool:
    """Return whether all files of a frame exist; each is written atomically."""
    return all(path.exists() for path in frame_files(drive, agent_ids, index, clouds))
