"""Shares of agents in the detections of drives, `dsrc shares`: clean and corrupted, through a radio channel."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec

from dsrc.data.drives import Drive, drive_hashes, list_drives, open_drive
from dsrc.detectors.open import close_detector, detector_sha256, open_detector
from dsrc.detectors.texts import kind_of, split_name
from dsrc.evaluation.cells import CellJob
from dsrc.evaluation.config import check_numbers
from dsrc.evaluation.detect import frame_positions
from dsrc.evaluation.runner import check_device
from dsrc.evaluation.sharing.cells import (
    ShareRow,
    ShareSettings,
    make_share_cells,
    read_share_cell,
    read_share_settings,
)
from dsrc.evaluation.sharing.shares import MOST_AGENTS, check_iou
from dsrc.evaluation.stored import StoredDrive
from dsrc.models.fusion import FUSIONS, Fusion
from dsrc.models.settings import fusion_of
from dsrc.options.detection import Sharing
from dsrc.options.fields import takes_fields
from dsrc.runs.executors import SERIAL, Pool, Progress
from dsrc.runs.lock import locked
from dsrc.runs.provenance import provenance
from dsrc.runs.study import Study, reuse_entry
from sensors.corruptions import Condition, conditions_of
from sim.errors import DataError, complaint
from sim.kept.code_hash import code_hash, versions_with
from sim.radio import get_channel

CHUNK = 10
"""Frames of a cell, the most that an interruption loses: each is detected in by up to 32 teams."""

SHARES: Study[CellJob, Sequence[ShareRow]] = Study(
    task=make_share_cells,
    alike=lambda job: job.settings.key,
    steps=lambda job: len(job.settings.positions),
    endings=(".json",),
    read=read_share_cell,
    settings=lambda job: job.settings,
    stored=read_share_settings,
)


@takes_fields(Sharing)
def share_drives(config: Sharing, pool: Pool = SERIAL, progress: Progress | None = None) -> list[ShareRow]:
    """Shares in all frames of the drives under each condition, in the order of drives, frames and conditions.

    Frames whose shares are in `out/cells` are read from there.

    Args:
        config: see `Sharing`.
        pool: workers, of one thread each; the shares are the same for any.
        progress: called with frames done and frames missing at the start.

    Raises:
        UserError: a file, a drive or a setting is wrong; all cells that can be computed are there.
    """
    check_numbers("shares", config.seed, config.frames)
    check_iou(config.iou)
    check_device("shares", config.device)
    conditions = conditions_of(
        config.corruption, (config.severity,), (config.family,), config.corrupted_agents, "shares"
    )
    _, text = split_name(str(config.checkpoint))
    detector = open_detector(text, config.device, config.engine)  # a wrong one before anything is written
    sha256, fusion = detector_sha256(text, detector), FUSIONS[fusion_of(detector.settings)]
    close_detector(detector)
    readers = [open_drive(path) for path in list_drives(config.data)]
    names = [reader.drive.name for reader in readers]
    if twice := [name for name in names if names.count(name) > 1]:
        raise DataError(complaint(config.data, "drives", "drives of different names", f"two called '{twice[0]}'"))
    folder = config.out / "cells"
    with locked(config.out, what="folder of shares"):
        by_drive = [
            list(_jobs(reader, positions, conditions, config, text, sha256, fusion))
            for reader, positions in zip(readers, frame_positions(readers, config.frames), strict=True)
        ]
        jobs = {job.settings.key: job for own in by_drive for job in own}
        SHARES.run(folder, jobs, pool, progress, config.reuse)
        place = {condition.kind: row for row, condition in enumerate(conditions)}
        return [
            row
            for own in by_drive
            for row in sorted(_read(folder, own), key=lambda row: (row.frame, place[row.condition]))
        ]


def _jobs(
    reader: Drive,
    positions: Sequence[int],
    conditions: Sequence[Condition],
    config: Sharing,
    text: str,
    sha256: str,
    fusion: type[Fusion],
) -> Iterator[CellJob]:
    """Yield the cells of a drive."""
    radios = config.radios(() if config.channel is None else (config.channel,))
    channel = get_channel(radios[0]) if radios else None
    data = reader.digest()
    for start in range(0, len(positions), CHUNK):
        chunk = tuple(positions[start : start + CHUNK])
        for condition in conditions:
            settings = ShareSettings(
                detector=sha256,
                use={},
                drive=reader.drive.name,
                data=data,
                positions=chunk,
                seed=config.seed,
                agents=MOST_AGENTS,
                device=config.device,
                engine=config.engine,
                versions=versions_with(make_share_cells.__module__, fusion),
                code=code_hash(make_share_cells.__module__),
                condition=condition.decisive(),
                channel=None if channel is None else channel.decisive(),
                iou=config.iou,
            )
            yield CellJob(settings, text, reader.drive, condition, None, channel)


def _read(folder: Path, jobs: Iterable[CellJob]) -> Iterator[ShareRow]:
    for job in jobs:
        yield from read_share_cell(folder, job.settings.key)


def frames_looked_at(config: Sharing) -> int:
    """Number of frames under each condition of `share_drives`; those without any box have no row."""
    readers = [open_drive(path) for path in list_drives(config.data)]
    return sum(map(len, frame_positions(readers, config.frames)))


def stored_drives(data: Path) -> tuple[StoredDrive, ...]:
    """Drives whose shares are stored."""
    paths = list_drives(data)
    return tuple(
        StoredDrive(dataset=data.name, path=str(path.resolve()), data=open_drive(path).digest()) for path in paths
    )


def provenance_of(config: Sharing) -> dict[str, Any]:
    """Provenance of shares: settings, hashes of the detector and the data, versions."""
    changes = {name for name in ("loss", "delay_s", "pose_error") if getattr(config, name) is None}
    without = {"out", "reuse", *changes}  # an unchanged channel is listed as before there were changes
    fields = {name: getattr(config, name) for name in Sharing.__struct_fields__ if name not in without}
    settings = msgspec.to_builtins(fields, enc_hook=str)
    settings["who"] = settings.pop("corrupted_agents")  # its name in files
    _, text = split_name(str(config.checkpoint))
    settings["data"] = config.data.name
    settings["checkpoint"] = Path(text).name if kind_of(text) in ("file", "onnx") else text
    settings["sha256"] = detector_sha256(text)
    made_by = provenance(settings, config.seed, drive_hashes(list_drives(config.data)))
    return {**made_by, **reuse_entry(config.out / "cells")}
