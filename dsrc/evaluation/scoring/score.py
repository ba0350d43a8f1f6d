"""Average precision of any boxes under published protocols, `dsrc score`."""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dsrc.data.drives import drive_hashes, list_drives
from dsrc.data.formats.kitti_labels import InImage, label_folder
from dsrc.evaluation.metrics.ap import (
    THRESHOLDS,
    Matches,
    Space,
    average_precision,
    match_frames,
    precision_recall,
    rank,
)
from dsrc.evaluation.metrics.kitti import Level, Rated, RatedFrame
from dsrc.evaluation.metrics.protocols import Protocol, get_protocols
from dsrc.evaluation.results import CLEAN
from dsrc.evaluation.scoring.frames import DetectionSet, FrameKey, Truth, select
from dsrc.evaluation.scoring.read import read_detections
from dsrc.evaluation.scoring.truth import read_truth
from dsrc.ops.detections import Detections
from dsrc.options.detection import Scoring
from dsrc.runs.executors import Progress
from dsrc.runs.provenance import provenance
from sim.boxes import Boxes, check_radians
from sim.errors import DataError, SettingsError, complaint


@dataclass(frozen=True, slots=True)
class Score:
    """Average precisions of a set of detections under a protocol.

    Attributes:
        name: of the set.
        protocol: what is counted.
        frames: number of frames.
        truth: number of true boxes that count.
        detections: number of detections that count.
        ap: by overlap in "bev" or "3d" and IoU threshold; NaN without true boxes, and where scores are needed but
            unknown.
        note: what limits the set; "" for nothing.
    """

    name: str
    protocol: Protocol
    frames: int
    truth: int
    detections: int
    ap: Mapping[tuple[Space, float], float]
    note: str = ""


def score(
    detections: Path | str | Sequence[Detections],
    truth: Path | str | Sequence[Boxes] | None = None,
    protocol: str | Protocol | Sequence[str | Protocol] = "opencood",
    *,
    score_threshold: float | None = None,
    corruption: str = CLEAN,
    progress: Progress | None = None,
) -> list[Score]:
    """Score detections under published protocols.

    Args:
        detections: file or folder, see `dsrc.evaluation.scoring.read`; or those of each frame, in the LiDAR's frame.
        truth: tree of OPV2V, V2V4Real, DAIR-V2X-C or KITTI; or the true boxes of each frame, of which the one around
            the origin is the ego's own; None for those that are stored with the detections.
        protocol: name, several, `all`, or a `Protocol` of one's own.
        score_threshold: least score of the detections that count; None for all.
        corruption: of stored sets: `clean`, a kind, or `all`.
        progress: called with frames read and frames to read.

    Returns:
        Scores by set and protocol.

    Raises:
        UserError: a file, a frame or a setting is wrong.
    """
    get_protocols(protocol)  # before the files are read
    if score_threshold is not None and not math.isfinite(score_threshold):
        raise SettingsError(complaint("score", "score_threshold", "a number", score_threshold))
    tree = Path(truth) if isinstance(truth, str | Path) else None
    if isinstance(detections, str | Path):
        where = str(detections)
        sets = read_detections(Path(detections), tree, corruption)
    else:
        where = "detections"
        for i, given in enumerate(detections):
            check_radians(where, f"frame {i}", given.boxes.yaw)
        sets = [DetectionSet(where, {FrameKey("", i): found for i, found in enumerate(detections)})]
    if score_threshold is not None:
        sets = [_counting(one, score_threshold) for one in sets]
    known: Mapping[FrameKey, Truth] | None = None
    if tree is not None:
        known = read_truth(tree, dict.fromkeys(key for one in sets for key in one.frames), progress)
        if not any(len(one.boxes) for one in known.values()):
            raise DataError(complaint(tree, "truth", f"true boxes in the frames of {where}", "none"))
        labelled = known.keys()
        sets = [replace(one, frames={k: v for k, v in one.frames.items() if k in labelled}) for one in sets]
    elif truth is not None and not isinstance(truth, str | Path):
        for i, boxes in enumerate(truth):
            check_radians("truth", f"frame {i}", boxes.yaw)
        known = {FrameKey("", i): Truth.of(boxes) for i, boxes in enumerate(truth)}
        if any(known.keys() != one.frames.keys() for one in sets):
            found = f"{len(known)} of {len(sets[0].frames)}"
            raise DataError(complaint(where, "truth", "the true boxes of each frame", found))
    results: list[Score] = []
    for one in sets:
        own = one.truth if known is None else known
        if own is None:
            raise DataError(complaint(where, "truth", "a tree of true boxes, since none are stored here", "none"))
        one = _judged(one, own)
        if doubt := _doubt(one, own):
            one = replace(one, note=f"{one.note}; {doubt}" if one.note else doubt)
        rated = one.images is not None and all(truth.image is not None for truth in own.values())
        results += _scores(one, own, get_protocols(protocol, levels=rated))
    return results


def _counting(one: DetectionSet, least: float) -> DetectionSet:
    """Return a set without the detections below a score; what they suppressed is below it, too."""
    if not one.has_scores:
        raise SettingsError(complaint(one.name, "score_threshold", "none for boxes without scores", least))
    note = f"{one.note}; " if one.note else ""
    kept = {key: found.score >= least for key, found in one.frames.items()}
    frames = {key: found[kept[key]] for key, found in one.frames.items()}
    images = one.images and {
        key: InImage(*(values[kept[key]] for values in image)) for key, image in one.images.items()
    }
    return replace(one, frames=frames, images=images, note=f"{note}boxes from a score of {least:g} on")


def _judged(one: DetectionSet, truth: Mapping[FrameKey, Truth]) -> DetectionSet:
    """Return a set without the detections that lie out of the regions in which true boxes are known."""
    regions = {key: truth[key].region for key in one.frames if key in truth}
    if all(region is None for region in regions.values()):
        return one
    frames = {
        key: found if (region := regions.get(key)) is None else found[region.counts(found.boxes)]
        for key, found in one.frames.items()
    }
    return replace(one, frames=frames)


_NEAR_M, _LEAST_NEAR, _ENOUGH = 3.0, 0.05, 20


def _doubt(one: DetectionSet, truth: Mapping[FrameKey, Truth]) -> str:
    """Say that a set hardly touches the true boxes; "" where it does, or holds too little to tell.

    Data sets share names of drives and numbers of frames, so boxes of another one are scored without an error.
    """
    near = found = 0
    for key, detections in one.frames.items():
        if len(true := truth[key].boxes):
            ours, theirs = detections.boxes.center[:, None, :2], true.center[None, :, :2]
            near += int((np.linalg.norm(ours - theirs, axis=2) < _NEAR_M).any(axis=1).sum())
            found += len(detections.boxes)
    if found < _ENOUGH or near >= _LEAST_NEAR * found:
        return ""
    touching = f"{near} of {found} boxes lie within {_NEAR_M:g} m of a true one"
    return f"{touching}: they are of another data set or ego, or find next to nothing"


def _scores(one: DetectionSet, truth: Mapping[FrameKey, Truth], protocols: Iterable[Protocol]) -> Iterator[Score]:
    matches: dict[tuple[object, ...], Matches] = {}
    rated: Rated | None = None
    for protocol in protocols:
        if protocol.level is not None:
            rated = rated or Rated(list(_rated_frames(one, truth)))
            yield _score_of_level(one, protocol, protocol.level, rated)
            continue
        # Protocols that differ in order or recalls alone share their matches.
        counted = (protocol.range_m, protocol.corners, protocol.reach_m, protocol.ego, protocol.matched_by)
        if counted not in matches:
            frames = [select(protocol, found, truth[key]) for key, found in one.frames.items()]
            matches[counted] = match_frames(frames, THRESHOLDS, protocol.matched_by)
        yield _score(one, protocol, matches[counted])


def _score(one: DetectionSet, protocol: Protocol, matches: Matches) -> Score:
    known = one.has_scores or protocol.order == "frame"
    ap = {}
    for space in protocol.spaces:
        for threshold in THRESHOLDS:
            hit = matches.matched[space, threshold][rank(matches.score, protocol.order)] >= 0
            recall, precision = precision_recall(hit, matches.truth)
            found = average_precision(recall, precision, matches.truth, protocol.recalls)
            ap[space, threshold] = found if known else math.nan
    return Score(one.name, protocol, matches.frames, matches.truth, len(matches.score), ap, one.note)


def _rated_frames(one: DetectionSet, truth: Mapping[FrameKey, Truth]) -> Iterator[RatedFrame]:
    for key, found in one.frames.items():
        true = truth[key]
        if one.images is not None and true.image is not None:
            yield RatedFrame(found, one.images[key], true.judged(slice(None)), true.image)


def _score_of_level(one: DetectionSet, protocol: Protocol, level: Level, rated: Rated) -> Score:
    found = {(space, iou): rated.count(level, space, iou) for space in protocol.spaces for iou in THRESHOLDS}
    counted = next(iter(found.values()))
    ap = {key: value.ap(protocol.recalls) for key, value in found.items()}
    return Score(one.name, protocol, len(one.frames), counted.truth, counted.detections, ap, one.note)


def provenance_of(options: Scoring) -> dict[str, Any]:
    """Provenance of scores: settings, hashes of the drives, versions, machine and commit."""
    tree = options.truth
    drives = list_drives(tree) if tree is not None and label_folder(tree) is None else []
    settings = {name: getattr(options, name) for name in Scoring.__struct_fields__}
    return provenance(msgspec.to_builtins(settings, enc_hook=str), 0, drive_hashes(drives))
