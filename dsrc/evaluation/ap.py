"""Average precision over a set of frames, in bird's-eye view and in 3D."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dsrc.detections import Detections
from dsrc.evaluation.matching import match
from dsrc.ops.iou import bev_iou, volume_iou
from sim.boxes import Boxes

Space = Literal["bev", "3d"]
SPACES: tuple[Space, ...] = ("bev", "3d")
THRESHOLDS = (0.3, 0.5, 0.7)


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """Detections and ground truth of one frame, in one coordinate frame."""

    detections: Detections
    truth: Boxes


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """The result at one IoU threshold.

    Attributes:
        ap: average precision over all detections sorted by confidence; NaN without any ground truth.
        ap_opencood: the same over detections sorted inside their frame only, frames in their order, which is the
            default of OpenCOOD and what DSRC's tables hold.
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
    """The result of a set of frames.

    Attributes:
        frames: how many.
        truth: ground-truth boxes.
        detections: detected boxes.
        curves: by ("bev" or "3d", IoU threshold).
    """

    frames: int
    truth: int
    detections: int
    curves: dict[tuple[Space, float], Curve]

    def metrics(self) -> dict[str, float]:
        """Return the average precisions by name: `ap_bev_50` globally sorted, `ap_opencood_bev_50` per frame, ..."""
        named = {}
        for (space, threshold), curve in self.curves.items():
            named[metric_name(space, threshold)] = curve.ap
            named[metric_name(space, threshold, opencood=True)] = curve.ap_opencood
        return named


def metric_name(space: Space, threshold: float, *, opencood: bool = False) -> str:
    """Return the name of an average precision in tables and files."""
    return f"{'ap_opencood' if opencood else 'ap'}_{space}_{round(100 * threshold)}"


def evaluate(results: Sequence[FrameResult], thresholds: Sequence[float] = THRESHOLDS) -> EvalResult:
    """Return the average precisions of frames; changes nothing that it is given."""
    overlaps: dict[Space, list[NDArray[np.float64]]] = {"bev": [], "3d": []}
    for frame in results:
        found, truth = frame.detections.boxes.array, frame.truth.array
        footprint = bev_iou(found, truth)
        overlaps["bev"].append(footprint)
        overlaps["3d"].append(volume_iou(found, truth, footprint))
    scores = [frame.detections.score for frame in results]
    n_truth = sum(len(frame.truth) for frame in results)
    return EvalResult(
        frames=len(results),
        truth=n_truth,
        detections=sum(map(len, scores)),
        curves={
            (space, threshold): _curve(overlaps[space], scores, n_truth, threshold)
            for space in SPACES
            for threshold in thresholds
        },
    )


def _curve(
    overlaps: list[NDArray[np.float64]], scores: list[NDArray[np.float32]], n_truth: int, threshold: float
) -> Curve:
    """Match all frames at one threshold and rank the outcome in both orders."""
    matches = [match(iou, score, threshold) for iou, score in zip(overlaps, scores, strict=True)]
    hit = np.concatenate([m.hit for m in matches]) if matches else np.zeros(0, bool)
    ranked = [score[m.order] for m, score in zip(matches, scores, strict=True)]
    score = np.concatenate(ranked) if ranked else np.zeros(0, np.float32)
    order = np.argsort(-score, kind="stable")
    recall, precision = precision_recall(hit[order], n_truth)
    return Curve(
        ap=average_precision(recall, precision, n_truth),
        ap_opencood=average_precision(*precision_recall(hit, n_truth), n_truth),
        hits=int(hit.sum()),
        recall=recall,
        precision=precision,
        score=score[order],
    )


def precision_recall(hit: NDArray[np.bool_], n_truth: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (D,) recall and precision after each of D ranked detections."""
    hits = np.cumsum(hit)
    return hits / max(n_truth, 1), hits / np.arange(1, len(hit) + 1)


def envelope(
    recall: NDArray[np.float64], precision: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (D + 2,) recall from 0 to 1 and the precision made to fall monotonically, as VOC 2010 does."""
    recall = np.concatenate([[0.0], recall, [1.0]])
    precision = np.concatenate([[0.0], precision, [0.0]])
    return recall, np.maximum.accumulate(precision[::-1])[::-1]


def average_precision(recall: NDArray[np.float64], precision: NDArray[np.float64], n_truth: int) -> float:
    """Return the area under the envelope at every recall (VOC 2010); NaN where there was nothing to find."""
    if n_truth == 0:
        return float("nan")
    recall, precision = envelope(recall, precision)
    return float(np.sum(np.diff(recall) * precision[1:]))
