"""Track files by their ending."""

from collections.abc import Callable
from pathlib import Path

from sim.errors import DataError, complaint
from sim.traffic.tracks.arrays import read_track_arrays
from sim.traffic.tracks.base import Recording, check_tracks
from sim.traffic.tracks.commonroad import read_commonroad
from sim.traffic.tracks.table import read_table

READERS: dict[str, Callable[[Path], Recording]] = {
    ".csv": read_table,
    ".npz": read_track_arrays,
    ".xml": read_commonroad,
}
"""Readers by the ending of a file."""


def read_tracks(path: Path) -> Recording:
    """Read a track file: CSV, arrays in a .npz, or CommonRoad XML.

    Raises:
        DataError: another ending, or the file is missing or wrong.
    """
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise DataError(complaint(path, "tracks", f"a file that ends with {', '.join(READERS)}", path.suffix or "none"))
    recording = reader(path)
    check_tracks(path, recording)
    return recording
