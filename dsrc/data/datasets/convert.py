"""Conversion of drives, any supported format, to OPV2V, with PCD or compact clouds, DAIR-V2X-C, KITTI, MCAP or OSI.

A drive is a work item, written frame by frame, each file completely or not at all; an interrupted run resumes. A folder
that holds something else is refused.
"""

import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import msgspec

from dsrc.data.checksums import CHECKSUMS, write_checksums
from dsrc.data.drive_folder import is_complete, write_protocol
from dsrc.data.drives import Drive, label_notes, open_drive, open_drives, warn_of_lost_labels
from dsrc.data.formats.dair.write import DairWriter
from dsrc.data.formats.kitti import KittiWriter, LabelView
from dsrc.data.formats.mcap.file import MessageFile
from dsrc.data.formats.mcap.foxglove import McapFile
from dsrc.data.formats.mcap.ros2 import Ros2File
from dsrc.data.formats.opv2v.reader import (
    PROTOCOL,
    Clouds,
    agent_table,
    lists_connected_vehicles,
    own_settings,
    with_clouds,
    write_frame,
)
from dsrc.data.formats.osi.traces import OsiTraces
from dsrc.data.jsonio import encode_json, read_json
from dsrc.data.sweeps.nuscenes_writer import NuScenesWriter
from dsrc.options.drives import ConvertOptions
from dsrc.options.fields import takes_fields
from dsrc.runs.executors import SERIAL, Pool, Progress
from dsrc.runs.jobs import run_jobs
from dsrc.runs.lock import LOCK, locked
from dsrc.runs.series import check_same
from sensors.deskew import deskew_frame
from sensors.frame import Frame
from sim.errors import DataError, SettingsError, complaint, did_you_mean
from sim.files import remove_leftovers, replacing, write_file

Format = Literal["opv2v", "compact", "dair", "kitti", "mcap", "ros2", "nuscenes", "osi", "osi-mcap"]
FORMATS: tuple[Format, ...] = get_args(Format)

CONVERSION = "conversion.json"
_VERSION = 2
_SPLITS = {"train": "train", "validate": "val", "validation": "val", "val": "val", "test": "test"}
_EGO, _ALL = "ego", "all"


class Conversion(msgspec.Struct, frozen=True):
    """Settings of a conversion: `conversion.json`, with the number of files of a finished one, 0 for unknown."""

    version: int
    to: Format
    agent: str
    view: LabelView
    drives: dict[str, str]
    finished: bool = False
    files: int = 0


@dataclass(frozen=True, slots=True)
class Source:
    """Drive to convert.

    Attributes:
        name: in the new tree; drives of a split are below its folder.
        frames: their numbers in the drive.
        first: number of its first frame in the new tree, where it has numbers.
    """

    path: Path
    row: int
    name: str
    frames: tuple[int, ...]
    agents: tuple[int, ...]
    first: int

    @property
    def split(self) -> str:
        """Set of the drive, train, val or test, by its folder; train for any other folder."""
        return _split_of(self.path.parent.name) or "train"


@dataclass(frozen=True, slots=True)
class ConvertJob:
    """Drive to write in another format; `anew` also the frames that are there."""

    out: Path
    mark: Conversion
    source: Source
    anew: bool


@takes_fields(ConvertOptions)
def convert(options: ConvertOptions, pool: Pool = SERIAL, progress: Progress | None = None) -> Path:
    """Write the drives at or below a folder in another format; an interrupted run resumes.

    DAIR-V2X-C has one ego, its vehicle's side, and KITTI a frame for each chosen agent; OPV2V, compact or not, MCAP
    and OSI hold all agents.

    Args:
        options: drives, folder, format and what is written, see `ConvertOptions`; or these as arguments.
        progress: called with (frames done, frames in all).

    Returns:
        The folder.

    Raises:
        SettingsError: an unknown format, an option that the format does not have, or `out` is not apart from `data`.
        DataError: a drive cannot be read or lacks what the format needs, or the folder holds something else.
    """
    _check_options(options)
    data, out = Path(options.data).resolve(), Path(options.out)  # `.` and `..` have no name
    if out.resolve().is_relative_to(data) or data.is_relative_to(out.resolve()):
        raise SettingsError(complaint("convert", "out", f"a folder apart from {data}", str(out)))
    drives = open_drives(data)
    names = names_of([drive.drive for drive in drives])
    wanted = Conversion(
        version=_VERSION,
        to=options.to,
        agent=options.agent_id or _EGO,
        view=options.view,
        drives={name: drive.digest() for name, drive in zip(names, drives, strict=True)},
    )
    writer = _WRITERS[wanted.to](out, wanted)
    sources: list[Source] = []
    first = 0
    for row, (name, drive) in enumerate(zip(names, drives, strict=True)):
        sources.append(Source(drive.drive.resolve(), row, name, drive.frames, drive.agents, first))
        first += len(drive) * writer.views(sources[-1])
    frames = list(map(len, drives))
    _check_folder(out, wanted)
    with locked(out):
        state = _check_folder(out, wanted)
        if state != "finished":
            if wanted.to not in ("opv2v", "compact"):
                warn_of_lost_labels(drives, f"--to {wanted.to}")
            write_file(out / CONVERSION, encode_json(wanted))
            jobs = [ConvertJob(out.resolve(), wanted, source, state == "lacking") for source in sources]
            run_jobs(_convert, jobs, pool, progress, frames)
            writer.finish(sources)
            remove_leftovers(out)
            ended = msgspec.structs.replace(wanted, finished=True, files=_files(out))
            write_file(out / CONVERSION, encode_json(ended))
    if progress is not None:
        progress(sum(frames), sum(frames))
    return out


def _convert(job: ConvertJob, progress: Progress) -> None:
    """Write one drive; a task."""
    writer, drive = _WRITERS[job.mark.to](job.out, job.mark), open_drive(job.source.path)
    for i in range(len(drive)):
        progress(i, len(drive))
        if job.anew or not writer.done(job.source, i):
            writer.write(job.source, i, drive, drive.read(i))
    progress(len(drive), len(drive))


def names_of(drives: Sequence[Path]) -> list[str]:
    """Return different names of drives: a drive's own, after its folder's where that is a split or names repeat."""
    own = [drive.name for drive in drives]
    names = [
        f"{drive.parent.name}/{drive.name}" if own.count(drive.name) > 1 or _split_of(drive.parent.name) else drive.name
        for drive in drives
    ]
    again = sorted({name for name in names if names.count(name) > 1})
    if again:
        raise DataError(
            complaint(drives[0].parent, "drives", "names that differ", again[0], "; convert them one by one")
        )
    return names


def _split_of(folder: str) -> str | None:
    """Return the set of a folder by its name; OPV2V has a `test_culvercity` too."""
    return "test" if folder.startswith("test_") else _SPLITS.get(folder)


def _check_options(options: ConvertOptions) -> None:
    to, agent, view = options.to, options.agent_id, options.view
    if to not in FORMATS:
        raise SettingsError(complaint("convert", "to", "a format", to, did_you_mean(to, FORMATS)))
    if agent is not None and to not in ("dair", "kitti", "nuscenes"):
        raise SettingsError(f"convert: --to {to} holds all agents; leave out --agent-id")
    if agent is not None and agent not in (_EGO, _ALL) and not re.fullmatch(r"-?\d{1,10}", agent):
        raise SettingsError(complaint("convert", "agent_id", "ego, all or the id of an agent", agent))
    if agent == _ALL and to == "dair":
        raise SettingsError(complaint("convert", "agent_id", "ego or the id of a vehicle with --to dair", agent))
    if view not in get_args(LabelView):
        raise SettingsError(complaint("convert", "view", "camera or around", view))
    if view != "camera" and to != "kitti":
        raise SettingsError("convert: --view is of KITTI's labels; add --to kitti")


def _check_folder(out: Path, wanted: Conversion) -> Literal["begun", "finished", "lacking"]:
    """Return how far the conversion in a folder is, `lacking` where it has lost files; DataError for another one."""
    if not out.is_dir():
        return "begun"
    if not (out / CONVERSION).exists():
        others = sorted(path.name for path in out.iterdir() if path.name != LOCK)
        if others:
            raise DataError(complaint(out, "folder", "a new or empty one", f"'{others[0]}' in it"))
        return "begun"
    found = read_json(out / CONVERSION, Conversion)
    as_begun = msgspec.structs.replace(found, finished=False, files=0, drives=wanted.drives)
    check_same(out / CONVERSION, msgspec.to_builtins(as_begun), msgspec.to_builtins(wanted))
    if found.drives != wanted.drives:
        hint = "; choose another folder"
        raise DataError(complaint(out / CONVERSION, "drives", "the drives asked for now", "other drives", hint))
    if not found.finished:
        return "begun"
    return "lacking" if _files(out) < found.files else "finished"


def _files(out: Path) -> int:
    """Return the number of files in a folder, the conversion's own record and lock left out."""
    return sum(path.is_file() and path.name not in (CONVERSION, LOCK) for path in out.rglob("*"))


def _compensated(source: Source, frame: Frame) -> Frame:
    """Return a frame with compensated points: other formats have no raw ones."""
    if all(agent.sweep.motion != "raw" for agent in frame.agents):
        return frame
    try:
        return deskew_frame(frame, "middle")
    except DataError as error:
        raise DataError(f"{source.path}: {error}") from None


class _Writer:
    """Writer of drives in one format, frame by frame in order."""

    def __init__(self, out: Path, mark: Conversion) -> None:
        self.out, self.mark = out, mark

    def views(self, source: Source) -> int:
        """Return the frames in the new tree for one of the drive."""
        return 1

    def done(self, source: Source, i: int) -> bool:
        """Return whether the drive's i-th frame is there."""
        raise NotImplementedError

    def write(self, source: Source, i: int, drive: Drive, frame: Frame) -> None:
        """Write the drive's i-th frame."""
        raise NotImplementedError

    def finish(self, sources: Sequence[Source]) -> None:
        """Write the indices of all drives."""


class _Opv2v(_Writer):
    """Drives of ours: everything that a frame holds."""

    clouds: Clouds = "pcd"

    def done(self, source: Source, i: int) -> bool:
        folder = self.out / source.name
        return (folder / PROTOCOL).exists() and is_complete(folder, source.agents, source.frames[i], self.clouds)

    def write(self, source: Source, i: int, drive: Drive, frame: Frame) -> None:
        folder = self.out / source.name
        # Frames keep the numbers of the source's files.
        frame = replace(frame, index=drive.frames[i])
        if not (folder / PROTOCOL).exists():
            for path in _beside(drive.drive) if own_settings(drive.protocol) else ():
                with replacing(folder / path.name) as temporary:
                    shutil.copyfile(path, temporary)
            protocol = drive.protocol
            if not own_settings(protocol):
                converted = {"format": drive.format, "drive": source.name, "sha256": self.mark.drives[source.name]}
                own = {"frames": len(drive), "agents": agent_table(frame), "converted": converted, **label_notes(drive)}
                protocol = {**protocol, "testbed": own}
            write_protocol(folder, {**protocol, "testbed": with_clouds(own_settings(protocol), self.clouds)})
        write_frame(folder, frame, lists_connected_vehicles(drive.protocol), drive.plans(i), clouds=self.clouds)

    def finish(self, sources: Sequence[Source]) -> None:
        for source in sources:
            remove_leftovers(self.out / source.name)
            write_checksums(self.out / source.name)


def _beside(drive: Path) -> list[Path]:
    """Return the files of a drive beside its frames and its protocol, such as the traffic log."""
    files = (path for path in sorted(drive.iterdir()) if path.is_file() and not path.name.startswith("."))
    return [path for path in files if path.name not in (PROTOCOL, CHECKSUMS)]


class _Compact(_Opv2v):
    """Drives of ours with compact clouds."""

    clouds = "compact"


class _Dair(_Writer):
    """Tree of pairs."""

    def __init__(self, out: Path, mark: Conversion) -> None:
        self._writer = DairWriter(out, None if mark.agent == _EGO else int(mark.agent))

    def done(self, source: Source, i: int) -> bool:
        return self._writer.done(source.first + i)

    def write(self, source: Source, i: int, drive: Drive, frame: Frame) -> None:
        try:
            self._writer.write(source.first + i, source.row, source.name, source.split, _compensated(source, frame))
        except DataError as error:
            raise DataError(f"{source.path}: {error}") from None

    def finish(self, sources: Sequence[Source]) -> None:
        self._writer.finish(range(sources[-1].first + len(sources[-1].frames)))


class _Kitti(_Writer):
    """Frame for each chosen agent."""

    def __init__(self, out: Path, mark: Conversion) -> None:
        self._writer, self._agent = KittiWriter(out, mark.view), mark.agent

    def views(self, source: Source) -> int:
        return len(_chosen(source, self._agent))

    def _views(self, source: Source, i: int) -> list[tuple[int, int]]:
        """Return (number in the tree, agent) of the views of a frame."""
        agents = _chosen(source, self._agent)
        return [(source.first + i * len(agents) + k, agent) for k, agent in enumerate(agents)]

    def done(self, source: Source, i: int) -> bool:
        return all(self._writer.done(number) for number, _ in self._views(source, i))

    def write(self, source: Source, i: int, drive: Drive, frame: Frame) -> None:
        frame = _compensated(source, frame)
        ids = [agent.agent_id for agent in frame.agents]
        for number, agent in self._views(source, i):
            self._writer.write(number, frame, ids.index(agent))

    def finish(self, sources: Sequence[Source]) -> None:
        self._writer.finish(
            [
                (number, source.split, source.name, index, agent)
                for source in sources
                for i, index in enumerate(source.frames)
                for number, agent in self._views(source, i)
            ]
        )


def _chosen(source: Source, agent: str) -> tuple[int, ...]:
    """Return the chosen agents of a drive; DataError for an unknown one."""
    if agent == _ALL:
        return source.agents
    if agent == _EGO:
        return source.agents[:1]
    if int(agent) not in source.agents:
        raise DataError(complaint(source.path, "agent", f"one of {list(source.agents)}", int(agent)))
    return (int(agent),)


class _Recording(_Writer):
    """Recording for each drive, which is there when it is complete."""

    _open: MessageFile | OsiTraces | None = None
    _ending = ".mcap"

    def done(self, source: Source, i: int) -> bool:
        return self._path(source).is_file()

    def write(self, source: Source, i: int, drive: Drive, frame: Frame) -> None:
        if self._open is None:
            self._open = self._make(self._path(source), len(drive))
        self._open.write(_compensated(source, frame))
        if i + 1 == len(drive):
            self._open.close()
            self._open = None

    def _make(self, path: Path, frames: int) -> MessageFile | OsiTraces:
        raise NotImplementedError

    def _path(self, source: Source) -> Path:
        return self.out / f"{source.name}{self._ending}"


class _Mcap(_Recording):
    """MCAP of Foxglove's messages for each drive."""

    def _make(self, path: Path, frames: int) -> MessageFile:
        return McapFile(path)


class _Ros2(_Recording):
    """MCAP of ROS 2 messages for each drive."""

    def _make(self, path: Path, frames: int) -> MessageFile:
        return Ros2File(path)


class _OsiMcap(_Recording):
    """MCAP of OSI for each drive."""

    def _make(self, path: Path, frames: int) -> OsiTraces:
        return OsiTraces(path, frames)


class _Osi(_OsiMcap):
    """Folder of binary traces for each drive."""

    _ending = ""

    def done(self, source: Source, i: int) -> bool:
        return any(self._path(source).glob("*_gt_*.osi"))  # the ground truth is the last file to appear


class _NuScenes(_Writer):
    """Scene for each drive and chosen agent."""

    def __init__(self, out: Path, mark: Conversion) -> None:
        self._writer, self._agent = NuScenesWriter(out), mark.agent

    def _scenes(self, source: Source) -> dict[str, int]:
        """Return the names of the scenes of a drive and their agents."""
        agents = _chosen(source, self._agent)
        return {source.name if len(agents) == 1 else f"{source.name}-{agent}": agent for agent in agents}

    def done(self, source: Source, i: int) -> bool:
        return all(self._writer.done(scene, i) for scene in self._scenes(source))

    def write(self, source: Source, i: int, drive: Drive, frame: Frame) -> None:
        frame = _compensated(source, frame)
        ids = [agent.agent_id for agent in frame.agents]
        for scene, agent in self._scenes(source).items():
            self._writer.write(scene, i, frame, ids.index(agent))

    def finish(self, sources: Sequence[Source]) -> None:
        self._writer.finish({scene: len(source.frames) for source in sources for scene in self._scenes(source)})


_WRITERS: dict[Format, Callable[[Path, Conversion], _Writer]] = {
    "opv2v": _Opv2v,
    "compact": _Compact,
    "dair": _Dair,
    "kitti": _Kitti,
    "mcap": _Mcap,
    "ros2": _Ros2,
    "nuscenes": _NuScenes,
    "osi": _Osi,
    "osi-mcap": _OsiMcap,
}
