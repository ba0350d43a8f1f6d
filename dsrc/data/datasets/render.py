"""Rendering of recorded traffic anew: other LiDARs, agents or mountings, without SUMO.

Needs the traffic log and the static world beside it, or a file of tracks that others recorded; the result is a drive as
any other.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from dsrc.data.changes import with_sensors
from dsrc.data.datasets.spec import log_settings
from dsrc.data.datasets.tracks import record_tracks
from dsrc.data.drive_folder import TRAFFIC_LOG, read_settings
from dsrc.data.formats.opv2v.reader import PROTOCOL
from dsrc.data.write import DriveSpec, make_drive
from dsrc.options.drives import Changes
from dsrc.runs.executors import SERIAL, Pool, Progress
from dsrc.runs.jobs import run_jobs
from sim.errors import DataError, SettingsError, complaint, did_you_mean
from sim.files import check_apart, file_sha256
from sim.scenario import Scenario
from sim.settings import convert
from sim.traffic.log import TrafficLog
from sim.traffic.tracks.open import READERS

_KEPT = ("connected_vehicles", "motion", "visibility", "clouds")
"""Settings of the recorded drive that the new one has too."""


@dataclass(frozen=True, slots=True)
class RenderJob:
    """Drive to render; the arguments of `make_drive`."""

    spec: DriveSpec
    folder: Path
    recorded: Path
    more: dict
    threads: int | None = None


def render(
    source: Path, out: Path, changes: Changes, pool: Pool = SERIAL, progress: Progress | None = None
) -> list[Path]:
    """Write drives anew from their traffic logs; an interrupted run resumes.

    Args:
        source: a traffic log, a drive, a folder of drives (up to two levels above them), or a file of tracks, see
            `dsrc.data.datasets.tracks`.
        out: folder of the new drives, which keep their names.
        changes: differences from the recording.
        progress: called with (frames done, frames in all).

    Returns:
        The folders of the drives.

    Raises:
        DataError: a log is missing, damaged or too short; a folder holds a drive of other settings.
        SettingsError: a setting is out of its range.
        ScenarioError: an agent leaves too early, or the world is missing and cannot be built.
    """
    source = Path(source)
    if source.suffix.lower() in READERS and source.name != TRAFFIC_LOG:
        with tempfile.TemporaryDirectory(prefix="dsrc-tracks-") as temporary:
            name = source.stem.removesuffix(".xml") if source.suffix == ".gz" else source.stem
            record_tracks(source, Path(temporary) / name)
            return render(Path(temporary), out, changes, pool, progress)
    logs = find_logs(source)
    specs = [spec_of(log, changes) for log in logs]
    jobs, made = [], []
    for log, spec in zip(logs, specs, strict=True):
        name = log.parent.resolve().name
        folder = Path(out) / (name if len(logs) == 1 else log.parent.relative_to(source))
        check_apart(folder, source if source.is_dir() else log.parent)
        _, about = log_settings(log)
        more = {
            "rendered": {"sha256": file_sha256(log)},
            **({"proof": about["proof"]} if "proof" in about else {}),
        }
        # Workers may have another current folder.
        jobs.append(RenderJob(spec, folder.resolve(), log.parent.resolve(), more))
        made.append(folder)
    with pool.open(len(jobs)) as executor:
        own = [replace(job, threads=executor.threads) for job in jobs]
        run_jobs(_render, own, executor, progress, [spec.frames for spec in specs])
    return made


def _render(job: RenderJob, progress: Progress) -> None:
    """Write one drive; a task."""
    make_drive(job.spec, job.folder, progress, job.recorded, job.threads, job.more)


def find_logs(source: Path) -> list[Path]:
    """Return the traffic logs at or below a path, sorted; DataError for a path without one."""
    source = Path(source)
    if source.is_file():
        if source.name != TRAFFIC_LOG:
            raise DataError(complaint(source, "traffic log", f"a file named {TRAFFIC_LOG}", source.name))
        return [source]
    found = [path for pattern in ("", "*/", "*/*/") for path in source.glob(f"{pattern}{TRAFFIC_LOG}")]
    if not found:
        hint = "" if source.is_dir() else "; no such folder"
        raise DataError(complaint(source, "traffic log", f"a {TRAFFIC_LOG} at most two folders below", "none", hint))
    return sorted(found)


def spec_of(log: Path, changes: Changes) -> DriveSpec:
    """Return the specification of a log's drive with changes; raises as `render`."""
    scenario, about = log_settings(log)
    scenario = with_sensors(
        scenario, changes.vehicles, changes.lidar, changes.roadside_lidar, changes.roadside, changes.mount
    )
    rule = scenario.agents
    if changes.agent_id and changes.vehicles is not None:
        raise SettingsError("render: --agent-id names the vehicles with a LiDAR; leave out --vehicles")
    if changes.agent_id:
        rule = msgspec.structs.replace(
            rule, named=_names(log, changes.agent_id, "tracks" in about), vehicles=len(changes.agent_id)
        )
    elif changes.vehicles is not None:
        rule = msgspec.structs.replace(rule, named=())
    frames = int(about["frames"]) if changes.frames is None else changes.frames
    if frames > int(about["frames"]):
        raise SettingsError(complaint("render", "frames", f"at most {about['frames']}, as recorded", frames))
    changed = msgspec.to_builtins(msgspec.structs.replace(scenario, agents=rule))
    scenario = convert(changed, Scenario, f"{log}: with these changes", SettingsError)
    # Settings that a log lacks are those of the drive beside it.
    settings = read_settings(log.parent) if (log.parent / PROTOCOL).exists() else None
    kept = {name: settings[name] for name in _KEPT if name in settings} if settings else {}
    spec = DriveSpec(scenario, int(about["seed"]), frames, interval_s=float(about["interval_s"]), **kept)
    spec.check("render")
    return spec


def _names(log: Path, ids: Sequence[int | str], by_name: bool) -> tuple[str, ...]:
    """Return the names of road users by their ids, or by the ids of the track file that the log is of."""
    first = TrafficLog.load(log)[0]
    keys = first.name if by_name else map(str, first.boxes.object_id.tolist())
    known = dict(zip(keys, first.name, strict=True))
    for one in map(str, ids):
        if one not in known:
            hint = did_you_mean(one, known)
            raise SettingsError(complaint("render", "agent_id", "ids of road users in the first frame", one, hint))
    return tuple(known[one] for one in map(str, ids))
