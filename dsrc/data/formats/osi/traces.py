"""OSI traces of drives: one MCAP of all channels, or a binary `.osi` of each.

Needs the package `betterosi`: pip install 'dsrc-testbed[osi]'.

Source: ASAM Open Simulation Interface 3.8.0, its names of trace files.
"""

from contextlib import ExitStack
from pathlib import Path
from typing import Any

from dsrc.data.formats.osi.messages import load_osi, messages_of
from sensors.frame import Frame
from sim.files import named, replacing

_EPOCH = "19700101T000000Z"
_METADATA = {"creation_time": "1970-01-01T00:00:00Z", "description": "drive of dsrc-testbed"}
"""Of a fixed time, so that a drive gives the same bytes again."""
_NAMES = {"ground_truth": "gt", "sensor_view": "sv", "sensor_data": "sd"}
"""Abbreviations of channels in names of binary traces."""


class OsiTraces:
    """Traces of a drive, which appear when they are closed."""

    def __init__(self, path: Path, frames: int) -> None:
        """Prepare the traces.

        Args:
            path: an `.mcap`; any other is a folder of `.osi` files, with the drive's name at the end of theirs.
            frames: of the drive; they stand in the names of the files.

        Raises:
            SettingsError: the package is missing.
        """
        self._osi = load_osi()
        self.path, self._frames = path, frames
        self._open = ExitStack()
        self._writers: dict[str, Any] = {}

    def write(self, frame: Frame) -> None:
        """Append a frame."""
        with named(self.path):
            for channel, message in messages_of(frame):
                self._writer(channel).add(message, **({"topic": channel} if self._packed else {}))

    def close(self) -> None:
        """Finish the files and move them to their paths."""
        with named(self.path):
            self._open.close()

    @property
    def _packed(self) -> bool:
        return self.path.suffix == ".mcap"

    def _writer(self, channel: str) -> Any:
        key = "" if self._packed else channel
        if key not in self._writers:
            path = self.path if self._packed else self.path / self._name(channel)
            temporary = self._open.enter_context(replacing(path))
            more = {"metadata": _METADATA, "library": "dsrc-testbed"} if self._packed else {}
            # The package tells the kind of a trace by its ending, which a temporary file does not have.
            ending = temporary.with_name(f"{temporary.name}{path.suffix}")
            self._writers[key] = self._open.enter_context(self._osi.Writer(ending, **more))
            ending.replace(temporary)
        return self._writers[key]

    def _name(self, channel: str) -> str:
        kind, _, agent = channel.partition("/")
        drive = self.path.name if not agent else f"{self.path.name}-agent-{agent}"
        return f"{_EPOCH}_{_NAMES[kind]}_380_700_{self._frames}_{drive}.osi"
