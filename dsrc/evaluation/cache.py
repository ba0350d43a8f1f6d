"""Cache of cells: results of a detector on some frames of a drive, each under the hash of all that decides it.

`KEY.npz` holds detections, true boxes and their matches, see `DetectionTable`; the same settings give the same bytes.
Times, which differ between runs, are in `KEY.seconds`. A cell is complete or missing.
"""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.evaluation.detect import MethodResult
from dsrc.evaluation.detection_table import read_table
from dsrc.evaluation.metrics.ap import SPACES, THRESHOLDS, Matches
from dsrc.messages.message import LIES
from dsrc.runs.unit import key_of
from sim.errors import DataError, complaint
from sim.files import write_file
from sim.packed import read_arrays

_KEYS = [(space, threshold) for space in SPACES for threshold in THRESHOLDS]
_HINT = "; run again to compute it anew"


class CellSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Settings of a cell: everything that decides its bytes.

    Attributes:
        detector: SHA-256 of the detector, see `dsrc.detectors.open.detector_sha256`.
        use: changed settings of the detector.
        drive: name of the drive, which its seed depends on.
        data: hash of the drive.
        positions: of the frames in the drive.
        condition: kind, severity, family and settings of the corruption, and who is corrupted where it is not everyone.
        seed: of corruptions and channels.
        channel: settings of the channel without its name; None where no message is sent.
        agents: most agents that take part.
        device: of the network, `cpu` or `cuda`.
        engine: execution of the network, one of `dsrc.models.storage.deploy.ENGINES`.
        versions: of other packages that the code imports.
        code: hash of the code, see `sim.kept.code_hash`.
    """

    detector: str
    use: dict[str, Any]
    drive: str
    data: str
    positions: tuple[int, ...]
    condition: dict[str, Any]
    seed: int
    channel: dict[str, Any] | None
    agents: int
    device: str
    engine: str
    versions: dict[str, str]
    code: str

    @property
    def key(self) -> str:
        """Name of the cell."""
        return key_of(self)


def write_cell(folder: Path, settings: CellSettings, result: MethodResult) -> None:
    """Write a cell, its times first, so that a cell that exists is complete."""
    arrays: Mapping[str, Any] = {
        "settings": np.frombuffer(msgspec.json.encode(settings, order="deterministic"), np.uint8),
        **result.table.arrays(),
        "matched": np.stack([result.matches.matched[key] for key in _KEYS]).astype(np.int32),
        "traffic": np.zeros((0, 4)) if result.traffic is None else result.traffic,
        **({} if result.told is None else {"told": result.told}),
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_file(folder / f"{settings.key}.seconds", "".join(f"{value:.6f}\n" for value in result.seconds))
    write_file(folder / f"{settings.key}.npz", buffer.getvalue())


def read_cell(folder: Path, key: str) -> MethodResult:
    """Read a cell; missing times are empty.

    Raises:
        DataError: it is missing or damaged; names file and array.
    """
    path = folder / f"{key}.npz"
    arrays = _arrays(path)
    table = read_table(path, arrays, _HINT)
    matched, traffic, told = arrays.get("matched"), arrays.get("traffic"), arrays.get("told")
    shape = (len(_KEYS), len(table.score))
    if matched is None or matched.dtype.kind != "i" or matched.shape != shape:
        raise _wrong(path, "matched", f"shape {shape}", matched)
    if matched.size and not -1 <= matched.min() <= matched.max() < len(table.truth):
        raise DataError(complaint(path, "matched", f"-1 or a row of {len(table.truth)} true boxes", "others", _HINT))
    if traffic is None or traffic.dtype != np.float64 or traffic.shape not in ((0, 4), (len(table), 4)):
        raise _wrong(path, "traffic", f"shape ({len(table)}, 4)", traffic)
    if told is not None and (told.dtype != np.float64 or told.shape != (len(table), len(LIES))):
        raise _wrong(path, "told", f"shape ({len(table)}, {len(LIES)})", told)
    by_threshold = dict(zip(_KEYS, matched.astype(np.int64), strict=True))
    times = path.with_suffix(".seconds")
    try:
        seconds = np.array(times.read_text(encoding="utf-8").split() if times.is_file() else [], np.float64)
    except (OSError, ValueError):
        raise DataError(complaint(times, "times", "numbers", "a damaged file", _HINT)) from None
    matches = Matches(table.truths, table.found, table.score, by_threshold)
    return MethodResult(table, matches, seconds, traffic if len(traffic) else None, told)


def read_settings(folder: Path, key: str) -> CellSettings:
    """Read the settings of a cell.

    Raises:
        DataError: it is missing or damaged.
    """
    path = folder / f"{key}.npz"
    stored = _arrays(path).get("settings")
    try:
        return msgspec.json.decode(b"" if stored is None else stored.tobytes(), type=CellSettings)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise DataError(complaint(path, "settings", "those of a cell", str(error), _HINT)) from None


def _arrays(path: Path) -> dict[str, NDArray]:
    try:
        return read_arrays(path, "cell")
    except DataError:
        found = "a damaged one" if path.exists() else "none"
        raise DataError(complaint(path, "cell", "a whole one", found, _HINT)) from None


def _wrong(path: Path, name: str, expected: str, found: NDArray | None) -> DataError:
    shown = "none" if found is None else f"{found.dtype} {found.shape}"
    return DataError(complaint(path, name, expected, shown, _HINT))
