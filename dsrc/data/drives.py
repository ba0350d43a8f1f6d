"""Drives in any supported format: found below a folder, opened by path, read as `Frame`.

| format      | a drive is                                              | its path                        |
|-------------|---------------------------------------------------------|---------------------------------|
| OPV2V       | a scenario folder; ours, OpenCDA's, V2XSet's            | the folder                      |
| V2V4Real    | a scenario folder whose `lidar_pose` are matrices       | the folder                      |
| DAIR-V2X-C  | a batch of pairs of a vehicle's and a roadside's frames | TREE/BATCH, see `dair.reader`   |
| sweeps      | of KITTI and other data sets, truth optional            | see `sweeps.reader`             |
"""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dsrc.data.clouds.files import ENDINGS
from dsrc.data.formats.dair import reader as dairv2x
from dsrc.data.formats.opv2v import reader as opv2v
from dsrc.data.sweeps import reader as sweeps
from sensors.frame import Frame
from sensors.sweep import Motion
from sim.errors import DataError, complaint

_log = logging.getLogger(__name__)


class Drive(Protocol):
    """Random access to the frames of a drive, whatever its format.

    Attributes:
        drive: its path; the last part is its name.
        format: name of the format, for people.
        agents: ids of the agents, in the order of `Frame.agents`.
        frames: numbers of the frames, ascending.
        protocol: content of `data_protocol.yaml`, empty without one.
    """

    format: str
    drive: Path
    agents: tuple[int, ...]
    frames: tuple[int, ...]
    protocol: dict

    def __len__(self) -> int: ...

    def read(self, i: int) -> Frame:
        """Read the i-th frame (a position in `frames`)."""
        ...

    def plans(self, i: int) -> dict[int, NDArray[np.float64]]:
        """Return per agent (K, 3) x, y, m, and speed, m/s, of its path after the i-th frame, if known."""
        ...

    def labelled(self, i: int) -> bool:
        """Return whether the i-th frame has ground truth, an empty one included."""
        ...

    def complete(self) -> bool:
        """Return whether labels are complete everywhere in all frames that have them; no cloud is read."""
        ...

    def digest(self) -> str:
        """Return a SHA-256 of annotations and of all clouds' names, sizes and changes; quick, for provenance."""
        ...


def list_drives(root: Path) -> list[Path]:
    """Return the paths of the drives at or below a folder, as `find_drives`; DataError if it holds none."""
    found = find_drives(root)
    if not found:
        expected = (
            "an OPV2V tree (drive/agent/000000.yaml), a DAIR-V2X-C one (cooperative/data_info.json), or"
            " sweeps: KITTI, nuScenes, Argoverse 2, OpenLABEL, bags, folders of scans (.bin, .pcd, .ply, .npy)"
        )
        raise DataError(complaint(root, "folder", expected, "none"))
    return found


def find_drives(root: Path) -> list[Path]:
    """Return the paths of the drives at or below a folder (itself, its children, theirs), sorted.

    A path in a DAIR-V2X-C tree, or of a drive in tables, need not exist: `TREE/val` gives the drives of that split.
    Drives of sweeps are looked for where there are no others.

    Raises:
        DataError: the folder is missing, or a file that is no scan.
    """
    root = Path(root)
    address = dairv2x.locate(root)
    if address is not None:
        return dairv2x.list_batches(address)
    if not root.is_dir() and (found := sweeps.sweeps_below(root)):
        return found
    if root.exists() and not root.is_dir():
        scans = f"a folder, or a scan *{', *'.join(ENDINGS)}"
        raise DataError(complaint(root, "data", scans, root.name))
    if not root.is_dir():
        raise DataError(f"{root}: no such folder")
    below = [folder for pattern in ("*/", "*/*/") for folder in sorted(root.glob(pattern)) if dairv2x.is_tree(folder)]
    found = [drive for tree in below for drive in list_drives(tree)]
    return (found + opv2v.drives_below(root)) or sweeps.sweeps_below(root)


def traffic_runs(drives: Sequence[Drive]) -> tuple[int, ...]:
    """Return for each drive the number, from 0, of the run of traffic that it shows.

    Drives of ours from one scenario and seed have the same road users, whichever sensors and however many agents
    record them; every other drive has a run of its own.
    """
    known: dict[object, int] = {}
    return tuple(known.setdefault(_traffic_run(drive), len(known)) for drive in drives)


def scenario_of(drive: Drive) -> str | None:
    """Return the name of the scenario of a drive of ours; None for any other."""
    try:
        return str(drive.protocol["testbed"]["scenario"]["name"])
    except (KeyError, TypeError):
        return None


def _traffic_run(drive: Drive) -> object:
    scenario, world = scenario_of(drive), drive.protocol.get("world")
    if scenario is None or not isinstance(world, dict) or "seed" not in world:
        return drive.drive
    return scenario, str(world["seed"])


def path_below(root: Path, drive: Path) -> Path:
    """Return the path of a drive below the folder that `find_drives` found it in; `.` where the folder is the drive."""
    address = dairv2x.locate(root)
    if address is None:
        return drive.relative_to(root) if drive.is_relative_to(root) else Path(drive.name)
    return Path() if address.batch is not None else drive.relative_to(address.folder)


def open_drive(path: Path, motion: Motion | None = None) -> Drive:
    """Open a drive by a path that `list_drives` gives.

    Args:
        motion: compensation of the sensors' motion in the frames; None for that of the files.

    Raises:
        DataError: the drive is missing or damaged.
        SettingsError: the motion is unknown.
    """
    if dairv2x.locate(Path(path)) is not None:
        return dairv2x.DairReader(path, motion)
    if (layout := sweeps.layout_of(Path(path))) is not None:
        return sweeps.SweepReader(path, motion, layout)
    return opv2v.DriveReader(path, motion)


def open_drives(root: Path | str, motion: Motion | None = None) -> list[Drive]:
    """Open all drives at or below a folder; see `list_drives` and `open_drive`."""
    return [open_drive(path, motion) for path in list_drives(Path(root))]


def labelled_frames(drive: Drive) -> list[int]:
    """Return the positions of the frames with ground truth."""
    return [i for i in range(len(drive.frames)) if drive.labelled(i)]


def label_notes(drive: Drive) -> dict:
    """Return the settings of an OPV2V drive that is made of a drive: frames without labels, labels of a part."""
    without = [frame for i, frame in enumerate(drive.frames) if not drive.labelled(i)]
    return ({"unlabelled": without} if without else {}) | ({} if drive.complete() else {"labels": "part"})


def warn_of_lost_labels(drives: Sequence[Drive], format_name: str) -> None:
    """Warn in one line of what a format does not say of labels: that a frame has none, or where they are complete."""
    without = sum(len(drive) - len(labelled_frames(drive)) for drive in drives)
    partial = sum(not drive.complete() for drive in drives)
    lost = [f"that {without} of {sum(map(len, drives))} frames have no ground truth"] if without else []
    lost += [f"where the labels of {partial} of {len(drives)} drives are complete"] if partial else []
    if lost:
        _log.warning("%s does not keep %s", format_name, ", nor ".join(lost))


def drive_hashes(drives: Sequence[Path]) -> dict[str, str]:
    """Return the hash of each drive by its name, or by its folder's too where drives share a name."""
    names = [drive.name for drive in drives]
    return {
        drive.name if names.count(drive.name) == 1 else f"{drive.parent.name}/{drive.name}": open_drive(drive).digest()
        for drive in drives
    }
