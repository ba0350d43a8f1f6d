"""Recorded channel traces: delay and packet loss from a CSV file."""

import csv
import math
from bisect import bisect_right
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from sim.errors import DataError, complaint
from sim.reading import parsing, read_text

_COLUMNS = {"time_s": (-math.inf, math.inf), "delay_s": (0.0, math.inf), "loss": (0.0, 1.0)}


@dataclass(frozen=True, slots=True)
class TraceRow:
    """Delay and loss of messages from `sender` to `receiver`, from `time_s` on.

    Attributes:
        time_s: time since the start of the drive, s.
        sender: id of an agent; None: any.
        receiver: id of an agent; None: any.
        delay_s: delay, s.
        loss: share of lost packets.
    """

    time_s: float
    sender: int | None
    receiver: int | None
    delay_s: float
    loss: float


class Trace:
    """Channel trace: delay and loss over time.

    Args:
        rows: rows in order of time.
    """

    def __init__(self, rows: tuple[TraceRow, ...]) -> None:
        self._rows = rows
        self._links: dict[tuple[int, int], tuple[list[float], list[TraceRow]]] = {}

    def at(self, time_s: float, sender: int, receiver: int) -> tuple[float, float]:
        """Return delay, s, and loss of a link: its last row up to a time, else its first.

        A link without rows loses everything.
        """
        if (sender, receiver) not in self._links:
            own = [r for r in self._rows if r.sender in (None, sender) and r.receiver in (None, receiver)]
            self._links[sender, receiver] = [r.time_s for r in own], own
        times, rows = self._links[sender, receiver]
        if not rows:
            return 0.0, 1.0
        row = rows[max(bisect_right(times, time_s + 1e-9) - 1, 0)]
        return row.delay_s, row.loss


@lru_cache(maxsize=8)
def read_trace(path: str) -> Trace:
    """Read a CSV file with the columns time_s, delay_s, loss and, for single links, sender and receiver.

    Raises:
        DataError: the file cannot be read, a column is missing or a value is wrong.
    """
    text = read_text(Path(path), "CSV file")
    with parsing(path, "CSV file"):
        return _trace(path, text)


def _trace(path: str, text: str) -> Trace:
    reader = csv.DictReader(text.splitlines())
    names = [name.strip() for name in reader.fieldnames or []]
    for name in _COLUMNS:
        if name not in names:
            raise DataError(complaint(path, "columns", f"a column '{name}'", ", ".join(names) or "none"))
    reader.fieldnames = names
    rows = [_row(path, number, row) for number, row in enumerate(reader, start=2)]
    if not rows:
        raise DataError(complaint(path, "rows", "at least one", "none"))
    return Trace(tuple(sorted(rows, key=lambda row: row.time_s)))


def _row(path: str, line: int, row: dict[str, str]) -> TraceRow:
    values = {name: _number(path, line, name, row.get(name)) for name in _COLUMNS}
    ends = {name: _agent(path, line, name, row.get(name)) for name in ("sender", "receiver")}
    return TraceRow(values["time_s"], ends["sender"], ends["receiver"], values["delay_s"], values["loss"])


def _number(path: str, line: int, name: str, text: str | None) -> float:
    low, high = _COLUMNS[name]
    try:
        value = float(text or "")
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and low <= value <= high):
        expected = (
            "a number" if math.isinf(low) else f"at least {low:g}" if math.isinf(high) else f"{low:g} to {high:g}"
        )
        raise DataError(complaint(path, f"line {line}, {name}", expected, text if text else "nothing"))
    return value


def _agent(path: str, line: int, name: str, text: str | None) -> int | None:
    text = (text or "").strip()
    if text in ("", "*"):
        return None
    try:
        return int(text)
    except ValueError:
        raise DataError(complaint(path, f"line {line}, {name}", "the id of an agent or *", text)) from None
