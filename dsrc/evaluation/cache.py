"""Cells: what a detector made of some frames of a drive, on disk under the hash of everything that decides it.

`KEY.npz` holds which detections hit what; the same settings give the same bytes. Times, which differ from run to run,
lie beside in `KEY.seconds`. A cell is there completely or not at all.
"""

import hashlib
import io
import zipfile
import zlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dsrc.data.provenance import versions
from dsrc.evaluation.benchmark import Condition, Tally
from dsrc.evaluation.metrics.ap import SPACES, THRESHOLDS, Judged
from sensors import corruptions as registry
from sensors.corruptions import CLEAN
from sim.errors import DataError, complaint
from sim.files import file_sha256, write_file
from sim.radio import ChannelSpec

_ROOT = Path(__file__).resolve().parents[2]
SOURCES = (
    "sensors/corruptions",
    "dsrc/data/sample.py",
    "dsrc/models/inputs/batch.py",
    "dsrc/models",
    "dsrc/ops",
    "dsrc/models/channel.py",
    "sim/radio.py",
    "sim/radio_trace.py",
    "dsrc/evaluation/metrics/ap.py",
    "dsrc/evaluation/benchmark.py",
    "dsrc/evaluation/metrics/matching.py",
)
"""Code that decides numbers: where it changes, cells are made anew."""

_PACKAGES = ("dsrc-testbed", "numpy", "torch", "powerboxes", "scipy")
_KEYS = [(space, threshold) for space in SPACES for threshold in THRESHOLDS]


class CellSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Everything that decides a cell.

    Attributes:
        detector: SHA-256 of its file.
        use: what of its settings is changed.
        drive: name of the drive, by which its seed goes.
        data: hash of the drive.
        positions: of the frames in the drive.
        condition: kind, severity and family of the corruption, and its settings.
        seed: of corruptions and channels.
        channel: its settings, the name aside; None where nobody sends.
        agents: how many take part at most.
        device: that the network runs on, `cpu` or `cuda`.
        versions: of packages that can change a number.
        code: hash of the code, see `code_hash`.
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
    versions: dict[str, str]
    code: str

    @property
    def key(self) -> str:
        """Name of the cell."""
        return hashlib.sha256(msgspec.json.encode(self, order="deterministic")).hexdigest()[:32]


def described(condition: Condition) -> dict[str, Any]:
    """Return a condition with all its settings."""
    listed = {"kind": condition.kind, "severity": condition.severity, "family": condition.family}
    if condition.kind == CLEAN:
        return listed
    settings = registry.CORRUPTIONS[condition.kind].settings_of(condition.family).severity(condition.severity)
    return {**listed, "settings": msgspec.to_builtins(settings)}


def of_channel(spec: ChannelSpec) -> dict[str, Any]:
    """Return the settings of a channel; of a trace the hash of its file."""
    settings = msgspec.to_builtins(spec)
    del settings["name"]
    return {**settings, "trace": file_sha256(Path(spec.trace))} if spec.trace else settings


@cache
def relevant_versions() -> dict[str, str]:
    """Return the versions of the packages that can change a number here."""
    found = versions()
    return {name: found[name] for name in _PACKAGES if name in found}


@cache
def code_hash(root: Path = _ROOT) -> str:
    """Return the hash of the files of `SOURCES` below a folder, their names included."""
    total = hashlib.sha256()
    for source in SOURCES:
        place = root / source
        for path in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            total.update(f"{path.relative_to(root).as_posix()} {file_sha256(path)}\n".encode())
    return total.hexdigest()


def has_cell(folder: Path, key: str) -> bool:
    """Return whether a cell is there and whole."""
    if not (folder / f"{key}.npz").is_file():
        return False
    try:
        read_cell(folder, key)
    except DataError:
        return False
    return True


def write_cell(folder: Path, settings: CellSettings, tally: Tally) -> None:
    """Write a cell, the times first: a cell that is there is complete."""
    judged = tally.judged
    arrays: Mapping[str, Any] = {
        "settings": np.frombuffer(msgspec.json.encode(settings, order="deterministic"), np.uint8),
        "truths": judged.truths.astype(np.int32),
        "found": judged.found.astype(np.int32),
        "score": judged.score,
        "matched": np.stack([judged.matched[key] for key in _KEYS]).astype(np.int32),
        "ego_share": tally.ego_share,
        "traffic": np.zeros((0, 4)) if tally.traffic is None else tally.traffic,
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_file(folder / f"{settings.key}.seconds", "".join(f"{value:.6f}\n" for value in tally.seconds))
    write_file(folder / f"{settings.key}.npz", buffer.getvalue())


def read_cell(folder: Path, key: str) -> Tally:
    """Read a cell; without its times they are empty.

    Raises:
        DataError: it is damaged.
    """
    path = folder / f"{key}.npz"
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            truths, found = (file[name].astype(np.int64) for name in ("truths", "found"))
            matched = dict(zip(_KEYS, file["matched"].astype(np.int64), strict=True))
            judged = Judged(truths, found, file["score"], matched)
            ego_share, traffic = file["ego_share"], file["traffic"]
        times = path.with_suffix(".seconds")
        seconds = np.array(times.read_text(encoding="utf-8").split() if times.is_file() else [], np.float64)
    except (OSError, EOFError, ValueError, KeyError, NotImplementedError, zipfile.BadZipFile, zlib.error):
        hint = "; start again: it is made anew"
        raise DataError(complaint(path, "cell", "a whole one", "a damaged one", hint)) from None
    return Tally(judged, ego_share, seconds, traffic if len(traffic) else None)
