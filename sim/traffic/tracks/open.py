"""Track files: their formats, found by ending, columns and root."""

from collections.abc import Callable
from pathlib import Path

from sim.errors import DataError, complaint
from sim.traffic.tracks.arrays import read_track_arrays
from sim.traffic.tracks.base import Recording, check_tracks
from sim.traffic.tracks.columns import header_of
from sim.traffic.tracks.commonroad import read_commonroad
from sim.traffic.tracks.drones import HIGHD, IND, read_highd, read_ind
from sim.traffic.tracks.fcd import read_fcd
from sim.traffic.tracks.interaction import SIGNATURE, read_interaction
from sim.traffic.tracks.openscenario import read_openscenario
from sim.traffic.tracks.table import read_table
from sim.traffic.tracks.xml_file import read_xml_bytes, root_tag

Reader = Callable[[Path], tuple[Recording, ...]]

_BY_COLUMNS: tuple[tuple[frozenset[str], Reader], ...] = (
    (SIGNATURE, read_interaction),
    (IND, read_ind),
    (HIGHD, read_highd),
)
_BY_ROOT: dict[str, Reader] = {
    "commonRoad": read_commonroad,
    "fcd-export": read_fcd,
    "OpenSCENARIO": read_openscenario,
}


def _read_csv(path: Path) -> tuple[Recording, ...]:
    header = frozenset(header_of(path))
    return next((reader for columns, reader in _BY_COLUMNS if columns <= header), read_table)(path)


def _read_xml(path: Path) -> tuple[Recording, ...]:
    root = root_tag(read_xml_bytes(path, "track file"))
    if root not in _BY_ROOT:
        raise DataError(complaint(path, "root", " or ".join(f"<{name}>" for name in _BY_ROOT), f"<{root}>"))
    return _BY_ROOT[root](path)


READERS: dict[str, Reader] = {
    ".csv": _read_csv,
    ".npz": read_track_arrays,
    ".xml": _read_xml,
    ".gz": _read_xml,
    ".xosc": _read_xml,
}
"""Readers by the ending of a file."""
_PICKLES = (".pkl", ".pickle")


def read_tracks(path: Path) -> tuple[Recording, ...]:
    """Read a track file: CSV, arrays in a .npz, or XML, which may be gzipped.

    Returns:
        Its recording, or several with names of their parts.

    Raises:
        DataError: another ending, or the file is missing or wrong.
    """
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        hint = (
            "; a pickle can run code, docs/formats.md says how to write its arrays"
            if path.suffix.lower() in _PICKLES
            else ""
        )
        expected = f"a file that ends with {', '.join(READERS)}"
        raise DataError(complaint(path, "tracks", expected, path.suffix or "none", hint))
    recordings = reader(path)
    for recording in recordings:
        check_tracks(path, recording)
    return recordings
