"""Cache of cells: results of a detector on some frames of a drive, each under the hash of all that decides it.

`KEY.npz` holds the matches of detections and true boxes; the same settings give the same bytes. Times, which differ
between runs, are in `KEY.seconds`. A cell is complete or missing.
"""

import hashlib
import io
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dsrc.evaluation.detect import MethodResult
from dsrc.evaluation.metrics.ap import SPACES, THRESHOLDS, Matches
from sim.errors import DataError, complaint
from sim.files import write_file

_KEYS = [(space, threshold) for space in SPACES for threshold in THRESHOLDS]


class CellSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Settings of a cell: everything that decides its bytes.

    Attributes:
        detector: SHA-256 of the detector file.
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
        code: hash of the code, see `dsrc.data.code_hash`.
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
        return hashlib.sha256(msgspec.json.encode(self, order="deterministic")).hexdigest()[:32]


def has_cell(folder: Path, key: str) -> bool:
    """Whether a cell exists and is intact."""
    if not (folder / f"{key}.npz").is_file():
        return False
    try:
        read_cell(folder, key)
    except DataError:
        return False
    return True


def write_cell(folder: Path, settings: CellSettings, result: MethodResult) -> None:
    """Write a cell, its times first, so that a cell that exists is complete."""
    matches = result.matches
    arrays: Mapping[str, Any] = {
        "settings": np.frombuffer(msgspec.json.encode(settings, order="deterministic"), np.uint8),
        "truths": matches.truth_counts.astype(np.int32),
        "found": matches.detection_counts.astype(np.int32),
        "score": matches.score,
        "matched": np.stack([matches.matched[key] for key in _KEYS]).astype(np.int32),
        "ego_share": result.ego_share,
        "traffic": np.zeros((0, 4)) if result.traffic is None else result.traffic,
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_file(folder / f"{settings.key}.seconds", "".join(f"{value:.6f}\n" for value in result.seconds))
    write_file(folder / f"{settings.key}.npz", buffer.getvalue())


def read_cell(folder: Path, key: str) -> MethodResult:
    """Read a cell; missing times are empty.

    Raises:
        DataError: it is missing or damaged.
    """
    path = folder / f"{key}.npz"
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            truths, found = (file[name].astype(np.int64) for name in ("truths", "found"))
            matched = dict(zip(_KEYS, file["matched"].astype(np.int64), strict=True))
            matches = Matches(truths, found, file["score"], matched)
            ego_share, traffic = file["ego_share"], file["traffic"]
        times = path.with_suffix(".seconds")
        seconds = np.array(times.read_text(encoding="utf-8").split() if times.is_file() else [], np.float64)
    except (OSError, EOFError, ValueError, KeyError, NotImplementedError, zipfile.BadZipFile, zlib.error):
        hint = "; run again to compute it anew"
        raise DataError(complaint(path, "cell", "a whole one", "a damaged one", hint)) from None
    return MethodResult(matches, ego_share, seconds, traffic if len(traffic) else None)
