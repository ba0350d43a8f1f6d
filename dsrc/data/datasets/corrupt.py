"""Corruption of a dataset: its drives under one corruption, written as OPV2V trees; scans go to `corrupt_scans`.

Frames are independent of each other (`corrupt_frame`): their bytes are the same for any number of workers, and existing
frames are skipped. The protocol of a corrupted drive is that of its source with one more entry in
`testbed.corruptions`: a drive can be corrupted more than once. The entry holds the hash of the corruptions' code: a
drive that another version began is not resumed.
"""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from dsrc.data.clouds.files import is_scan
from dsrc.data.datasets.corrupt_scans import corrupt_scans
from dsrc.data.datasets.corruption_settings import CorruptionJob, corruption_entry, run_condition
from dsrc.data.drive_folder import check_same, is_complete, read_settings, write_protocol
from dsrc.data.drives import Drive, find_drives, open_drive, path_below
from dsrc.data.formats.opv2v.reader import agent_table, lists_connected_vehicles, own_settings, write_frame
from dsrc.options.drives import CorruptOptions
from dsrc.options.fields import takes_fields
from dsrc.runs.executors import SERIAL, Executor, Pool, Progress
from dsrc.runs.jobs import run_jobs
from dsrc.runs.lock import locked
from sensors.corruptions import CLEAN, CORRUPTIONS, corrupt_frame
from sensors.frame import Frame
from sim.errors import DataError, SettingsError, complaint
from sim.files import remove_leftovers
from sim.kept.code_hash import code_hash


@takes_fields(CorruptOptions)
def corrupt_dataset(options: CorruptOptions, pool: Pool = SERIAL, progress: Progress | None = None) -> list[Path]:
    """Write the drives or scans at or below a path under a corruption; an interrupted run resumes.

    Of drives sweeps, poses and ground truth are written; camera images and further keys of other tools' files are left
    out. The ground truth and its point counts are those of the source.

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
    drives = [] if data.is_file() or is_scan(data) else find_drives(data)
    if not drives:
        return corrupt_scans(options, pool, progress)
    if options.sensor is not None:
        raise SettingsError("corrupt: drives know their LiDARs; leave out --sensor")
    jobs = [CorruptionJob(drive, out / path_below(data, drive), drive.name, options) for drive in drives]
    readers = [open_drive(job.source) for job in jobs]
    total, done = sum(map(len, readers)), 0
    with pool.open(max(map(len, readers))) as executor:
        for job, reader in zip(jobs, readers, strict=True):
            _corrupt_drive(job, reader, executor, progress, done, total)
            done += len(reader)
    return [job.out for job in jobs]


def _corrupt_drive(
    job: CorruptionJob, reader: Drive, executor: Executor, progress: Progress | None, done: int, total: int
) -> None:
    """Write the missing frames of a drive.

    Args:
        progress: called with frames done and frames in all.
        done: frames of the drives before.
    """
    protocol = _protocol(job, reader)
    with locked(job.out):
        found = read_settings(job.out)
        if found is not None:
            found.pop("agents", None)
            check_same(job.out, found, {k: v for k, v in protocol["testbed"].items() if k != "agents"})
            missing = [i for i, index in enumerate(reader.frames) if not is_complete(job.out, reader.agents, index)]
        else:
            missing = list(range(len(reader)))
        if missing and found is None:
            # The first frame has the sensors of the protocol; without a protocol a folder has no complete frame.
            frame = corrupted(job, reader, missing[0])
            protocol["testbed"]["agents"] = agent_table(frame)
            write_protocol(job.out, protocol)
            _write(job, reader, frame)
            missing = missing[1:]
        chunks = [missing[k : k + executor.chunk] for k in range(0, len(missing), executor.chunk)]
        done += len(reader) - len(missing)
        items = [(job, chunk) for chunk in chunks]
        run_jobs(_corrupt_frames, items, executor, progress, list(map(len, chunks)), done, total)
        remove_leftovers(job.out)


def corrupted(job: CorruptionJob, reader: Drive, i: int) -> Frame:
    """Return the i-th frame of a drive under its corruption."""
    # The number of the file is that of the random stream and of the new file.
    frame, options = replace(reader.read(i), index=reader.frames[i]), job.options
    try:
        return run_condition(options).apply(frame, job.drive_seed)
    except DataError as error:
        raise DataError(f"{job.source}: {error}") from None


def _write(job: CorruptionJob, reader: Drive, frame: Frame) -> None:
    write_frame(
        job.out, frame, lists_connected_vehicles(reader.protocol), reader.plans(reader.frames.index(frame.index))
    )


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
        return {"testbed": {"frames": len(reader), "corruptions": [entry]}}
    return {**reader.protocol, "testbed": {**own, "corruptions": [*own.get("corruptions", []), entry]}}


def _corrupt_frames(item: tuple[CorruptionJob, list[int]], progress: Progress) -> None:
    """Write these frames of a drive; a task."""
    job, rows = item
    reader = _reader(job.source)
    for i in rows:
        _write(job, reader, corrupted(job, reader, i))


@lru_cache(maxsize=1)
def _reader(drive: Path) -> Drive:
    return open_drive(drive)
