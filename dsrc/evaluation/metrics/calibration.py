"""Operating point and calibration of detections: the numbers by which one chooses a detector and its threshold."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dsrc.evaluation.metrics.ap import Curve, Matches, Space

BINS = 10
SURE = 0.3
"""Score from which on a detection is a sure one."""
IOU: tuple[Space, float] = ("bev", 0.5)
"""Overlap from which a detection counts here."""


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """Threshold of the score at which F1, the harmonic mean of precision and recall, is greatest.

    Attributes:
        score: threshold: detections of this score and more are kept; NaN without a hit, as the next three.
        f1: in [0, 1].
        precision: share of the kept detections that hit a true box.
        recall: share of the true boxes that are hit.
        false_boxes: kept detections that hit nothing.
    """

    score: float
    f1: float
    precision: float
    recall: float
    false_boxes: float


@dataclass(frozen=True, slots=True, eq=False)
class Reliability:
    """Reliability curve: mean score and precision of detections in bins of their score.

    Attributes:
        count: (B,) detections of each bin.
        score: (B,) their mean score; NaN in an empty bin.
        precision: (B,) share of them that hit a true box; NaN in an empty bin.
    """

    count: NDArray[np.int64]
    score: NDArray[np.float64]
    precision: NDArray[np.float64]

    @classmethod
    def joined(cls, parts: "Sequence[Reliability]") -> "Reliability":
        """Return the curve of the detections of all parts, at least one, whose bins are the same."""
        count = np.sum([part.count for part in parts], axis=0)
        filled, empty = np.where(count, count, 1), np.where(count, 0.0, math.nan)
        score, precision = (
            np.nansum([part.count * getattr(part, name) for part in parts], axis=0) / filled + empty
            for name in ("score", "precision")
        )
        return cls(count, score, precision)

    @property
    def right(self) -> float:
        """Share of all detections that hit a true box; NaN without detections."""
        return float(np.nansum(self.count * self.precision) / self.count.sum()) if self.count.any() else math.nan

    @property
    def error(self) -> float:
        """Expected calibration error, the mean gap of score and precision over detections; NaN without detections.

        M. P. Naeini et al., AAAI 2015; of detections, F. Küppers et al., CVPR workshops 2020, by the score alone.
        """
        if not self.count.any():
            return math.nan
        return float(np.nansum(self.count * np.abs(self.score - self.precision)) / self.count.sum())


def sure_counts(matches: Matches) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return (F,) true boxes that are found for sure, and detections that are as sure and wrong."""
    frame = np.repeat(np.arange(matches.frames), matches.detection_counts)
    right, sure = matches.matched[IOU] >= 0, matches.score >= SURE
    found, false = (np.bincount(frame[sure & one], minlength=matches.frames) for one in (right, ~right))
    return found, false


def sure_errors(matches: Matches) -> dict[str, float]:
    """Return the share of the true boxes that are not found for sure, and the false boxes of a frame."""
    found, false = sure_counts(matches)
    missed = 1.0 - float(found.sum()) / matches.truth if matches.truth else math.nan
    return {"missed_share": missed, "false_per_frame": float(false.sum()) / max(matches.frames, 1)}


def best_f1(curve: Curve) -> OperatingPoint:
    """Operating point of a curve; of equal ones that of the highest score.

    A threshold keeps all detections of its score: between equal scores there is no point.
    """
    last = np.append(curve.score[1:] != curve.score[:-1], True)[: len(curve.score)]
    kept = np.flatnonzero(last)
    recall, precision = curve.recall[kept], curve.precision[kept]
    if not len(kept) or not recall.any():
        return OperatingPoint(math.nan, math.nan, math.nan, math.nan, math.nan)
    f1 = 2.0 * precision * recall / np.maximum(precision + recall, 1e-300)
    best = int(np.argmax(f1))
    false_boxes = round((1.0 - precision[best]) * (kept[best] + 1))
    return OperatingPoint(
        float(curve.score[kept[best]]), float(f1[best]), float(precision[best]), float(recall[best]), float(false_boxes)
    )


def reliability(score: NDArray[np.floating], hit: NDArray[np.bool_], bins: int = BINS) -> Reliability:
    """Reliability curve of detections.

    Args:
        score: (D,) in [0, 1].
        hit: (D,) whether each hits a true box.
        bins: number of bins of equal width.
    """
    place = np.minimum((np.asarray(score, np.float64) * bins).astype(np.int64), bins - 1)
    count = np.bincount(place, minlength=bins)
    filled = np.where(count, count, 1)
    empty = np.where(count, 0.0, math.nan)
    mean = np.bincount(place, weights=score, minlength=bins) / filled + empty
    return Reliability(count, mean, np.bincount(place, weights=hit, minlength=bins) / filled + empty)


def first_sight_m(found: NDArray[np.bool_], objects: NDArray[np.integer], distance_m: NDArray[np.floating]) -> float:
    """Median over objects of the distance at which each is first found, m; 0 for one that never is, NaN without any.

    Args:
        found: (N,) whether each true box is found, in the order of time.
        objects: (N,) number of its object, from 0 on.
        distance_m: (N,) its distance from the ego.
    """
    first = np.zeros(objects.max(initial=-1) + 1)
    latest_first = np.flatnonzero(found)[::-1]  # of several the last one that is written stays
    first[objects[latest_first]] = distance_m[latest_first]
    return float(np.median(first)) if len(first) else math.nan


def choice_metrics(
    curve: Curve,
    matches: Matches,
    points: NDArray[np.integer],
    objects: NDArray[np.integer],
    distance_m: NDArray[np.floating],
) -> dict[str, float]:
    """Numbers of a detector at its best F1, and its calibration; boxes overlap from `IOU` on.

    Args:
        curve: of the matches at `IOU`.
        matches: of F frames.
        points: (N, 2 or more) points on each true box: the ego's, all agents'; -1 for unknown.
        objects: (N,) number of the object of each true box, from 0 on.
        distance_m: (N,) distance of each from the ego.

    Returns:
        `best_score`, `best_f1`, `best_precision`, `best_recall`, `false_boxes` a frame, `helped_recall`: of objects on
        which only others have points, NaN without any; `first_sight_m`; `ece`: see `Reliability.error`.
    """
    best, box = best_f1(curve), matches.matched[IOU]
    helped = (points[:, 0] == 0) & (points[:, 1] > 0)
    found = np.zeros(matches.truth, bool)
    found[box[(box >= 0) & (matches.score >= best.score)]] = True
    return {
        "best_score": best.score,
        "best_f1": best.f1,
        "best_precision": best.precision,
        "best_recall": best.recall,
        "false_boxes": best.false_boxes / max(matches.frames, 1),
        "helped_recall": float(found[helped].mean()) if helped.any() else math.nan,
        "first_sight_m": first_sight_m(found, objects, distance_m),
        "ece": reliability(matches.score, box >= 0).error,
    }
