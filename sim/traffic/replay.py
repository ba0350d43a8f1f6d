"""Replay of a traffic log, without SUMO."""

from pathlib import Path

from sim.errors import DataError, TrafficError, complaint
from sim.traffic.base import Actors, Traffic
from sim.traffic.log import TrafficLog


class ReplayTraffic(Traffic):
    """Traffic replayed from a log, bit for bit.

    Args:
        path: the .npz that `TrafficLog.save` wrote.
        log: its content, if read already.

    Raises:
        DataError: the file is missing, damaged, no traffic log or empty.
    """

    def __init__(self, path: Path | str, log: TrafficLog | None = None) -> None:
        self._log = TrafficLog.load(path) if log is None else log
        if not len(self._log):
            raise DataError(complaint(path, "traffic log", "at least one step", "none"))
        self.path = Path(path)
        self.step_s = self._log.step_s
        self._index = 0
        self._open = True

    def __len__(self) -> int:
        return len(self._log)

    @property
    def actors(self) -> Actors:
        """The actors at the current time."""
        return self._log[self._index]

    def step(self) -> Actors:
        """Advance by `step_s` and return the actors.

        Raises:
            TrafficError: the replay is closed or the log has ended.
        """
        if not self._open:
            raise TrafficError(f"{self.path}: this replay is closed")
        if self._index + 1 == len(self._log):
            raise TrafficError(f"{self.path}: the traffic log ends after {len(self._log)} steps")
        self._index += 1
        return self.actors

    def close(self) -> None:
        """End the replay."""
        self._open = False
