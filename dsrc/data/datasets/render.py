"""Other sweeps of a drive that was simulated before: another LiDAR, other agents, another mounting, without SUMO.

The traffic log and the static world beside it are all that is needed; a drive made of them is a drive as any other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec

from dsrc.data.datasets.spec import about_log, equipped
from dsrc.data.drive_folder import read_settings
from dsrc.data.executors import SERIAL, Pool, Progress
from dsrc.data.formats.opv2v.reader import PROTOCOL
from dsrc.data.simulate import TRAFFIC_LOG
from dsrc.data.write import DriveSpec, make_drive
from sim.errors import DataError, SettingsError, complaint, did_you_mean
from sim.files import file_sha256
from sim.scenario import Scenario
from sim.traffic.log import TrafficLog


@dataclass(frozen=True, slots=True)
class Changes:
    """What is to be other than in the recording; None leaves it.

    Attributes:
        lidar: preset of the vehicles.
        roadside_lidar: preset of all roadside units.
        roadside: whether the roadside units stand there.
        vehicles: how many vehicles carry a LiDAR.
        agents: ids of those that do, ego first.
        mount: x, y, z, m, in the body frame, and pitch, deg, of the vehicles' LiDARs.
        frames: the first so many.
    """

    lidar: str | None = None
    roadside_lidar: str | None = None
    roadside: bool = True
    vehicles: int | None = None
    agents: tuple[int, ...] = ()
    mount: tuple[float, float, float, float] | None = None
    frames: int | None = None


@dataclass(frozen=True, slots=True)
class _Work:
    """Drive to render: settings, new folder, folder of its traffic log, further entries of its protocol."""

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
        source: a traffic log, a drive, or a folder of drives (up to two levels above them).
        out: folder of the new drives, which keep their names.
        changes: differences from the recording.
        pool: workers.
        progress: called with (frames done, frames in all).

    Returns:
        The folders of the drives.

    Raises:
        DataError: a log is missing, damaged or too short; a folder holds a drive of other settings.
        SettingsError: a setting is out of its range.
        ScenarioError: an agent leaves too early, or there is no world beside the log and it cannot be built.
    """
    logs = find_logs(source)
    specs = [spec_of(log, changes) for log in logs]
    work, made = [], []
    for log, spec in zip(logs, specs, strict=True):
        name = log.parent.resolve().name
        folder = Path(out) / (name if len(logs) == 1 else log.parent.relative_to(source))
        if folder.resolve() == log.parent.resolve():
            raise SettingsError(complaint("render", "out", "another folder than the recording's", str(out)))
        _, about = about_log(log)
        more = {
            "rendered": {"sha256": file_sha256(log)},
            **({"proof": about["proof"]} if "proof" in about else {}),
        }
        work.append(
            _Work(spec, folder.resolve(), log.parent.resolve(), more)
        )  # workers may have another current folder
        made.append(folder)
    frames = [0] * len(work)

    def report(row: int, done: int, wanted: int) -> None:
        frames[row] = specs[row].frames * done // wanted
        if progress is not None:
            progress(sum(frames), sum(spec.frames for spec in specs))

    with pool.open(len(work)) as executor:
        for result in executor.run(_render, [replace(one, threads=executor.threads) for one in work], report):
            if result.error is not None:
                raise result.error
    return made


def _render(work: _Work, progress: Progress) -> None:
    """Write one drive; a task."""
    make_drive(work.spec, work.folder, progress, work.recorded, work.threads, work.more)


def find_logs(source: Path) -> list[Path]:
    """Return the traffic logs at or below a path, sorted; DataError when there is none."""
    source = Path(source)
    if source.is_file():
        if source.name != TRAFFIC_LOG:
            raise DataError(complaint(source, "traffic log", f"a file named {TRAFFIC_LOG}", source.name))
        return [source]
    found = [path for pattern in ("", "*/", "*/*/") for path in source.glob(f"{pattern}{TRAFFIC_LOG}")]
    if not found:
        hint = "" if source.is_dir() else "; there is no such folder"
        raise DataError(complaint(source, "traffic log", f"a {TRAFFIC_LOG} at most two folders below", "none", hint))
    return sorted(found)


def spec_of(log: Path, changes: Changes) -> DriveSpec:
    """Return what a drive of a log is with some changes; see `render` for what it raises."""
    scenario, about = about_log(log)
    scenario = equipped(scenario, changes.vehicles, changes.lidar, changes.roadside_lidar, changes.roadside)
    rule = scenario.agents
    if changes.agents and changes.vehicles is not None:
        raise SettingsError(complaint("render", "agents", "either ids or a number", "both"))
    if changes.agents:
        rule = msgspec.structs.replace(rule, named=_names(log, changes.agents), vehicles=len(changes.agents))
    elif changes.vehicles is not None:
        rule = msgspec.structs.replace(rule, named=())
    if changes.mount is not None:
        x, y, z, pitch_deg = changes.mount
        rule = msgspec.structs.replace(rule, mount_xyz_m=(x, y, z), mount_pitch_deg=pitch_deg)
    frames = int(about["frames"]) if changes.frames is None else changes.frames
    if frames > int(about["frames"]):
        raise SettingsError(complaint("render", "frames", f"at most {about['frames']}, as recorded", frames))
    scenario = _checked(log, msgspec.structs.replace(scenario, agents=rule))
    # What the recording says nothing of stays as in the drive, if there is one beside it.
    settings = read_settings(log.parent) if (log.parent / PROTOCOL).exists() else None
    kept = {name: settings[name] for name in ("connected_vehicles", "motion", "visibility")} if settings else {}
    spec = DriveSpec(scenario, int(about["seed"]), frames, float(about["interval_s"]), **kept)
    spec.check("render")
    return spec


def _checked(log: Path, scenario: Scenario) -> Scenario:
    """Return the scenario; SettingsError where a change is out of the range that a scenario file may have."""
    try:
        return msgspec.convert(msgspec.to_builtins(scenario), Scenario)
    except msgspec.ValidationError as error:
        raise SettingsError(f"{log}: with these changes: {error}") from None


def _names(log: Path, ids: Sequence[int]) -> tuple[str, ...]:
    first = TrafficLog.load(log)[0]
    names = dict(zip(first.boxes.object_id.tolist(), first.name, strict=True))
    for number in ids:
        if number not in names:
            hint = did_you_mean(str(number), map(str, names))
            raise SettingsError(complaint("render", "agents", "ids of road users in the first frame", number, hint))
    return tuple(names[number] for number in ids)
