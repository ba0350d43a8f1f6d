"""Corruption of a dataset: its drives under one corruption, written as OPV2V trees; scans go to `corrupt_scans`.

A drive is a series of frames, see `dsrc.runs.series`. Its protocol is that of its source with one more entry in
`testbed.corruptions`: a drive can be corrupted more than once. The entry holds the hash of the corruptions' code: a
drive that another version began is resumed only where it is named in `reuse`.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from dsrc.data.clouds.files import is_scan
from dsrc.data.datasets.corrupt_scans import corrupt_scans
from dsrc.data.datasets.corruption_settings import CorruptionJob, corruption_entry, run_condition
from dsrc.data.drive_folder import is_complete, read_settings, write_protocol
from dsrc.data.drives import Drive, find_drives, label_notes, open_drive, path_below
from dsrc.data.formats.opv2v.reader import (
    PROTOCOL,
    agent_table,
    clouds_of,
    frame_files,
    lists_connected_vehicles,
    own_settings,
    write_frame,
)
from dsrc.data.sweeps.reader import of_loose_scans
from dsrc.options.drives import CorruptOptions
from dsrc.options.fields import takes_fields
from dsrc.runs.executors import SERIAL, Pool, Progress
from dsrc.runs.series import Series
from sensors.corruptions import CLEAN, CORRUPTIONS, corrupt_frame
from sensors.frame import Frame
from sim.errors import DataError, SettingsError, complaint
from sim.kept.code_hash import code_hash


@takes_fields(CorruptOptions)
def corrupt_dataset(options: CorruptOptions, pool: Pool = SERIAL, progress: Progress | None = None) -> list[Path]:
    """Write the drives or scans at or below a path under a corruption; an interrupted run resumes.

    Of drives sweeps, poses and ground truth are written; camera images and further keys of other tools' files are left
    out. The ground truth and its point counts are those of the source. Of a tree of loose scans these are written, and
    all else is linked beside them.

    Args:
        options: drives, folder, corruption and seed, see `CorruptOptions`; or these as arguments.
        pool: workers; processes need a `__main__` that can be imported.
        progress: called with (frames done, frames in all).

    Returns:
        The folders of the corrupted drives, or the files of the scans.

    Raises:
        SettingsError: an unknown kind, a setting out of its range, or `out` is not apart from `data`.
        DataError: a drive cannot be read or lacks what the corruption needs, or a folder holds a drive of other
            settings.
    """
    if options.corruption == CLEAN:
        raise SettingsError(complaint("corrupt", "corruption", f"one of {', '.join(CORRUPTIONS)}", CLEAN))
    run_condition(options)  # a wrong one is told before the work
    if options.seed < 0:
        raise SettingsError(complaint("corrupt", "seed", "at least 0", options.seed))
    data, out = Path(options.data).resolve(), Path(options.out).resolve()
    if out.is_relative_to(data) or data.is_relative_to(out):
        raise SettingsError(complaint("corrupt", "out", f"a place apart from {data}", str(out)))
    drives = [] if is_scan(data) else find_drives(data)
    if not drives or any(map(of_loose_scans, drives)):
        scans = corrupt_scans(options, pool, progress)
        if drives and data.is_dir():
            _link_rest(data, out, scans)
        return scans
    if options.sensor is not None:
        raise SettingsError("corrupt: drives know their LiDARs; leave out --sensor")
    jobs = [CorruptionJob(drive, out / path_below(data, drive), drive.name, options) for drive in drives]
    earlier = [Path(given).resolve() for given in options.reuse]
    places = [[given / path_below(data, job.source) for given in earlier] for job in jobs]
    for given, folders in zip(earlier, zip(*places, strict=True), strict=True):
        if not any(map(read_settings, folders)):
            raise DataError(complaint(given, "reuse", f"corrupted drives, each with its {PROTOCOL}", "none"))
    readers = [open_drive(job.source) for job in jobs]
    total, done = sum(map(len, readers)), 0
    with pool.open(max(map(len, readers))) as executor:
        for job, reader, reuse in zip(jobs, readers, places, strict=True):
            frames = [FrameJob(job, row) for row in range(len(reader))]
            _series(job, reader, executor.chunk).run(frames, executor, progress, done, total, reuse)
            done += len(reader)
    return [job.out for job in jobs]


def _link_rest(data: Path, out: Path, scans: Iterable[Path]) -> None:
    """Link labels, calibrations and tables beside the new scans of a tree, so that these are drives as the old ones."""
    above = {folder for scan in scans for folder in scan.parents}

    def link(source: Path, place: Path) -> None:
        for old in sorted(source.iterdir()):
            new = place / old.name
            if new in above:
                link(old, new)
            elif not (old.name.startswith(".") or is_scan(old) or new.exists() or new.is_symlink()):
                new.symlink_to(old)

    link(data, out)


@dataclass(frozen=True, slots=True)
class FrameJob:
    """Frame to corrupt: its drive and its place there."""

    drive: CorruptionJob
    row: int


def _series(job: CorruptionJob, reader: Drive, chunk: int) -> Series[FrameJob, Frame]:
    """Return the frames of a drive as a series, its protocol as their record."""
    protocol = _protocol(job, reader)
    clouds = clouds_of(reader.drive, protocol)

    def note(first: Frame) -> None:
        """Write the protocol with the sensors of the first frame."""
        write_protocol(job.out, {**protocol, "testbed": {**protocol["testbed"], "agents": agent_table(first)}})

    return Series(
        folder=job.out,
        what="drive",
        record=PROTOCOL,
        settings={name: value for name, value in protocol["testbed"].items() if name != "agents"},
        stored=_stored,
        note=note,
        make=corrupted,
        write=_write,
        files=lambda folder, frame: frame_files(folder, reader.agents, reader.frames[frame.row], clouds),
        fresh=lambda folder, frame: is_complete(folder, reader.agents, reader.frames[frame.row], clouds),
        chunk=chunk,
    )


def _stored(drive: Path) -> dict | None:
    found = read_settings(drive)
    return None if found is None else {name: value for name, value in found.items() if name != "agents"}


def corrupted(job: FrameJob) -> Frame:
    """Return a frame under its corruption."""
    reader = _reader(job.drive.source)
    # The number of the file is that of the random stream and of the new file.
    frame = replace(reader.read(job.row), index=reader.frames[job.row])
    try:
        return run_condition(job.drive.options).apply(frame, job.drive.drive_seed)
    except DataError as error:
        raise DataError(f"{job.drive.source}: {error}") from None


def _write(job: FrameJob, frame: Frame) -> None:
    reader = _reader(job.drive.source)
    listed, clouds = lists_connected_vehicles(reader.protocol), clouds_of(reader.drive, reader.protocol)
    write_frame(job.drive.out, frame, listed, reader.plans(job.row), clouds=clouds)


def _protocol(job: CorruptionJob, reader: Drive) -> dict:
    """Return the protocol of the corrupted drive: that of its source with the corruption."""
    entry = {
        **corruption_entry(job.options, code_hash(corrupt_frame.__module__)),
        "drive_seed": job.drive_seed,
        "source": {"drive": job.source.name, "sha256": reader.digest()},
    }
    if "who" in entry:
        entry["who"] = entry.pop("who")  # the last one, as in files of earlier versions
    own = own_settings(reader.protocol)
    if not own:
        return {"testbed": {"frames": len(reader), **label_notes(reader), "corruptions": [entry]}}
    return {**reader.protocol, "testbed": {**own, "corruptions": [*own.get("corruptions", []), entry]}}


@lru_cache(maxsize=1)
def _reader(drive: Path) -> Drive:
    return open_drive(drive)
