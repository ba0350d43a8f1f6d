"""Faults of a dataset folder, file by file, in any supported format.

Every file of every drive is read. Listed are the errors of the readers, and beyond them: wrong checksums, points that
are not finite, boxes without size, points of objects without a box, wrong point counts, poses that are not rigid or
jump.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dsrc.data.checksums import CHECKSUMS, faulty_files
from dsrc.data.datasets.manifest import MANIFEST, read_manifest
from dsrc.data.drives import Drive, list_drives, open_drive
from dsrc.data.formats.opv2v.compact import read_compact
from dsrc.data.formats.opv2v.reader import CLOUDS, clouds_of, own_settings
from dsrc.data.formats.opv2v.record import read_agent
from dsrc.data.formats.pcd import read_pcd
from dsrc.runs.executors import SERIAL, Pool, Progress
from sensors.frame import AgentFrame, Frame, count_points
from sim.errors import DataError
from sim.files import file_sha256

FASTEST_MPS = 90.0
"""Limit on the speed of an agent; above it a pose is wrong."""
_ON_BODY_M = 20.0
_RIGID = 1e-3


@dataclass(frozen=True, slots=True)
class Fault:
    """Fault of a place: a file or folder, "" where the text names it."""

    place: str
    text: str

    def __str__(self) -> str:
        return f"{self.place}: {self.text}" if self.place else self.text


def check_dataset(root: Path, pool: Pool = SERIAL, progress: Progress | None = None) -> list[Fault]:
    """Read all files at or below a folder and return their faults, by drive.

    Args:
        root: a drive, a folder of drives or of splits, in any supported format.
        progress: called with (drives done, drives in all).

    Raises:
        SettingsError: a setting of the pool is wrong.
    """
    root = Path(root)
    try:
        drives = list_drives(root)
    except DataError as error:
        return [*_manifest_faults(root), Fault("", str(error))]
    found: dict[int, list[Fault]] = {}
    with pool.open(len(drives)) as executor:
        for result in executor.run(_check_drive, drives):
            found[result.row] = [Fault("", str(result.error))] if result.error else result.value
            if progress is not None:
                progress(len(found), len(drives))
    faults = [*_manifest_faults(root), *(fault for row in range(len(drives)) for fault in found[row])]
    return list({str(fault): fault for fault in faults}.values())  # two checks may tell the same one


def _manifest_faults(root: Path) -> list[Fault]:
    """Compare a manifest with the drives' lists of checksums."""
    try:
        manifest = read_manifest(root)
    except DataError as error:
        return [Fault("", str(error))]
    if manifest is None:
        return []
    faults = [Fault(str(root / name), f"failed: {reason}") for name, reason in manifest.failed.items()]
    missing = manifest.drives - len(manifest.items) - len(manifest.failed)
    if missing > 0:
        faults.append(Fault(str(root / MANIFEST), f"{missing} of {manifest.drives} drives are not finished"))
    for entry in manifest.items:
        sums = root / entry.drive / CHECKSUMS
        if not (root / entry.drive).is_dir():
            faults.append(Fault(str(root / entry.drive), f"missing, {MANIFEST} lists it"))
        elif not sums.is_file():
            faults.append(Fault(str(sums), f"missing, {MANIFEST} has its checksum"))
        elif file_sha256(sums) != entry.sha256:
            faults.append(Fault(str(sums), f"differs from the checksum in {MANIFEST}"))
    return faults


def _check_drive(path: Path, report: Progress) -> list[Fault]:
    """Return the faults of one drive; a task."""
    faults = []
    if (path / CHECKSUMS).is_file():
        try:
            faults += [Fault(str(file), text) for file, text in faulty_files(path)]
        except DataError as error:
            faults.append(Fault("", str(error)))
    try:
        drive = open_drive(path)
    except DataError as error:
        return [*faults, Fault("", str(error)), *_files_of(path)]
    before: Frame | None = None
    for i in range(len(drive)):
        try:
            frame = drive.read(i)
        except DataError as error:
            faults += [Fault("", str(error)), *_files_of(path, f"{drive.frames[i]:06d}")]
            before = None
            continue
        faults += [Fault(where, text) for where, text in _frame_faults(drive, i, frame, before)]
        before = frame
    return faults


def _files_of(drive: Path, stem: str = "*") -> list[Fault]:
    """Return the faults of an OPV2V tree's files one by one: a reader stops at the first."""
    faults: list[Fault] = []
    files: list[Path] = []
    folders = [p for p in sorted(drive.glob("*")) if p.is_dir() and p.name.lstrip("-").isdecimal()]
    for folder in folders:
        files += [path for ending in (*CLOUDS, "yaml") for path in folder.glob(f"{stem}.{ending}")]
    stems = {path.stem for path in files if path.stem.isdecimal()}
    clouds = next((path.suffix[1:] for path in files if path.suffix != ".yaml"), CLOUDS[0])
    readers: dict[str, Callable[[Path], object]] = {"yaml": read_agent, "pcd": read_pcd, "compact": read_compact}
    for folder in folders:
        for name in sorted(stems):
            for ending in ("yaml", clouds):
                path = folder / f"{name}.{ending}"
                if not path.is_file():
                    faults.append(Fault(str(path), "file is missing"))
                    continue
                try:
                    readers[ending](path)
                except DataError as error:
                    faults.append(Fault("", str(error)))
    return faults


def _frame_faults(drive: Drive, i: int, frame: Frame, before: Frame | None) -> Iterator[tuple[str, str]]:
    """Yield (place, fault) of a readable frame."""
    truth, notes, own = frame.truth, _places(drive, i, "yaml"), own_settings(drive.protocol)
    for name, values in (("box", truth.array), ("velocity", np.nan_to_num(frame.velocity))):
        if not np.isfinite(values).all():
            yield notes[0], f"a {name} is not finite"
    flat = np.flatnonzero((truth.size <= 0.0).any(axis=1))
    if len(flat):
        yield notes[0], f"object {truth.object_id[flat[0]]} has a box without size"
    known, count = np.unique(truth.object_id, return_counts=True)
    if (count > 1).any():
        yield notes[0], f"object {known[count > 1][0]} is listed twice"
    for row, agent in enumerate(frame.agents):
        points = _places(drive, i, clouds_of(drive.drive, drive.protocol))[row]
        yield from ((points, text) for text in _sweep_faults(agent))
        if "format" in own and not own.get("corruptions") and (agent.sweep.object_id >= 0).any():
            yield from ((points, text) for text in _label_faults(frame, row))
        yield from ((notes[row], text) for text in _pose_faults(frame, before, row))


def _sweep_faults(agent: AgentFrame) -> Iterator[str]:
    sweep = agent.sweep
    bad = int((~np.isfinite(sweep.points).all(axis=1)).sum())
    if bad:
        yield f"{bad} of {len(sweep)} points are not finite"
    if not np.isfinite(sweep.intensity).all():
        yield "an intensity is not finite"
    if len(sweep) == 0:
        yield "no points at all"


def _label_faults(frame: Frame, row: int) -> Iterator[str]:
    sweep, truth = frame.agents[row].sweep, frame.truth
    labels = np.unique(sweep.object_id[sweep.object_id >= 0])
    # Objects far from every agent are not in the ground truth.
    counted = count_points(sweep, truth.object_id)
    differ = np.flatnonzero(counted != frame.points_on[row])
    if len(differ):
        i = differ[0]
        yield f"{counted[i]} points on object {truth.object_id[i]}, its label says {frame.points_on[row, i]}"
    homeless = labels[~np.isin(labels, truth.object_id)]
    for number in homeless:
        if float(np.linalg.norm(sweep.points[sweep.object_id == number], axis=1).min()) < 100.0:
            yield f"points of object {number}, which has no box"
            return


def _pose_faults(frame: Frame, before: Frame | None, row: int) -> Iterator[str]:
    agent = frame.agents[row]
    for name, pose in (("lidar", agent.sweep.world_from_lidar), ("body", agent.world_from_body)):
        if not np.isfinite(pose).all():
            yield f"the pose of the {name} is not finite"
            return
        if np.abs(pose[:3, :3].T @ pose[:3, :3] - np.eye(3)).max() > _RIGID or np.linalg.det(pose[:3, :3]) < 0.0:
            yield f"the pose of the {name} is no rotation"
            return
    apart = float(np.linalg.norm(agent.sweep.world_from_lidar[:3, 3] - agent.world_from_body[:3, 3]))
    if apart > _ON_BODY_M:
        yield f"the lidar is {apart:.0f} m from its body"
    if before is None or row >= len(before.agents) or before.agents[row].agent_id != agent.agent_id:
        return
    elapsed = frame.time_s - before.time_s
    moved = float(np.linalg.norm(agent.world_from_body[:3, 3] - before.agents[row].world_from_body[:3, 3]))
    if elapsed <= 0.0:
        yield f"{elapsed:g} s after the frame before it"
    elif moved > FASTEST_MPS * elapsed:
        yield f"{moved:.0f} m from where it was {elapsed:g} s before"


def _places(drive: Drive, i: int, ending: str) -> Sequence[str]:
    """Return the file of each agent; for other formats the drive and the number of the frame."""
    if drive.format in ("OPV2V", "V2V4Real") and drive.drive.is_dir():
        stem = f"{drive.frames[i]:06d}"
        return [str(drive.drive / str(agent) / f"{stem}.{ending}") for agent in drive.agents]
    return [f"{drive.drive}: frame {drive.frames[i]}, agent {agent}" for agent in drive.agents]
