"""Corruption of scans of other people's data sets: a file, or all scans below a folder, in their own formats.

A folder of scans is taken for a drive: its weather and its dead beams are one, and the frame's number is that in the
name of the file. So the bytes of a scan depend on the seed, on the names of the file and of the two folders above it,
and on nothing else: not on other files, not on the number of workers. Labels of SemanticKITTI stay in step, in
`labels/` where the new scans are in a folder of the old one's name, else beside them: added points get label 0,
unlabelled.

Intensities of all scans are of one scale: the one declared, or found over all of them.

`corruption.json` in the new folder holds the settings; a scan that is older than its corrupted one is not made again.
"""

import re
import zlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dsrc.data.clouds.columns import parse_columns
from dsrc.data.clouds.corrupt import INTERVAL_S, corrupt_sweep
from dsrc.data.clouds.files import (
    ending_of,
    intensities_of,
    kitti_boxes,
    labels_of,
    read_labels,
    read_scan,
    scans_below,
    vehicles_among,
)
from dsrc.data.clouds.intensity import Intensities, Scale, parse_scale
from dsrc.data.datasets.corruption_settings import CorruptionJob, corruption_entry, run_condition
from dsrc.data.jsonio import read_json
from dsrc.options.drives import CorruptOptions
from dsrc.runs.executors import Executor, Pool, Progress
from dsrc.runs.jobs import results_of
from dsrc.runs.series import Series
from sensors.corruptions import CORRUPTIONS, EVERYONE
from sensors.presets import get_lidar
from sim.errors import DataError, SettingsError, complaint
from sim.files import write_file
from sim.kept.code_hash import code_hash

MANIFEST = "corruption.json"

_CHUNK = 8
_NUMBER = re.compile(r"(\d+)\D*$")
_MICROSECONDS = 16
"""Digits of a name that is an instant, as nuScenes has them, µs."""

_READ_AT_ONCE = 8
"""Scans that a worker reads at once for their scale."""


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
        DataError: there are no scans, one cannot be read or lacks what the corruption needs, the scale of their
            intensities cannot be found, or the folder holds scans of other settings.
    """
    data, out = Path(options.data), Path(options.out).resolve()
    if options.corrupted_agents != EVERYONE:
        raise SettingsError("corrupt: a scan is of one sensor; leave out --corrupted-agents")
    if options.sensor is not None:
        get_lidar(options.sensor)
    columns, scale = parse_columns(options.columns), parse_scale(options.intensity_scale)
    if not data.is_dir():
        if ending_of(out) != ending_of(data):
            raise SettingsError(complaint("corrupt", "out", f"a file *{ending_of(data)}, as the scan's", out.name))
        if options.reuse:
            raise SettingsError("corrupt: a single scan is always made anew; leave out --reuse")
        scan = _job(data, out, options)
        _write(scan, _corrupted(scan))
        return [out]
    paths = scans_below(data)
    with pool.open(len(paths)) as executor:
        if scale is None:
            scale = _scale_of(paths, columns, data, executor)
        return _corrupt_folder(
            paths, msgspec.structs.replace(options, columns=columns, intensity_scale=scale), executor, progress
        )


def _scale_of(paths: Sequence[Path], columns: Sequence[str] | None, data: Path, executor: Executor) -> Scale:
    """Return the one scale of the intensities of a folder, see `dsrc.data.clouds.files.scale_of`, by all workers."""
    chunks = [paths[k : k + _READ_AT_ONCE] for k in range(0, len(paths), _READ_AT_ONCE)]
    seen: list[Intensities] = []
    for result in results_of(partial(_seen, columns), chunks, executor):
        if result.error is not None:
            raise result.error
        seen.append(result.value)
    return Intensities.joined(seen).scale(data)


def _seen(columns: Sequence[str] | None, paths: Sequence[Path], progress: Progress) -> Intensities:
    """Return what the intensities of some scans tell of their scale; a task."""
    return intensities_of(paths, columns)


def _corrupt_folder(
    paths: Sequence[Path], options: CorruptOptions, executor: Executor, progress: Progress | None
) -> list[Path]:
    """Write the scans of a folder, all options of them known; see `corrupt_scans`."""
    data, out = Path(options.data), Path(options.out).resolve()
    jobs = [_job(path, out / path.relative_to(data), options) for path in paths]
    manifest = {**corruption_entry(options, code_hash(__name__)), "sensor": options.sensor}
    manifest |= {"columns": options.columns, "intensity_scale": options.intensity_scale}

    def note(first: dict[Path, bytes]) -> None:
        write_file(out / MANIFEST, msgspec.json.format(msgspec.json.encode({"corruption": manifest})) + b"\n")

    scans = Series(
        folder=out,
        what="folder of scans",
        record=MANIFEST,
        settings=manifest,
        stored=_stored,
        note=note,
        make=_corrupted,
        write=_write,
        files=lambda folder, job: _files(job, folder / job.out.relative_to(out)),
        fresh=lambda folder, job: _is_fresh(job, folder / job.out.relative_to(out)),
        chunk=_CHUNK,
    )
    earlier = [Path(given).resolve() for given in options.reuse]
    for given in earlier:
        if _stored(given) is None:
            raise DataError(complaint(given, "reuse", f"a folder of corrupted scans, with {MANIFEST}", "none"))
    scans.run(jobs, executor, progress, reuse=earlier)
    return [job.out for job in jobs]


def _stored(folder: Path) -> dict[str, Any] | None:
    path = folder / MANIFEST
    return read_json(path, ScanCorruption).corruption if path.exists() else None


def _job(source: Path, out: Path, options: CorruptOptions) -> CorruptionJob:
    return CorruptionJob(source, out, "/".join(source.resolve().parts[-3:-1]), options)


def _files(job: CorruptionJob, out: Path) -> list[Path]:
    """Return the files of a scan that is corrupted to a path: that of its labels before its own."""
    if not labels_of(job.source).is_file():
        return [out]
    return [labels_of(out) if out.parent.name == job.source.parent.name else out.with_suffix(".label"), out]


def _is_fresh(job: CorruptionJob, out: Path) -> bool:
    """Return whether the new file is there, and not older than its source."""
    return out.is_file() and out.stat().st_mtime_ns >= job.source.stat().st_mtime_ns


def _write(job: CorruptionJob, files: dict[Path, bytes]) -> None:
    for path, content in files.items():
        write_file(path, content)


def _corrupted(job: CorruptionJob) -> dict[Path, bytes]:
    """Return the `_files` of a corrupted scan."""
    options, labels = job.options, None
    scan = read_scan(job.source, parse_columns(options.columns), parse_scale(options.intensity_scale))
    if labels_of(job.source).is_file():
        labels = read_labels(labels_of(job.source), len(scan.cloud))
    boxes = kitti_boxes(job.source) if labels is None and CORRUPTIONS[options.corruption].of_objects else None
    name = options.sensor or scan.sensor
    index, time_s = frame_number(job.source)
    spec = None if name is None else get_lidar(name)
    on_vehicle = None if labels is None else vehicles_among(labels)
    try:
        after = corrupt_sweep(
            scan.cloud.sweep(spec, on_vehicle),
            run_condition(options),
            job.drive_seed,
            boxes=boxes,
            labelled=labels is not None,
            index=index,
            time_s=time_s,
        )
    except (DataError, SettingsError) as error:
        raise type(error)(f"{job.source}: {error}") from None
    content, row = scan.file(after)
    contents = [content]
    if labels is not None:
        contents.insert(0, np.where(row < 0, 0, np.append(labels, 0)[row]).astype("<u4").tobytes())
    return dict(zip(_files(job, job.out), contents, strict=True))


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
