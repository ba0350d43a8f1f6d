"""Index of stored detections: `detections.json` of an evaluation or benchmark says which cells hold them."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from dsrc.data.sample import COMM_RANGE_M, TeamBy
from dsrc.evaluation.detection_table import DetectionTable, join_tables, read_table_file
from dsrc.faults.condition import condition_of
from sensors.corruptions import EVERYONE, Condition, Family
from sim.errors import DataError, complaint
from sim.files import write_file

FILE = "detections.json"
VERSION = 1
_LARGEST_BYTES = 1 << 28
_HINT = "; run dsrc evaluate or dsrc benchmark again"

_Key = Annotated[str, Meta(pattern="^[0-9a-f]{32}$")]
_Range = tuple[float, float, float, float, float, float]


class StoredDrive(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Drive whose detections are stored.

    Attributes:
        dataset: name of its dataset.
        path: where it was.
        data: hash of the drive, see `Drive.digest`.
    """

    dataset: str
    path: str
    data: str

    @property
    def name(self) -> str:
        """Name of the drive."""
        return Path(self.path).name


class StoredRun(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Detections of a method under a condition.

    Attributes:
        method: name as shown.
        training: number of the training of a method, from 0.
        kind, severity, family, who: condition of the sweeps, see `condition_of`.
        channel: name of the radio channel.
        swept: other swept quantities and their values, as `2 agents`; "" for none.
        detector: SHA-256 of the detector, see `dsrc.detectors.open.detector_sha256`.
        range_m: range of the detector's grid, in which boxes are evaluated, m.
        agents: most agents that take part, of those of the next three.
        comm_range_m, max_agents, team_by: who takes part, see `SampleRequest`.
        cells: keys of the cells of each drive, in the order of `StoredIndex.drives`; none for another dataset's.
    """

    method: str
    training: int
    kind: str
    severity: int
    family: Family
    who: str = EVERYONE
    channel: str
    swept: str = ""
    detector: str
    range_m: _Range
    agents: int
    comm_range_m: float = COMM_RANGE_M
    max_agents: int = 5
    team_by: TeamBy = "range"
    cells: tuple[tuple[_Key, ...], ...]

    @property
    def condition(self) -> Condition:
        """Condition of the sweeps."""
        return condition_of(self.kind, self.severity, self.family, self.who)


class StoredIndex(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Index of the stored detections of a folder of results.

    Attributes:
        drives: evaluated drives.
        runs: by method and condition.
        seed: of corruptions and channels.
    """

    version: int = VERSION
    seed: int
    drives: tuple[StoredDrive, ...]
    runs: tuple[StoredRun, ...]


def write_index(out: Path, index: StoredIndex) -> None:
    """Write `detections.json` in a folder of results, atomically."""
    write_file(out / FILE, msgspec.json.format(msgspec.json.encode(index, order="deterministic"), indent=1) + b"\n")


def has_index(folder: Path) -> bool:
    """Whether a folder is one of results with stored detections."""
    return (folder / FILE).is_file()


def read_index(folder: Path) -> StoredIndex:
    """Read the index of a folder of results.

    Raises:
        DataError: the folder or the index is missing or invalid, or a run has not one list of cells per drive.
    """
    path = folder / FILE
    if not folder.is_dir():
        raise DataError(complaint(folder, "results", "a folder", "a file" if folder.exists() else "no such folder"))
    if not path.is_file():
        raise DataError(complaint(folder, FILE, "the index of stored detections", "none", _HINT))
    if path.stat().st_size > _LARGEST_BYTES:
        raise DataError(complaint(path, "size", f"at most {_LARGEST_BYTES} bytes", path.stat().st_size, _HINT))
    try:
        index = msgspec.json.decode(path.read_bytes(), type=StoredIndex)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise DataError(complaint(path, "content", "an index of detections", str(error), _HINT)) from None
    if index.version != VERSION:
        raise DataError(complaint(path, "version", str(VERSION), index.version, _HINT))
    for run in index.runs:
        if len(run.cells) != len(index.drives):
            expected = f"cells of {len(index.drives)} drives"
            raise DataError(complaint(path, f"runs: {run.method}: cells", expected, len(run.cells), _HINT))
    return index


def read_run(folder: Path, keys: Iterable[str]) -> DetectionTable:
    """Read the detections of cells, in their order.

    Raises:
        DataError: a cell is missing or damaged; names file and column.
    """
    return join_tables([read_table_file(folder / "cells" / f"{key}.npz", _HINT) for key in keys])


def run_names(runs: Sequence[StoredRun]) -> list[str]:
    """Names of runs: the method, and what differs within it: training, channel, swept quantity."""
    names = []
    for run in runs:
        own = [other for other in runs if other.method == run.method]
        parts = [run.method]
        if len({other.training for other in own}) > 1:
            parts.append(f"training {run.training}")
        if len({other.channel for other in own}) > 1:
            parts.append(run.channel)
        names.append(", ".join([*parts, *([run.swept] if run.swept else [])]))
    return names
