"""Corruption of scans of other people's data sets: a file, or all scans below a folder, in their own formats.

A folder of scans is taken for a drive: its weather and its dead beams are one, and the frame's number is that in the
name of the file. So the bytes of a scan depend on the seed, on the names of the file and of the two folders above it,
and on nothing else: not on other files, not on the number of workers. Labels of SemanticKITTI stay in step, in
`labels/` where the new scans are in a folder of the old one's name, else beside them: added points get label 0,
unlabelled.

`corruption.json` in the new folder holds the settings; a scan that is older than its corrupted one is not made again.
"""

import re
import zlib
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dsrc.data.clouds.cloud import rows_of
from dsrc.data.clouds.corrupt import INTERVAL_S, corrupt_sweep
from dsrc.data.clouds.files import (
    ending_of,
    kitti_boxes,
    labels_of,
    read_labels,
    read_scan,
    scans_below,
    vehicles_among,
)
from dsrc.data.datasets.corruption_settings import CorruptionJob, corruption_entry, run_condition
from dsrc.data.drive_folder import check_same
from dsrc.data.jsonio import read_json
from dsrc.options.drives import CorruptOptions
from dsrc.runs.executors import Pool, Progress
from dsrc.runs.jobs import run_jobs
from dsrc.runs.lock import locked
from sensors.corruptions import CORRUPTIONS, EVERYONE
from sensors.presets import get_lidar
from sim.errors import DataError, SettingsError, complaint
from sim.files import remove_leftovers, write_file
from sim.kept.code_hash import code_hash

MANIFEST = "corruption.json"

_CHUNK = 8
_NUMBER = re.compile(r"(\d+)\D*$")
_MICROSECONDS = 16
"""Digits of a name that is an instant, as nuScenes has them, µs."""


class ScanCorruption(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of `MANIFEST`.

    Attributes:
        corruption: see `corruption_entry`, and the sensor.
    """

    corruption: dict[str, Any]


def corrupt_scans(options: CorruptOptions, pool: Pool, progress: Progress | None = None) -> list[Path]:
    """Write a scan or all scans below a folder under a corruption; an interrupted folder resumes.

    Args:
        options: scans, file or folder of the corrupted ones, corruption and seed.
        progress: called with (scans done, scans in all).

    Returns:
        The new files.

    Raises:
        SettingsError: the kind needs other agents or objects, or an option is one of drives.
        DataError: there are no scans, one cannot be read or lacks what the corruption needs, or the folder holds scans
            of other settings.
    """
    data, out = Path(options.data), Path(options.out)
    if options.who != EVERYONE:
        raise SettingsError("corrupt: a scan is of one sensor; leave out --who")
    if options.sensor is not None:
        get_lidar(options.sensor)
    if not data.is_dir():
        if ending_of(out) != ending_of(data):
            raise SettingsError(complaint("corrupt", "out", f"a file *{ending_of(data)}, as the scan's", out.name))
        _write(_corrupted(_job(data, out, options)))
        return [out]
    jobs = [_job(path, out / path.relative_to(data), options) for path in scans_below(data)]
    manifest = {**corruption_entry(options, code_hash(__name__)), "sensor": options.sensor}
    with locked(out, what="folder of scans"):
        if (out / MANIFEST).exists():
            check_same(out, read_json(out / MANIFEST, ScanCorruption).corruption, manifest, MANIFEST)
            missing = [job for job in jobs if not _is_done(job)]
        else:
            # Settings that the first scan refuses are not noted: the folder stays free for others.
            first, missing = _corrupted(jobs[0]), jobs[1:]
            write_file(out / MANIFEST, msgspec.json.format(msgspec.json.encode({"corruption": manifest})) + b"\n")
            _write(first)
        chunks = [missing[k : k + _CHUNK] for k in range(0, len(missing), _CHUNK)]
        run_jobs(_corrupt_chunk, chunks, pool, progress, list(map(len, chunks)), len(jobs) - len(missing))
        remove_leftovers(out)
    return [job.out for job in jobs]


def _job(source: Path, out: Path, options: CorruptOptions) -> CorruptionJob:
    return CorruptionJob(source, out, "/".join(source.resolve().parts[-3:-1]), options)


def _is_done(job: CorruptionJob) -> bool:
    """Return whether the new file is there, and not older than its source."""
    return job.out.is_file() and job.out.stat().st_mtime_ns >= job.source.stat().st_mtime_ns


def _corrupt_chunk(jobs: list[CorruptionJob], progress: Progress) -> None:
    """Write some scans; a task."""
    for job in jobs:
        _write(_corrupted(job))


def _write(files: dict[Path, bytes]) -> None:
    for path, content in files.items():
        write_file(path, content)


def _corrupted(job: CorruptionJob) -> dict[Path, bytes]:
    """Return the files of a corrupted scan, that of its labels before its own."""
    scan, options, labels = read_scan(job.source), job.options, None
    if labels_of(job.source).is_file():
        labels = read_labels(labels_of(job.source), len(scan.cloud))
    boxes = kitti_boxes(job.source) if labels is None and CORRUPTIONS[options.corruption].of_objects else None
    name = options.sensor or scan.sensor
    index, time_s = frame_number(job.source)
    condition = run_condition(options)
    try:
        after = corrupt_sweep(
            scan.cloud.sweep(
                None if name is None else get_lidar(name), None if labels is None else vehicles_among(labels)
            ),
            options.corruption,
            condition.resolved(),
            job.drive_seed,
            family=condition.family,
            boxes=boxes,
            labelled=labels is not None,
            index=index,
            time_s=time_s,
        )
    except (DataError, SettingsError) as error:
        raise type(error)(f"{job.source}: {error}") from None
    files = {job.out: scan.encode(scan.cloud.of(after))}
    if labels is None:
        return files
    row = rows_of(after)
    kept = np.where(row < 0, 0, np.append(labels, 0)[row]).astype("<u4")
    alike = job.out.parent.name == job.source.parent.name
    return {labels_of(job.out) if alike else job.out.with_suffix(".label"): kept.tobytes(), **files}


def frame_number(path: Path) -> tuple[int, float]:
    """Return number and time, s, of the frame of a scan by its name.

    The last digits are the number of a frame, 0.1 s apart; 16 of them are microseconds. A name without digits stands
    for an instant of its own.
    """
    found = _NUMBER.search(path.name.removesuffix(ending_of(path) or ""))
    if found is None:
        return zlib.crc32(path.name.encode()), 0.0
    number = int(found[1])
    return number, number * (1e-6 if len(found[1]) == _MICROSECONDS else INTERVAL_S)
