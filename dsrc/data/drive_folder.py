"""The folder of a drive while it is being made: its lock, its protocol, and which frames are there."""

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from dsrc.data.formats.opv2v.reader import PROTOCOL, frame_files
from dsrc.data.formats.yaml import emit, read_yaml
from sim.errors import DataError, complaint
from sim.files import write_file

try:
    import fcntl
except ImportError:  # Windows has no advisory locks of this kind; two runs in one folder are the user's care there
    fcntl = None  # type: ignore[assignment]

LOCK = ".lock"


@contextmanager
def locked(drive: Path, patience_s: float = 0.0, what: str = "drive") -> Iterator[None]:
    """Hold the folder for this process; the system lets go of it when the process dies, however it dies.

    Args:
        drive: the folder.
        patience_s: how long to wait for another process, s.
        what: is written there, for the message.

    Raises:
        DataError: another process holds it, or there can be no such folder.
    """
    path, deadline = drive / LOCK, time.monotonic() + patience_s
    while True:
        with _opened(path) as file:
            if fcntl is not None:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except OSError:
                    if time.monotonic() < deadline:
                        time.sleep(0.05)
                        continue
                    file.seek(0)
                    raise DataError(f"{drive}: process {file.read().strip()} is writing this {what}") from None
            # A process that has just ended may have removed the file between our opening and locking it.
            if not path.exists() or not os.path.samestat(os.fstat(file.fileno()), path.stat()):
                continue
            file.truncate(0)
            file.write(f"{os.getpid()}\n")
            file.flush()
            try:
                yield
            finally:
                path.unlink(missing_ok=True)
            return


def _opened(path: Path) -> TextIO:
    """Open a file for reading and appending, in a folder that is made if it is missing."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.open("a+")
    except OSError as error:
        raise DataError(f"{path.parent}: cannot write in this folder: {error.strerror}") from None


def write_protocol(drive: Path, protocol: dict) -> None:
    """Write `data_protocol.yaml` atomically."""
    write_file(drive / PROTOCOL, emit(protocol))


def read_settings(drive: Path) -> dict | None:
    """Return the `testbed` table of the protocol; None when the folder has no protocol yet.

    Raises:
        DataError: there is a protocol, but not one of ours.
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


def check_same(drive: Path, found: dict, wanted: dict) -> None:
    """Compare settings; DataError names the first that differs."""
    have, want = dict(_leaves(found, "")), dict(_leaves(wanted, ""))
    for key in [*want, *have]:
        if key not in have or key not in want or have[key] != want[key]:
            asked = f"{want[key]!r} as asked for now" if key in want else "nothing of this name"
            hint = "; choose another folder or remove this drive"
            raise DataError(complaint(drive / PROTOCOL, key, asked, have.get(key, "nothing"), hint))


def is_complete(drive: Path, agent_ids: Sequence[int], index: int) -> bool:
    """Return whether all files of a frame are there; each appears whole or not at all."""
    return all(path.exists() for path in frame_files(drive, agent_ids, index))


def _leaves(value: object, where: str) -> Iterator[tuple[str, object]]:
    """Yield (dotted name, plain value) of everything below; a tuple is a list, as it is after reading a file."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _leaves(item, f"{where}.{key}" if where else str(key))
    elif isinstance(value, list | tuple) and any(isinstance(item, dict | list | tuple) for item in value):
        for row, item in enumerate(value):
            yield from _leaves(item, f"{where}[{row}]")
    else:
        yield where, list(value) if isinstance(value, tuple) else value
