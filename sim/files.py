"""Files: atomic writes, leftovers of interrupted ones, and SHA-256."""

import hashlib
import stat
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

SUFFIX = ".tmp"
"""Ending of a file that is being written; its name begins with a dot."""


def write_file(path: Path, content: bytes | str) -> None:
    """Write a file atomically, text as UTF-8; see `replacing`."""
    with replacing(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a temporary path beside a file, which replaces the file when the block ends without an error.

    The file is there completely or not at all, whoever else writes it at the same time; its folder is made, and the
    mode of a file that is replaced is kept.

    Raises:
        OSError: the file cannot be written; names it, not the temporary one.
    """
    # A unique name: processes may make the same file of a cache at once.
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}{SUFFIX}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        if path.exists():
            temporary.chmod(stat.S_IMODE(path.stat().st_mode))
        temporary.replace(path)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError) and error.errno and str(error.filename) in ("None", str(temporary)):
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files of killed processes at any depth below a folder."""
    for path in folder.rglob(f"*{SUFFIX}"):
        path.unlink(missing_ok=True)


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
