"""Entry point of `dsrc` and `python -m dsrc`: exit codes and one-line errors."""

import errno
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable
from typing import Any, TextIO

from dsrc.cli.interrupts import Interrupts

_PATH_ERRORS = frozenset(
    getattr(errno, name)
    for name in (
        *("EACCES", "EBUSY", "EDQUOT", "EEXIST", "EFBIG", "EIO", "EISDIR", "ELOOP", "EMFILE", "ENAMETOOLONG", "ENFILE"),
        *("ENODEV", "ENOENT", "ENOSPC", "ENOTDIR", "ENOTEMPTY", "ENXIO", "EPERM", "EROFS", "ETXTBSY", "EXDEV"),
    )
    if hasattr(errno, name)
)
"""Errors of the file system that are the fault of a path that the user gave, or of the disk."""

_RESUMES = re.compile(
    r"(generate|corrupt|dataset (build|record|render|convert)|model train|evaluate|benchmark|shares|demo)\b"
    r"|drive .*--out\b"
)
"""Commands that go on where an interrupt left them."""


def main(args: list[str] | None = None) -> None:
    """Run the command line.

    A user's mistake is one line on standard error and exit code 2, Ctrl-C exit code 130, SIGTERM 143, a closed pipe
    141.

    Args:
        args: words after `dsrc`; None for those of the process, which ends afterwards.
    """
    if args is None:
        from sim.machine import single_thread_products

        single_thread_products()
        for stream in (sys.stdout, sys.stderr):
            if hasattr(stream, "reconfigure"):  # a name of a file need not have an encoding
                stream.reconfigure(errors="backslashreplace")
    with Interrupts(ending=args is None) as interrupts:
        try:
            code, line = _outcome(args)
            interrupts.settle()
        except BaseException:
            interrupts.settle()
            if not interrupts.received:
                raise
            code, line = 1, ""
        # A view that ends by an interrupt says so with 0; without a code a package may have swallowed the interrupt.
        if interrupts.received and code != 0:
            word = "terminated" if interrupts.received == signal.SIGTERM else "interrupted"
            again = "resumes" if _RESUMES.match(" ".join(sys.argv[1:] if args is None else args)) else "starts anew"
            line = f"dsrc: {word}; the same command again {again}\n"
            code = 128 + interrupts.received
        code = _write(line, code)
        if code is not None:
            raise SystemExit(code)


def _outcome(args: list[str] | None) -> tuple[object, str]:
    """Run the command; return its exit code, None where it gives none, and the line of a mistake."""
    from dsrc.cli.main import run
    from sim.errors import UserError

    shown, warnings.showwarning = warnings.showwarning, _plain(warnings.showwarning)
    try:
        try:
            run(args)
        finally:
            sys.stdout.flush()
    except SystemExit as leaving:
        return leaving.code, ""
    except UserError as error:
        return 2, f"dsrc: {error}\n"
    except RuntimeError as error:
        if not str(error).startswith("Symlink loop"):  # of Path.resolve, below Python 3.13
            raise
        return 2, f"dsrc: {error}\n"
    except OSError as error:
        lost = _lost(sys.stdout)
        if lost == errno.EPIPE:
            return 141, ""
        if error.errno not in _PATH_ERRORS:
            raise
        name = error.filename2 or error.filename or ("standard output" if lost else None)
        place = "" if name is None else f"{os.fsdecode(name) if isinstance(name, str | bytes) else name}: "
        return 2, f"dsrc: {place}{error.strerror}\n"
    finally:
        warnings.showwarning = shown
    return None, ""


def _plain(show: Callable[..., None]) -> Callable[..., None]:
    """Return a printer of warnings that tells a deprecated name in one line, the others as `show` does."""

    def told(message: Warning, *place: Any, **further: Any) -> None:
        from sim.errors import DeprecatedName

        if isinstance(message, DeprecatedName):
            sys.stderr.write(f"dsrc: {message}\n")
        else:
            show(message, *place, **further)

    return told


def _write(line: str, code: object) -> object:
    """Write the last line; return the exit code, 141 where its reader has gone."""
    try:
        sys.stderr.write(line)
        sys.stderr.flush()
    except OSError:
        _silence(sys.stderr)
        return 141
    return code


def _lost(stream: TextIO) -> int:
    """Return the number of the error with which a stream is lost: its reader has gone, its file is full; else 0."""
    try:
        stream.write("\n")
        stream.flush()
    except OSError as error:
        _silence(stream)
        return error.errno or errno.EIO
    return 0


def _silence(stream: TextIO) -> None:
    """Drop what waits for a stream: it would fail again when the process ends."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


if __name__ == "__main__":
    main()
