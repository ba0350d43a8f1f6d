"""Checksums of a drive: `SHA256SUMS` beside its protocol, in the format of `sha256sum --check`."""

import contextlib
import hashlib
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from sim.errors import DataError, complaint
from sim.files import Content, file_sha256, parts_of, write_file
from sim.reading import read_text
from sim.roads.cache import cache_folder

CHECKSUMS = "SHA256SUMS"
_BLOCK = 4096
_LINE = re.compile(r"([0-9a-f]{64})  (\S.*)")


class Written:
    """Files that this process has written, each with the SHA-256 of the bytes that it was given."""

    def __init__(self) -> None:
        self._sums: dict[Path, tuple[tuple[int, ...], str]] = {}

    def write(self, path: Path, content: Content) -> None:
        """Write a file atomically, and note its SHA-256 once it is there."""
        digest = hashlib.sha256()

        def hashed() -> Iterator[bytes | bytearray]:
            for part in parts_of(content):
                digest.update(part)
                yield part

        write_file(path, hashed())
        self._sums[path] = _state(path), digest.hexdigest()

    def sha256(self, path: Path) -> str:
        """Return the SHA-256 of a file; one that others have written, before or since, is read."""
        state, noted = self._sums.get(path, (None, ""))
        return noted if state == _state(path) else file_sha256(path)


def _state(path: Path) -> tuple[int, ...]:
    """Return what differs once a file has been replaced or changed."""
    found = path.stat()
    return found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns


def write_checksums(folder: Path, written: Written | None = None) -> Path:
    """Write the checksums of all files below a folder, sorted by name.

    Args:
        written: files that need not be read again.
    """
    written = written or Written()
    lines = [f"{written.sha256(path)}  {path.relative_to(folder).as_posix()}\n" for path in _files(folder)]
    write_file(folder / CHECKSUMS, "".join(lines))
    return folder / CHECKSUMS


def read_checksums(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each file by name.

    Raises:
        DataError: the file is missing or damaged.
    """
    path = folder / CHECKSUMS
    lines = read_text(path, "list of checksums").splitlines()
    sums = {}
    for number, line in enumerate(lines, 1):
        match = _LINE.fullmatch(line)
        if match is None:
            raise DataError(complaint(path, f"line {number}", "a checksum and a name", line))
        sums[match[2]] = match[1]
    return sums


def faulty_files(folder: Path) -> Iterator[tuple[Path, str]]:
    """Yield (file, fault) for each missing, changed or unlisted file."""
    sums = read_checksums(folder)
    present = {path.relative_to(folder).as_posix(): path for path in _files(folder)}
    for name, expected in sums.items():
        if name not in present:
            yield folder / name, f"missing, {CHECKSUMS} lists it"
        elif file_sha256(present[name]) != expected:
            yield folder / name, f"changed since {CHECKSUMS} was written"
    for name in sorted(present.keys() - sums.keys()):
        yield folder / name, f"not listed in {CHECKSUMS}"


def marks_of_change(folder: Path, files: Sequence[Path]) -> Iterator[tuple[Path, bytes]]:
    """Yield a mark for each of the files that may have other content than their names and sizes tell.

    Of a folder with checksums these are the files that have changed since they were written, and the mark is their
    SHA-256 now. Only files that were written or moved after the checksums are read; where none of them has changed, as
    in a copy, the cache folder keeps that, so that they are read once. Without checksums it is each file, and the mark
    is its first and last 4 KiB: what moves or dims all points is in them.
    """
    listed = folder / CHECKSUMS
    try:
        since = listed.stat().st_mtime_ns
        times = {path: path.stat() for path in files}
        newer = [path for path, time in times.items() if max(time.st_mtime_ns, time.st_ctime_ns) > since]
        if not newer:
            return
        sums = read_checksums(folder)
    except (OSError, DataError):
        yield from ((path, ends_of(path)) for path in files)
        return
    seen = [(str(path), times[path].st_size, times[path].st_mtime_ns, times[path].st_ctime_ns) for path in newer]
    known = (
        cache_folder() / "unchanged" / hashlib.sha256(repr((str(folder.resolve()), since, seen)).encode()).hexdigest()
    )
    if known.exists():
        return
    now = {path: file_sha256(path) for path in newer}
    changed = {path: found for path, found in now.items() if found != sums.get(path.relative_to(folder).as_posix())}
    yield from ((path, found.encode()) for path, found in changed.items())
    if not changed:
        with contextlib.suppress(OSError):  # of a cache that cannot be written
            known.parent.mkdir(parents=True, exist_ok=True)
            known.touch()


def ends_of(path: Path) -> bytes:
    """Return the first and the last 4 KiB of a file."""
    with path.open("rb") as file:
        start = file.read(_BLOCK)
        file.seek(max(path.stat().st_size - _BLOCK, 0))
        return start + file.read(_BLOCK)


def _files(folder: Path) -> list[Path]:
    """Return the files with a checksum: all but the checksums, locks and files that are being written."""
    found = (path for path in folder.rglob("*") if path.is_file())
    return sorted(p for p in found if p.name != CHECKSUMS and not p.name.startswith("."))
