"""Checksums of a drive: `SHA256SUMS` beside its protocol, in the format of `sha256sum --check`."""

import re
from collections.abc import Iterator
from pathlib import Path

from sim.errors import DataError, complaint
from sim.files import file_sha256, write_file
from sim.reading import read_text

CHECKSUMS = "SHA256SUMS"
_LINE = re.compile(r"([0-9a-f]{64})  (\S.*)")


def write_checksums(folder: Path) -> Path:
    """Write the checksums of all files below a folder, sorted by name."""
    lines = [f"{file_sha256(path)}  {path.relative_to(folder).as_posix()}\n" for path in _files(folder)]
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


def _files(folder: Path) -> list[Path]:
    """Return the files with a checksum: all but the checksums, locks and files that are being written."""
    found = (path for path in folder.rglob("*") if path.is_file())
    return sorted(p for p in found if p.name != CHECKSUMS and not p.name.startswith("."))
