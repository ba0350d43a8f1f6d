"""Files: what may be replaced, atomic writes, leftovers of interrupted ones, and SHA-256.

One rule holds for every command. An existing file is replaced only if it is a regular one, of the kind of the new one,
and was written by this package, or where `overwriting` is asked for. Who has written it is known by its content, or by
the manifest of its folder: each floor declares the marks of what it writes in `MARKS`.
"""

import hashlib
import mmap
import os
import re
import stat
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

from sim.errors import OutputError, complaint

SUFFIX = ".tmp"
"""Ending of a file that is being written; its name begins with a dot."""
_LEFTOVER = re.compile(rf"\..+\.[0-9a-f]{{8}}{re.escape(SUFFIX)}")

_KINDS = {
    b"PK\x03\x04": "archive",
    b"\x89PNG": "picture",
    b"GIF8": "animation",
    b"\x89MCAP": "MCAP recording",
    b"<!": "web page",
    b"<html": "web page",
    b"# .PCD": "point cloud",
    b"\x08": "network",
}
"""Kinds of files by their first bytes; all else is data."""
_NOTE = b"Software\0dsrc"

MARKS: dict[str, tuple[bytes, ...]] = {"picture": (_NOTE,), "archive": (b"version.npy",)}
"""Bytes of which a file of ours holds one: by its kind, `data` or one of `_KINDS`, or by its name, a manifest's."""

_DEPTH = 4
"""Levels of folders between a manifest and its files: those of DAIR-V2X's."""
_HASH = re.compile(r"[0-9a-f]{32}")
"""Name of a cached result: the hash of what it depends on."""
_CACHES = ("cells", "episodes", "encounters", "worlds", "causes", "code")
"""Folders of cached results: elsewhere others have names like these, as nuScenes has."""

Content = bytes | bytearray | str | Iterator[bytes | bytearray]
"""Content of a file, whole or in parts, one after the other."""

_overwrite: ContextVar[bool] = ContextVar("overwrite", default=False)


@contextmanager
def overwriting(allowed: bool = True) -> Iterator[None]:
    """Allow the replacement of other programs' files within a block; devices, pipes and folders are never replaced."""
    token = _overwrite.set(allowed)
    try:
        yield
    finally:
        _overwrite.reset(token)


def check_output(path: Path, kind: str | None = None) -> None:
    """Check before the work that a file may be written.

    Args:
        kind: of what will be written, one of `_KINDS`; None for any.

    Raises:
        OutputError: there is something else that must not be replaced, see `sim.files`.
        OSError: its folder cannot be looked into.
    """
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return
    except ValueError:
        raise OutputError(complaint(path, "output", "a name of a file", "one with a NUL character")) from None
    if not stat.S_ISREG(found.st_mode):
        what = "a folder" if stat.S_ISDIR(found.st_mode) else "a device or a pipe"
        raise OutputError(complaint(path, "output", "a file, or a new name", what))
    if _overwrite.get() or found.st_size == 0:
        return
    is_of = kind_of(path)
    if kind is not None and is_of != kind:
        expected = f"a new name, or a file of the same kind ({kind})"
        raise OutputError(complaint(path, "output", expected, f"a file of another kind ({is_of})"))
    is_cached = path.parent.name in _CACHES and _HASH.fullmatch(path.stem) is not None
    folders = [path.parent, *path.absolute().parent.parents][: _DEPTH + 1]
    if not is_cached and not _is_signed(path, is_of) and not any(map(_has_manifest, folders)):
        hint = "; choose another name, or replace it with --force"
        raise OutputError(complaint(path, "output", "a new name, or a file that dsrc wrote", "another file", hint))


def check_folder(folder: Path) -> None:
    """Check before the work that a folder may be written to: a new or empty one, or one with files of ours alone.

    Folders in it, and files whose names begin with a dot, do not count.

    Raises:
        OutputError: it holds another program's file, or is no folder.
        OSError: it cannot be looked into.
    """
    if not folder.exists() or _overwrite.get():
        return
    if not folder.is_dir():
        raise OutputError(complaint(folder, "output", "a folder", "a file"))
    if _has_manifest(folder):
        return
    for path in sorted(folder.iterdir()):
        if not path.name.startswith(".") and not path.is_dir() and not (path.is_file() and _is_signed(path)):
            hint = "; choose another folder, or write into this one with --force"
            raise OutputError(complaint(folder, "output", "a new folder, or one that dsrc wrote", path.name, hint))


def check_apart(out: Path, source: Path) -> None:
    """Check that an output is not its source, nor inside it.

    Raises:
        OutputError: it is.
    """
    if out.resolve().is_relative_to(source.resolve()):
        raise OutputError(complaint(out, "output", f"a place apart from the input {source}", "one inside it"))


def kind_of(path: Path) -> str:
    """Return the kind of a file by its first bytes, `data` for an unknown one."""
    with path.open("rb") as file:
        head = file.read(8)
    return next((kind for start, kind in _KINDS.items() if head.startswith(start)), "data")


def _is_signed(path: Path, kind: str | None = None) -> bool:
    return any(_holds(path, mark) for mark in MARKS.get(kind or kind_of(path), ()))


def _has_manifest(folder: Path) -> bool:
    manifests = [(name, mark) for name, marks in MARKS.items() if "." in name for mark in marks]
    return any(_holds(folder / name, mark) for name, mark in manifests)


def _holds(path: Path, content: bytes) -> bool:
    try:
        if not path.is_file() or not path.stat().st_size:
            return False
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as view:
            return view.find(content) >= 0
    except (OSError, ValueError):
        return False


def write_file(path: Path, content: Content, *, edited: bool = False) -> None:
    """Write a file atomically, text as UTF-8; see `replacing`."""
    with replacing(path, edited=edited) as temporary, temporary.open("wb") as file:
        file.writelines(parts_of(content))


def parts_of(content: Content) -> Iterator[bytes | bytearray]:
    """Return the parts of a content, text as UTF-8."""
    whole = content.encode() if isinstance(content, str) else content
    return iter([whole]) if isinstance(whole, bytes | bytearray | memoryview) else whole


@contextmanager
def replacing(path: Path, *, edited: bool = False) -> Iterator[Path]:
    """Give a temporary path beside a file, which replaces the file when the block ends without an error.

    The file is there completely or not at all, whoever else writes it at the same time; its folder is made, and the
    mode of a file that is replaced is kept.

    Args:
        edited: the new content is the old one with changes, or the file is one of a cache: whoever wrote it.

    Raises:
        OutputError: the file must not be replaced, see `sim.files`.
        OSError: the file cannot be written; names it, not the temporary one.
    """
    with overwriting(edited or _overwrite.get()):
        check_output(path)
    # A unique name: processes may make the same file of a cache at once.
    temporary = path.with_name(f".{path.name}.{os.urandom(4).hex()}{SUFFIX}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        with overwriting(edited or _overwrite.get()):
            check_output(path, kind_of(temporary))
        if path.exists():
            temporary.chmod(stat.S_IMODE(path.stat().st_mode))
        temporary.replace(path)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError) and error.errno and str(error.filename) in ("None", str(temporary)):
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise


@contextmanager
def named(path: Path) -> Iterator[None]:
    """Give errors of the system within a block, such as that of a full disk, the name of a file."""
    try:
        yield
    except OSError as error:
        if error.errno and error.filename is None:
            raise OSError(error.errno, error.strerror, str(path)) from None
        raise


def signed_picture(png: bytes) -> bytes:
    """Return a PNG with the note `Software: dsrc`, by which it is known as ours."""
    header = 33  # signature and first chunk
    note = b"tEXt" + _NOTE
    chunk = struct.pack(">I", len(note) - 4) + note + struct.pack(">I", zlib.crc32(note))
    return png[:header] + chunk + png[header:]


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files of killed processes at any depth below a folder."""
    for path in folder.rglob(f".*{SUFFIX}"):
        if _LEFTOVER.fullmatch(path.name):
            path.unlink(missing_ok=True)


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
