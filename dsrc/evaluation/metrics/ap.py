"""Average precision over a set of frames, in bird's-eye view and in 3D."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dsrc.evaluation.metrics.matching import match_greedily
from dsrc.ops.detections import Detections
from dsrc.ops.iou import bev_iou, paired_volume_iou
from sim.boxes import Boxes

Space = Literal["bev", "3d"]
SPACES: tuple[Space, ...] = ("bev", "3d")
THRESHOLDS = (0.3, 0.5, 0.7)

Order = Literal["global", "frame"]
"""Order in which detections are counted: by confidence over all frames, or frame by frame and by confidence in each."""
Recalls = Literal["all", "all-but-first", "11", "40"]
"""Recalls at which the falling envelope of precision is taken: the area under all of it (VOC 2010), the area from the
recall of the first detection on (DAIR-V2X), its mean at 0, 0.1, ..., 1 (VOC 2007, KITTI until 2019) or at 1/40, ..., 1
(KITTI since; A. Simonelli et al., ICCV 2019, section 5)."""
MatchedBy = Literal["detections", "truth"]
"""Who chooses: detections, the best first, or true boxes, in their order, the free one that overlaps most."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """Detections and ground truth of one frame, in one coordinate frame."""

    detections: Detections
    truth: Boxes


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Matches of detections and true boxes in a set of F frames.

    Attributes:
        truth_counts: (F,) true boxes of each frame; boxes are numbered through all frames.
        detection_counts: (F,) detections of each frame.
        score: (D,) confidence, frame by frame, in each frame descending.
        matched: (D,) number of the true box that each detection hits, or -1, by ("bev" or "3d", IoU threshold).
    """

    truth_counts: NDArray[np.int64]
    detection_counts: NDArray[np.int64]
    score: NDArray[np.float32]
    matched: dict[tuple[Space, float], NDArray[np.int64]]

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.truth_counts)

    @property
    def truth(self) -> int:
        """Number of ground-truth boxes."""
        return int(self.truth_counts.sum())


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Precision-recall curve at one IoU threshold.

    Attributes:
        ap: average precision over all detections sorted by confidence; NaN without any ground truth.
        ap_opencood: the same in the order "frame", which is the default of OpenCOOD and what DSRC's tables hold, over
            the boxes that the frames have: by default those in the detector's range without the ego's own. With the
            setting `judged_by = "opencood"` of a detector they are those of the protocol `opencood`, and it is
            OpenCOOD's number; see `dsrc.evaluation.metrics.protocols`.
        hits: true positives.
        recall: (D,) after each detection, most confident first.
        precision: (D,) after each detection.
        score: (D,) confidence.
    """

    ap: float
    ap_opencood: float
    hits: int
    recall: NDArray[np.float64]
    precision: NDArray[np.float64]
    score: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class EvalResult:
    """Average precisions of a set of frames.

    Attributes:
        frames: number of frames.
        truth: number of ground-truth boxes.
        detections: number of detected boxes.
        curves: by ("bev" or "3d", IoU threshold).
    """

    frames: int
    truth: int
    detections: int
    curves: dict[tuple[Space, float], Curve]

    def metrics(self) -> dict[str, float]:
        """Average precisions by name: `ap_bev_50` globally sorted, `ap_opencood_bev_50` per frame, ..."""
        named = {}
        for (space, threshold), curve in self.curves.items():
            named[metric_name(space, threshold)] = curve.ap
            named[metric_name(space, threshold, opencood=True)] = curve.ap_opencood
        return named


def metric_name(space: Space, threshold: float, *, opencood: bool = False) -> str:
    """Name of an average precision in tables and files."""
    return f"{'ap_opencood' if opencood else 'ap'}_{space}_{round(100 * threshold)}"


class Pairs(NamedTuple):
    """Pairs of overlapping detections and true boxes: (K,) rows over all frames, and IoU."""

    detection: NDArray[np.int64]
    truth: NDArray[np.int64]
    iou: NDArray[np.float64]

    def ranked(self) -> "Pairs":
        """Pairs by detection, those of one by falling overlap."""
        order = np.lexsort((-self.iou, self.detection))
        return Pairs(self.detection[order], self.truth[order], self.iou[order])

    def matched(self, threshold: float, detections: int) -> NDArray[np.int64]:
        """(detections,) true box that each detection hits, or -1, for ranked pairs of detections, the first first."""
        near = self.iou >= threshold
        return match_greedily(self.detection[near], self.truth[near], detections)

    def swapped(self) -> "Pairs":
        """Pairs with the two sides in each other's place."""
        return Pairs(self.truth, self.detection, self.iou)


def overlapping_pairs(found: Sequence[NDArray[np.floating]], truth: Sequence[NDArray[np.floating]]) -> Pairs:
    """Pairs with overlapping footprints, frame by frame.

    Args:
        found: detections of each frame, (D, 7).
        truth: true boxes of each frame, (N, 7).
    """
    rows, columns, values = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0)]
    detections = boxes = 0
    for a, b in zip(found, truth, strict=True):
        iou = bev_iou(a, b)
        row, column = np.nonzero(iou)
        rows.append(row + detections)
        columns.append(column + boxes)
        values.append(iou[row, column])
        detections, boxes = detections + len(a), boxes + len(b)
    return Pairs(np.concatenate(rows), np.concatenate(columns), np.concatenate(values))


def evaluate(results: Sequence[FrameResult], thresholds: Sequence[float] = THRESHOLDS) -> EvalResult:
    """Average precisions of frames at positive IoU thresholds; the input stays unchanged."""
    return evaluate_matches(match_frames(results, thresholds))


def match_frames(
    results: Sequence[FrameResult], thresholds: Sequence[float] = THRESHOLDS, by: MatchedBy = "detections"
) -> Matches:
    """Match the detections of frames with their true boxes, at positive IoU thresholds."""
    found = [frame.detections.boxes.array for frame in results]
    truth = [frame.truth.array for frame in results]
    score = np.concatenate([np.zeros(0, np.float32), *(frame.detections.score for frame in results)])
    frame_of = np.repeat(np.arange(len(results)), [len(boxes) for boxes in found])
    # Frame by frame, in each the most confident first.
    ranked = np.lexsort((-score, frame_of))
    place = np.zeros(len(ranked), np.int64)
    place[ranked] = np.arange(len(ranked))
    pairs = overlapping_pairs(found, truth)
    a, b = _stacked(found)[pairs.detection], _stacked(truth)[pairs.truth]
    overlaps = {"bev": pairs.iou, "3d": paired_volume_iou(a, b, pairs.iou)}
    matched: dict[tuple[Space, float], NDArray[np.int64]] = {}
    for space in SPACES:
        ordered = Pairs(place[pairs.detection], pairs.truth, overlaps[space])
        ordered = ordered.ranked() if by == "detections" else ordered.swapped().ranked()
        for threshold in thresholds:
            if by == "detections":
                matched[space, threshold] = ordered.matched(threshold, len(score))
            else:
                chosen = ordered.matched(threshold, int(_lengths(truth).sum()))
                matched[space, threshold] = _inverse(chosen, len(score))
    return Matches(_lengths(truth), _lengths(found), score[ranked], matched)


def join_matches(parts: Sequence[Matches]) -> Matches:
    """Matches of the frames of all parts, at least one, in their order."""
    starts = np.cumsum([0, *(part.truth for part in parts)])
    matched = {
        key: np.concatenate(
            [np.where(p.matched[key] >= 0, p.matched[key] + n, -1) for p, n in zip(parts, starts[:-1], strict=True)]
        )
        for key in parts[0].matched
    }
    fields = ("truth_counts", "detection_counts", "score")
    truth_counts, detection_counts, score = (np.concatenate([getattr(p, name) for p in parts]) for name in fields)
    return Matches(truth_counts, detection_counts, score, matched)


def evaluate_matches(matches: Matches, among: NDArray[np.bool_] | None = None) -> EvalResult:
    """Average precisions of matched frames.

    Args:
        matches: of detections and true boxes.
        among: (N,) true boxes to count; detections of the others count neither way.
    """
    n_truth = matches.truth if among is None else int(among.sum())
    curves: dict[tuple[Space, float], Curve] = {}
    for key, box in matches.matched.items():
        asked = np.ones(len(box), bool) if among is None else (box < 0) | np.append(among, False)[box]
        curves[key] = curve_of(box[asked] >= 0, matches.score[asked], n_truth)
    return EvalResult(frames=matches.frames, truth=n_truth, detections=len(matches.score), curves=curves)


def _inverse(chosen: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """(count,) row of `chosen` that holds each number, or -1."""
    rows = np.flatnonzero(chosen >= 0)
    inverse = np.full(count, -1, np.int64)
    inverse[chosen[rows]] = rows
    return inverse


def _lengths(boxes: list[NDArray[np.float64]]) -> NDArray[np.int64]:
    return np.array([len(array) for array in boxes], np.int64)


def _stacked(boxes: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.concatenate([np.zeros((0, 7)), *boxes])


def curve_of(hit: NDArray[np.bool_], score: NDArray[np.float32], n_truth: int) -> Curve:
    """Curve of (D,) detections, given frame by frame, with the average precision of both orders.

    Args:
        hit: true positives.
    """
    rows = rank(score, "global")
    recall, precision = precision_recall(hit[rows], n_truth)
    return Curve(
        ap=average_precision(recall, precision, n_truth),
        ap_opencood=average_precision(*precision_recall(hit[rank(score, "frame")], n_truth), n_truth),
        hits=int(hit.sum()),
        recall=recall,
        precision=precision,
        score=score[rows],
    )


def rank(score: NDArray[np.float32], order: Order) -> NDArray[np.int64]:
    """(D,) rows of detections, given frame by frame and in each the best first, in the order they are counted."""
    return np.argsort(-score, kind="stable") if order == "global" else np.arange(len(score))


def precision_recall(hit: NDArray[np.bool_], n_truth: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(D,) recall and precision after each of D ranked detections."""
    hits = np.cumsum(hit)
    return hits / max(n_truth, 1), hits / np.arange(1, len(hit) + 1)


def envelope(
    recall: NDArray[np.float64], precision: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(D + 2,) recall from 0 to 1 and monotonically falling precision, as in VOC 2010."""
    recall = np.concatenate([[0.0], recall, [1.0]])
    precision = np.concatenate([[0.0], precision, [0.0]])
    return recall, np.maximum.accumulate(precision[::-1])[::-1]


def average_precision(
    recall: NDArray[np.float64], precision: NDArray[np.float64], n_truth: int, recalls: Recalls = "all"
) -> float:
    """Average precision: that of the envelope at the given recalls; NaN without ground truth."""
    if n_truth == 0:
        return float("nan")
    recall, precision = envelope(recall, precision)
    if recalls in ("11", "40"):
        # Quotients, as recalls are: equal fractions are equal numbers.
        at = np.arange(11) / 10 if recalls == "11" else np.arange(1, 41) / 40
        return float(precision[np.searchsorted(recall, at)].mean())
    steps = np.diff(recall) * precision[1:]
    return float(steps[1:].sum() if recalls == "all-but-first" else steps.sum())
