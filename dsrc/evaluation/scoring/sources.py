"""Scores by source: what a detector finds in a folder of drives of several data sets, each by itself and all together.

Of each source, the folder of its drives or else the drive: average precision, recall and false boxes a frame at a
score, and error of height. The ego's sensor alone is judged: a vehicle counts with a few of its points, near it, and
where the labels are complete. Vehicles that do not count and what the labels spare cost nothing: a detection that
overlaps one is neither right nor wrong.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dsrc.data.drives import find_drives
from dsrc.evaluation.metrics.ap import FrameResult, average_precision, match_frames, precision_recall, rank
from dsrc.evaluation.scoring.frames import DetectionSet, FrameKey, Truth
from dsrc.evaluation.scoring.read import read_detections
from dsrc.evaluation.scoring.truth import read_truth
from dsrc.ops.detections import Detections
from dsrc.ops.iou import bev_iou
from dsrc.runs.executors import Progress
from dsrc.tables.files import json_text
from dsrc.tables.table import Column, Stat, Table, TableRow
from sim.errors import DataError, complaint
from sim.files import write_file

REACH_M = (51.2, 25.6)
"""Greatest |x| and |y| of a detection's centre in the sensor's frame."""
FEWEST_POINTS = 5
SCORE = 0.2
"""Confidence from which recall and false boxes are counted."""
ALL = "all"

_BORDER_M = 0.5
"""True boxes this near to the border of the reach may be found beyond it: they do not count."""
_TOUCHES = 0.1
_MARGIN_PX = (15.0, 25.0)
"""Across and up around what the labels of a picture spare: it is drawn around what is seen of an object."""
_IOU, _STRICT_IOU = 0.5, 0.7


@dataclass(frozen=True, slots=True)
class SourceScore:
    """Scores of one source, overlaps in bird's-eye view.

    Attributes:
        source: its name; `ALL` for all of them.
        frames: number of frames.
        vehicles: true vehicles that count.
        ap: average precision by IoU threshold; NaN without vehicles.
        recall: share of the vehicles found with `SCORE` at IoU 0.5.
        false_per_frame: false boxes a frame with it.
        height_m: median of detected minus true height of the centres of found vehicles, m; NaN without any.
    """

    source: str
    frames: int
    vehicles: int
    ap: Mapping[float, float]
    recall: float
    false_per_frame: float
    height_m: float


def check_names(tree: Path) -> None:
    """Check that the drives of a folder differ by name, by which boxes are scored; DataError where they do not."""
    names = [path.name for path in find_drives(tree)]
    again = sorted({name for name in names if names.count(name) > 1})
    if again:
        hint = "; score one folder after the other"
        raise DataError(complaint(tree, "drives", "names that differ", f"{again[0]} twice", hint))


def score_sources(detections: Path, truth: Path, progress: Progress | None = None) -> list[SourceScore]:
    """Score detections in the labelled frames of drives, all together and by source.

    Args:
        detections: one set, see `dsrc.evaluation.scoring.read`.
        truth: drive or folder of drives with ground truth, in any supported format.
        progress: called with frames read and frames to read.

    Raises:
        DataError: there are several sets, one without scores, or no labelled frame.
    """
    sets = read_detections(detections, truth)
    if len(sets) != 1 or not sets[0].has_scores:
        found = f"{len(sets)} sets" if len(sets) != 1 else "boxes without scores"
        raise DataError(complaint(detections, "detections", "one set of boxes with scores", found))
    known = read_truth(truth, sets[0].frames, progress)
    if not known:
        raise DataError(complaint(truth, "truth", "frames with ground truth", "none"))
    groups = _grouped(sets[0], known, truth)
    together = _score(ALL, list(known), sets[0], known)
    return [together, *(_score(name, keys, sets[0], known) for name, keys in groups.items() if len(groups) > 1)]


def source_table(scores: Sequence[SourceScore]) -> Table:
    """Table of scores by source; shares in %."""
    columns = (
        *(Column("frames"), Column("vehicles")),
        *(Column(f"AP@{iou}", ("",), scale=100.0, digits=1) for iou in (_IOU, _STRICT_IOU)),
        Column(f"recall at {SCORE}", ("",), scale=100.0, digits=1),
        Column("false a frame", ("",), digits=1),
        Column("height, m", ("",), digits=2),
    )
    rows = [
        TableRow(
            one.source,
            (
                *(one.frames, one.vehicles),
                *((Stat(value),) for value in (*one.ap.values(), one.recall, one.false_per_frame, one.height_m)),
            ),
        )
        for one in scores
    ]
    near = " x ".join(f"\u00b1{reach:g}" for reach in REACH_M)
    caption = f"Vehicles with {FEWEST_POINTS} points in {near} m; AP and recall in %, BEV; false boxes at {SCORE}."
    return Table("sources", "Scores by source", "source", columns, tuple(rows), caption)


def write_sources(out: Path, scores: Sequence[SourceScore]) -> Path:
    """Write `sources.json`, a row for each source, shares of 1."""
    path = out / "sources.json"
    write_file(path, json_text({"rows": source_table(scores).records()}))
    return path


def _grouped(one: DetectionSet, known: Mapping[FrameKey, Truth], tree: Path) -> dict[str, list[FrameKey]]:
    """Return the frames of each source: the folder below the tree that holds a drive."""
    folders = {}
    for path in find_drives(tree):
        below = path.relative_to(tree).parts
        folders[path.name] = below[0] if below else path.name
    groups: dict[str, list[FrameKey]] = {}
    for key in one.frames:
        if key in known:
            groups.setdefault(folders.get(key.drive, key.drive), []).append(key)
    return groups


def _score(source: str, keys: Sequence[FrameKey], one: DetectionSet, known: Mapping[FrameKey, Truth]) -> SourceScore:
    results, spared = [], [np.zeros(0, bool)]
    for key in keys:
        result, free = _counted(one.frames[key], known[key])
        results.append(result)
        spared.append(free)
    matches = match_frames(results, (_IOU, _STRICT_IOU))
    vehicles, touches = matches.truth, np.concatenate(spared)
    ap = {}
    for iou in (_IOU, _STRICT_IOU):
        hit = matches.matched["bev", iou] >= 0
        asked = hit | ~touches
        ranked = hit[asked][rank(matches.score[asked], "global")]
        ap[iou] = average_precision(*precision_recall(ranked, vehicles), vehicles)
    matched = matches.matched["bev", _IOU]
    hit, sure = matched >= 0, matches.score >= SCORE
    height = np.concatenate([np.zeros(0), *(result.detections.boxes.center[:, 2] for result in results)])[hit]
    true = np.concatenate([np.zeros(0), *(result.truth.center[:, 2] for result in results)])[matched[hit]]
    return SourceScore(
        source=source,
        frames=len(keys),
        vehicles=vehicles,
        ap=ap,
        recall=float((hit & sure).sum()) / vehicles if vehicles else float("nan"),
        false_per_frame=float((~hit & ~touches & sure).sum()) / len(keys),
        height_m=float(np.median(height - true)) if hit.any() else float("nan"),
    )


def _counted(found: Detections, truth: Truth) -> tuple[FrameResult, NDArray[np.bool_]]:
    """Return the detections that are judged, the best first, with the vehicles that count, and which may be spared."""
    away = np.abs(truth.boxes.center[:, :2])
    counts = (away < np.array(REACH_M) - _BORDER_M).all(axis=1) & ~truth.own
    if truth.points is not None:
        counts &= truth.points >= FEWEST_POINTS
    near = (np.abs(found.boxes.center[:, :2]) < REACH_M).all(axis=1)
    if truth.region is not None:
        near &= truth.region.counts(found.boxes)
    order = np.flatnonzero(near)
    found = found[order[np.argsort(-found.score[order], kind="stable")]]
    left_out = np.concatenate([truth.boxes.array[~counts & ~truth.own], truth.others.array])
    spared = np.asarray((bev_iou(found.boxes.array, left_out) > _TOUCHES).any(axis=1))
    if truth.region is not None:
        spared |= ~truth.region.counts(found.boxes, _MARGIN_PX)
    return FrameResult(found, truth.boxes[counts]), spared
