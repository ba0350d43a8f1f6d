"""Detections in any supported form, found by what is in the folder or the file.

* results of `dsrc evaluate` or `dsrc benchmark`, with the true boxes in the detector's range;
* a JSON file, see `BoxFile`;
* KITTI's label files with scores, 000123.txt in a folder, or in a folder for each drive;
* OpenCOOD's 0000_pred.npy and 0000_gt.npy, written by its `inference.py --save_npy`, with the true boxes.

OpenCOOD writes (n, 8, 3) corners of the detections and of the true boxes and no confidence. Its suppression leaves the
detections of a frame the best first, so that an average precision sorted in each frame is exact; one sorted over all
frames cannot be had from these files.
"""

import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from dsrc.data.formats.dair.tree import boxes_of
from dsrc.data.formats.kitti_labels import calibration_of, label_folder, list_labels, read_labels
from dsrc.data.jsonio import read_json
from dsrc.evaluation.results import CLEAN
from dsrc.evaluation.scoring.frames import DetectionSet, FrameKey, Truth
from dsrc.evaluation.stored import FILE, StoredDrive, StoredRun, has_index, read_index, read_run, run_names
from dsrc.ops.detections import Detections
from sim.boxes import Boxes, check_radians
from sim.errors import DataError, SettingsError, complaint, did_you_mean
from sim.reading import parsing, read_bytes

EVERY = "all"

_LARGEST = 1e7
"""Largest number of a box or a score: further out, overlaps have no digits left."""
_Number = Annotated[float, Meta(ge=-_LARGEST, le=_LARGEST)]
_Box = tuple[_Number, _Number, _Number, _Number, _Number, _Number, _Number]


class BoxFrame(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Detections of one frame in a JSON file.

    Attributes:
        frame: its number.
        boxes: x, y, z of the centre, length, width, height, m, yaw, rad, in the ego LiDAR's frame.
        score: confidence of each, as in `Detections`.
        drive: its drive; "" where the truth has one alone.
        ego: agent in whose LiDAR's frame the boxes are; None for the first vehicle.
        scores: former name of `score`.
    """

    frame: int
    boxes: tuple[_Box, ...]
    score: tuple[_Number, ...] | None = None
    drive: str = ""
    ego: int | None = None
    scores: tuple[_Number, ...] | None = None


class BoxFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """JSON file of detections, `{"frames": [{"drive": "one", "frame": 3, "boxes": [[...]], "score": [0.9]}]}`."""

    frames: tuple[BoxFrame, ...]


def read_detections(path: Path, truth: Path | None = None, corruption: str = CLEAN) -> list[DetectionSet]:
    """Read sets of detections.

    Args:
        path: file or folder in one of the forms above.
        truth: tree of the true boxes, whose calibration KITTI's labels need.
        corruption: of stored sets: `clean`, a kind, or `all`.

    Raises:
        DataError: nothing of a known form is there, or it is damaged; names file and field.
        SettingsError: no set is stored for the corruption.
    """
    if path.name == FILE or (path.is_dir() and has_index(path)):
        return _stored(path.parent if path.name == FILE else path, corruption)
    if path.is_file():
        if path.suffix in (".txt", ".npy"):
            raise DataError(complaint(path, "detections", "the folder of such files", "one of them"))
        return [_of_json(path)]
    if not path.is_dir():
        raise DataError(f"{path}: no such file or folder of detections")
    if any(path.glob("*_pred.npy")) or any(path.glob("*_gt*.npy")):
        return [_dumped(path)]
    folders = (
        {"": path} if list_labels(path) else {sub.name: sub for sub in sorted(path.glob("*/")) if list_labels(sub)}
    )
    if not folders:
        expected = f"{FILE}, a JSON file, label files (000123.txt) or OpenCOOD's 0000_pred.npy"
        raise DataError(complaint(path, "detections", expected, "none of them"))
    return [_labelled(path, folders, truth)]


def _stored(folder: Path, corruption: str) -> list[DetectionSet]:
    index = read_index(folder)
    kinds = sorted({run.kind for run in index.runs})
    runs = [(name, run) for name, run in zip(run_names(index.runs), index.runs, strict=True) if any(run.cells)]
    found = [_run(folder, index.drives, name, run) for name, run in runs if corruption in (run.kind, EVERY)]
    if not found:
        hint = did_you_mean(corruption, (*kinds, EVERY))
        raise SettingsError(complaint(folder / FILE, "corruption", "one that is stored", corruption, hint))
    return found


def _run(folder: Path, drives: Sequence[StoredDrive], name: str, run: StoredRun) -> DetectionSet:
    frames: dict[FrameKey, Detections] = {}
    truth: dict[FrameKey, Truth] = {}
    for drive, keys in zip(drives, run.cells, strict=True):
        table = read_run(folder, keys)
        for row, result in enumerate(table.results()):
            key = FrameKey(drive.name, int(table.index[row]), int(table.ego_id[row]))
            if key in frames:
                raise DataError(complaint(folder / FILE, "drives", "names that differ", f"{drive.name} again"))
            frames[key] = result.detections
            truth[key] = Truth.of(result.truth, result.truth.object_id == key.ego_id)
    title = name if run.kind == CLEAN else f"{name}, {run.condition.label}"
    low, high = run.range_m[:3], run.range_m[3:]
    spans = ", ".join(f"{axis} {a:g} to {b:g}" for axis, a, b in zip("xyz", low, high, strict=True))
    return DetectionSet(title, frames, truth, note=f"detections stored within {spans} m")


def _of_json(path: Path) -> DetectionSet:
    frames: dict[FrameKey, Detections] = {}
    listed = read_json(path, BoxFile).frames
    if not listed:
        raise DataError(complaint(path, "frames", "at least one", "none"))
    for row, one in enumerate(listed):
        where, key = f"frames[{row}]", FrameKey(one.drive, one.frame, one.ego)
        score = one.scores if one.score is None else one.score
        if score is None or len(score) != len(one.boxes):
            found = "none" if score is None else len(score)
            raise DataError(complaint(path, f"{where}.score", f"one for each of {len(one.boxes)} boxes", found))
        if key in frames:
            raise DataError(complaint(path, where, "each frame once", f"frame {one.frame} of {one.drive!r} again"))
        boxes = np.array(one.boxes, np.float64).reshape(-1, 7)
        if not (boxes[:, 3:6] > 0).all():
            raise DataError(complaint(path, f"{where}.boxes", "positive sizes", f"{boxes[:, 3:6].min():g} m"))
        check_radians(path, f"{where}.boxes", boxes[:, 6])
        frames[key] = Detections(Boxes.from_array(boxes), np.array(score, np.float32))
    return DetectionSet(path.stem, frames)


def _labelled(path: Path, folders: dict[str, Path], truth: Path | None) -> DetectionSet:
    calibrated = None if truth is None else label_folder(truth)
    frames, images = {}, {}
    for name, folder in folders.items():
        for number, file in list_labels(folder).items():
            found = read_labels(file, calibration_of(calibrated or folder, number), scored=True)
            frames[FrameKey(name, number)] = Detections(found.boxes, found.score)
            images[FrameKey(name, number)] = found.image
    # Detectors of LiDAR alone may leave the image's columns empty.
    known = any((image.height_px > 0).any() for image in images.values())
    return DetectionSet(path.name, frames, images=images if known else None)


def _dumped(folder: Path) -> DetectionSet:
    frames: dict[FrameKey, Detections] = {}
    truth: dict[FrameKey, Truth] = {}
    for path in sorted(folder.glob("*_gt*.npy")):
        number = re.fullmatch(r"(\d{1,9})_gt(_test)?", path.stem)
        if number is None:
            continue
        key, found = FrameKey("", int(number[1])), folder / f"{number[1]}_pred.npy"
        truth[key] = Truth.of(boxes_of(_corners(path)))
        boxes = boxes_of(_corners(found))
        frames[key] = Detections(boxes, np.linspace(1.0, 0.0, len(boxes), endpoint=False, dtype=np.float32))
    if not frames:
        raise DataError(complaint(folder, "0000_gt.npy", "true boxes beside 0000_pred.npy", "none"))
    note = "the files hold no scores: nothing can be sorted over all frames"
    return DetectionSet(folder.name, frames, truth, has_scores=False, note=note)


def _corners(path: Path) -> NDArray[np.float64]:
    """(n, 8, 3) corners of boxes in a .npy."""
    content = read_bytes(path, "array of corners")
    with parsing(path, "array of corners"):
        array = np.load(io.BytesIO(content), allow_pickle=False)
    if array.dtype.kind != "f" or array.ndim != 3 or array.shape[1:] != (8, 3):
        raise DataError(complaint(path, "array", "floats of shape (n, 8, 3)", f"{array.dtype} of {array.shape}"))
    if not (np.abs(array) <= _LARGEST).all():
        raise DataError(complaint(path, "array", f"numbers up to {_LARGEST:g}", "NaN or larger ones"))
    return array.astype(np.float64)
