"""Lock of a folder that a process writes."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from sim.errors import DataError
from sim.files import check_folder

try:
    import fcntl
except ImportError:  # Windows has no such locks: there the user must not run twice in one folder
    fcntl = None  # type: ignore[assignment]

LOCK = ".lock"


class BusyError(DataError):
    """Another process holds the lock of a folder."""


@contextmanager
def locked(folder: Path, patience_s: float = 0.0, what: str = "drive") -> Iterator[None]:
    """Lock a folder for this process; the system releases the lock when the process ends in any way.

    Args:
        folder: it is made where it is missing.
        patience_s: time to wait for another process, s.
        what: the folder's content, for the message.

    Raises:
        OutputError: it holds another program's files; a folder of datasets may, beside its splits.
        BusyError: another process holds the lock.
        DataError: the folder cannot be made.
    """
    if what != "dataset":
        check_folder(folder)
    path, deadline = folder / LOCK, time.monotonic() + patience_s
    while True:
        with _opened(path) as file:
            if fcntl is not None:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    if time.monotonic() < deadline:
                        time.sleep(0.05)
                        continue
                    file.seek(0)
                    raise BusyError(f"{folder}: process {file.read().strip()} is writing this {what}") from None
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
    """Open a file for reading and appending; makes its folder."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return path.open("a+")
    except OSError as error:
        raise DataError(f"{path.parent}: cannot write in this folder: {error.strerror}") from None
