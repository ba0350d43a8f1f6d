"""Reading of files that anyone may have made: regular ones, of bounded size, with one-line errors.

A reader takes the content with `read_bytes` or `read_text` and works on it within `parsing`, so that whatever its
parser raises is one line with the name of the file.
"""

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from sim.errors import DataError, UserError, complaint, unreadable

LARGEST_BYTES = 1 << 29
"""Most bytes of a file that is read whole; the largest known, an index, has 15 MB, and a map a few hundred."""
LARGEST_TEXT_BYTES = 1 << 26
"""Most bytes of a text of settings or annotations; the largest known have 2 MB."""


def check_regular(path: Path, what: str, error: type[UserError] = DataError, most: int = LARGEST_BYTES) -> int:
    """Check before the opening that a file is a regular one of bounded size: a pipe would wait for ever.

    Args:
        error: class of error to raise.
        most: largest size, bytes.

    Returns:
        Its size, bytes.

    Raises:
        UserError: of the class `error`: it is missing, no regular file or too large.
    """
    try:
        found = path.stat()
    except FileNotFoundError:
        article = "an" if what[0] in "aeio" else "a"
        raise error(f"{path}: file not found; expected {article} {what}") from None
    except (OSError, ValueError) as wrong:  # ValueError for a NUL in the name
        raise error(unreadable(path, what, wrong)) from None
    if not stat.S_ISREG(found.st_mode):
        kind = "a folder" if stat.S_ISDIR(found.st_mode) else "a device or a pipe"
        raise error(complaint(path, what, "a file", kind))
    if found.st_size > most:
        raise error(complaint(path, what, f"at most {most} bytes", f"{found.st_size} bytes"))
    return found.st_size


def read_bytes(path: Path, what: str, error: type[UserError] = DataError, most: int = LARGEST_BYTES) -> bytes:
    """Return the content of a file; raises as `check_regular`, also where it cannot be read."""
    size = check_regular(path, what, error, most)
    try:
        with path.open("rb") as file:
            return file.read(size)  # asked for more, Python takes memory for all of that
    except OSError as wrong:
        raise error(unreadable(path, what, wrong)) from None


def read_text(path: Path, what: str, error: type[UserError] = DataError, most: int = LARGEST_TEXT_BYTES) -> str:
    """Return the text of a file in UTF-8 with universal line ends, without the mark that some editors put before it.

    It raises as `read_bytes`, and for other bytes.
    """
    content = read_bytes(path, what, error, most)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise error(f"{path}: expected UTF-8 text, found other bytes") from None
    return text.replace("\r\n", "\n").replace("\r", "\n") if "\r" in text else text


@contextmanager
def parsing(path: Path | str, what: str, error: type[UserError] = DataError) -> Iterator[None]:
    """Turn whatever a parser raises within a block into one line; a UserError stays as it is.

    Raises:
        UserError: of the class `error`.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as wrong:
        raise error(unreadable(os.fspath(path), what, wrong)) from None
