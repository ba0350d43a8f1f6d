"""Convert drives of any format that is read into OPV2V, DAIR-V2X-C, KITTI or MCAP: the work behind `dsrc convert`.

Frames are made one by one, each whole or not at all; a run that was stopped goes on where it was when it is started
again with the same settings. A folder that holds something else is refused.
"""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol, get_args

import msgspec
import numpy as np

from dsrc.data.checksums import SUMS, write_sums
from dsrc.data.drive_folder import LOCK, is_complete, locked, remove_leftovers, write_protocol
from dsrc.data.drives import Drive, open_drives
from dsrc.data.formats.dair.write import DairWriter
from dsrc.data.formats.kitti import KittiWriter, View
from dsrc.data.formats.mcap import McapFile
from dsrc.data.formats.opv2v.reader import PROTOCOL, write_frame
from dsrc.data.jsonio import encode_json, read_json, write_atomic
from sensors.deskew import deskew_frame
from sensors.frame import Frame
from sim.errors import DataError, SettingsError, complaint, did_you_mean

Format = Literal["opv2v", "dair", "kitti", "mcap"]
FORMATS: tuple[Format, ...] = get_args(Format)
Progress = Callable[[int, int], None]
"""Called with (frames done, frames wanted)."""

MARK = "conversion.json"
_VERSION = 1
_SPLITS = {"train": "train", "validate": "val", "validation": "val", "val": "val", "test": "test"}
_EGO, _ALL = "ego", "all"


class Mark(msgspec.Struct, frozen=True):
    """What made a folder: `conversion.json`."""

    version: int
    to: str
    agent: str
    view: str
    drives: dict[str, str]
    finished: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """One frame of the work.

    Attributes:
        number: of the frame among all, in the order of the drives.
        drive: its drive.
        row: number of the drive.
        name: of the drive in the new tree; drives of a split are below its folder.
        i: position of the frame in the drive.
    """

    number: int
    drive: Drive
    row: int
    name: str
    i: int

    @property
    def split(self) -> str:
        """Set of the frame: train, val or test, by the folder of its drive; train where it is none of them."""
        return _split_of(self.drive.drive.parent.name) or "train"


def convert(
    data: Path,
    out: Path,
    to: Format,
    *,
    agent: str | None = None,
    view: View = "camera",
    progress: Progress | None = None,
) -> Path:
    """Write all drives at or below a folder in another format.

    Args:
        data: a drive or a folder of drives, of any format that is read.
        out: a new or empty folder, or one that an interrupted conversion has begun.
        to: `opv2v`, `dair`, `kitti` or `mcap`.
        agent: whose eyes: `ego` (the first vehicle), `all`, or the id of an agent. DAIR-V2X-C has one ego, its
            vehicle's side; KITTI a frame for each of them. None is the ego; OPV2V and MCAP always hold all.
        view: KITTI's labels: those in the nominal camera's picture, or all around.
        progress: called with frames done and frames in all.

    Returns:
        The folder.

    Raises:
        SettingsError: an unknown format, an option that the format does not have, or `out` is not apart from `data`.
        DataError: a drive cannot be read or has not what the format needs, or the folder holds something else.
    """
    if to not in FORMATS:
        raise SettingsError(complaint("convert", "to", "a format", to, did_you_mean(to, FORMATS)))
    _check_options(to, agent, view)
    data, out = Path(data), Path(out)
    if out.resolve().is_relative_to(data.resolve()) or data.resolve().is_relative_to(out.resolve()):
        raise SettingsError(complaint("convert", "out", f"a folder apart from {data}", str(out)))
    drives = open_drives(data)
    names = names_of([drive.drive for drive in drives])
    wanted = Mark(
        version=_VERSION,
        to=to,
        agent=agent or _EGO,
        view=view,
        drives={name: drive.digest() for name, drive in zip(names, drives, strict=True)},
    )
    frames = [(row, i) for row, drive in enumerate(drives) for i in range(len(drive))]
    places = [Place(number, drives[row], row, names[row], i) for number, (row, i) in enumerate(frames)]
    writer = _WRITERS[to](out, wanted, drives)
    report = progress or (lambda done, total: None)
    _check_folder(out, wanted)
    with locked(out):
        if _check_folder(out, wanted):
            report(len(places), len(places))
            return out
        write_atomic(out / MARK, encode_json(wanted))
        for done, place in enumerate(places):
            report(done, len(places))
            if not writer.done(place):
                writer.write(place, place.drive.read(place.i))
        writer.finish(places)
        remove_leftovers(out)
        write_atomic(out / MARK, encode_json(msgspec.structs.replace(wanted, finished=True)))
        report(len(places), len(places))
    return out


def names_of(drives: Sequence[Path]) -> list[str]:
    """Return names for drives that differ: a drive's own, after its folder's where that is a split or names repeat."""
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
    """Return the set that a folder's name stands for; OPV2V has a `test_culvercity` too."""
    return "test" if folder.startswith("test_") else _SPLITS.get(folder)


def _check_options(to: Format, agent: str | None, view: View) -> None:
    if agent is not None and to in ("opv2v", "mcap"):
        raise SettingsError(complaint("convert", "agent", f"none with --to {to}, which holds all agents", agent))
    if agent is not None and agent not in (_EGO, _ALL) and not agent.lstrip("-").isdecimal():
        raise SettingsError(complaint("convert", "agent", "ego, all or the id of an agent", agent))
    if agent == _ALL and to == "dair":
        raise SettingsError(complaint("convert", "agent", "ego or the id of a vehicle with --to dair", agent))
    if view not in get_args(View):
        raise SettingsError(complaint("convert", "view", "camera or around", view))
    if view != "camera" and to != "kitti":
        raise SettingsError(complaint("convert", "view", "camera, or --to kitti", view))


def _check_folder(out: Path, wanted: Mark) -> bool:
    """Return whether the work in a folder is finished; DataError when it is another."""
    if not out.is_dir():
        return False
    if not (out / MARK).exists():
        others = sorted(path.name for path in out.iterdir() if path.name != LOCK)
        if others:
            raise DataError(complaint(out, "folder", "a new or empty one", f"'{others[0]}' in it"))
        return False
    found = read_json(out / MARK, Mark)
    for field in ("version", "to", "agent", "view", "drives"):
        have, want = getattr(found, field), getattr(wanted, field)
        if have != want:
            shown = "other drives" if field == "drives" else have
            asked = "the drives asked for now" if field == "drives" else f"{want!r} as asked for now"
            raise DataError(complaint(out / MARK, field, asked, shown, "; choose another folder"))
    return found.finished


def _compensated(place: Place, frame: Frame) -> Frame:
    """Return a frame whose points are compensated: other tools know nothing of raw ones."""
    if all(agent.sweep.motion != "raw" for agent in frame.agents):
        return frame
    try:
        return deskew_frame(frame, "middle")
    except DataError as error:
        raise DataError(f"{place.drive.drive}: {error}") from None


class _Writer(Protocol):
    """Writes frames in one format."""

    def done(self, place: Place) -> bool:
        """Return whether the frame is there."""
        ...

    def write(self, place: Place, frame: Frame) -> None:
        """Write one frame; they come in order."""
        ...

    def finish(self, places: Sequence[Place]) -> None:
        """Write what is made of all frames."""
        ...


class _Opv2v:
    """Drives of ours: everything that a frame holds."""

    def __init__(self, out: Path, mark: Mark, drives: Sequence[Drive]) -> None:
        self.out, self.mark = out, mark

    def done(self, place: Place) -> bool:
        folder = self.out / place.name
        return (folder / PROTOCOL).exists() and is_complete(folder, place.drive.agents, place.drive.frames[place.i])

    def write(self, place: Place, frame: Frame) -> None:
        folder, own = self.out / place.name, place.drive.protocol.get("testbed")
        # The number in the file's name is what the source goes by.
        frame = replace(frame, index=place.drive.frames[place.i])
        if not (folder / PROTOCOL).exists():
            folder.mkdir(parents=True, exist_ok=True)
            write_protocol(folder, self._protocol(place, frame))
            for path in _beside(place.drive.drive) if isinstance(own, dict) else ():
                shutil.copyfile(path, folder / path.name)
        listed = own.get("connected_vehicles", True) if isinstance(own, dict) else True
        write_frame(folder, frame, bool(listed), place.drive.plans(place.i))

    def finish(self, places: Sequence[Place]) -> None:
        for name in {place.name for place in places}:
            remove_leftovers(self.out / name)
            write_sums(self.out / name)

    def _protocol(self, place: Place, frame: Frame) -> dict:
        if isinstance(place.drive.protocol.get("testbed"), dict):
            return place.drive.protocol
        agents = {
            int(agent.agent_id): {
                "kind": agent.kind,
                "lidar": None if agent.sweep.spec is None else msgspec.to_builtins(agent.sweep.spec),
            }
            for agent in frame.agents
        }
        source = {"format": place.drive.format, "drive": place.name, "sha256": self.mark.drives[place.name]}
        own = {"frames": len(place.drive), "agents": agents, "converted": source}
        return {**place.drive.protocol, "testbed": own}


def _beside(drive: Path) -> list[Path]:
    """Return what a drive of ours has beside its frames and its protocol, such as the log of its traffic."""
    files = (path for path in sorted(drive.iterdir()) if path.is_file() and not path.name.startswith("."))
    return [path for path in files if path.name not in (PROTOCOL, SUMS) and path.suffix not in (".tmp", ".part")]


class _Dair:
    """A tree of pairs."""

    def __init__(self, out: Path, mark: Mark, drives: Sequence[Drive]) -> None:
        self._writer = DairWriter(out, None if mark.agent == _EGO else int(mark.agent))

    def done(self, place: Place) -> bool:
        return self._writer.done(place.number)

    def write(self, place: Place, frame: Frame) -> None:
        try:
            self._writer.write(place.number, place.row, place.name, place.split, _compensated(place, frame))
        except DataError as error:
            raise DataError(f"{place.drive.drive}: {error}") from None

    def finish(self, places: Sequence[Place]) -> None:
        self._writer.finish([place.number for place in places])


class _Kitti:
    """A frame for every agent that is asked for."""

    def __init__(self, out: Path, mark: Mark, drives: Sequence[Drive]) -> None:
        self._writer = KittiWriter(out, mark.view)  # type: ignore[arg-type]
        self._agents = [_chosen(drive, mark.agent) for drive in drives]
        self._first = np.cumsum([0, *(len(drive) * len(a) for drive, a in zip(drives, self._agents, strict=True))])

    def _views(self, place: Place) -> list[tuple[int, int]]:
        """Return (number in the tree, agent) of the views of a frame."""
        agents = self._agents[place.row]
        first = int(self._first[place.row]) + place.i * len(agents)
        return [(first + k, agent) for k, agent in enumerate(agents)]

    def done(self, place: Place) -> bool:
        return all(self._writer.done(number, place.split) for number, _ in self._views(place))

    def write(self, place: Place, frame: Frame) -> None:
        frame = _compensated(place, frame)
        ids = [agent.agent_id for agent in frame.agents]
        for number, agent in self._views(place):
            self._writer.write(number, place.split, frame, ids.index(agent))

    def finish(self, places: Sequence[Place]) -> None:
        rows = []
        for place in places:
            index = place.drive.frames[place.i]
            rows += [(number, place.split, place.name, index, agent) for number, agent in self._views(place)]
        self._writer.finish(rows)


def _chosen(drive: Drive, agent: str) -> tuple[int, ...]:
    """Return the agents of a drive that are asked for; DataError when there is no such."""
    if agent == _ALL:
        return drive.agents
    if agent == _EGO:
        return drive.agents[:1]
    if int(agent) not in drive.agents:
        raise DataError(complaint(drive.drive, "agent", f"one of {list(drive.agents)}", int(agent)))
    return (int(agent),)


class _Mcap:
    """A file for every drive."""

    def __init__(self, out: Path, mark: Mark, drives: Sequence[Drive]) -> None:
        self.out = out
        self._open: McapFile | None = None

    def done(self, place: Place) -> bool:
        return self._file(place).exists()

    def write(self, place: Place, frame: Frame) -> None:
        if self._open is None:
            self._open = McapFile(self._file(place))
        self._open.write(_compensated(place, frame))
        if place.i + 1 == len(place.drive):
            self._open.close()
            self._open = None

    def finish(self, places: Sequence[Place]) -> None:
        pass

    def _file(self, place: Place) -> Path:
        return self.out / f"{place.name}.mcap"


_WRITERS: dict[Format, Callable[[Path, Mark, Sequence[Drive]], _Writer]] = {
    "opv2v": _Opv2v,
    "dair": _Dair,
    "kitti": _Kitti,
    "mcap": _Mcap,
}
