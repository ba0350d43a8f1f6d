"""Intervals of differences in average precision: the paired bootstrap over frames and over drives.

The frames of a benchmark are a sample. A resample draws as many frames, or as many drives with all their frames, as
there are, with replacement: frame f is in it w_f times. Its average precision is computed anew, from the detections k
of all frames in the order of falling confidence, in frame f(k), hit (h_k = 1) or not (0), and from N_f true boxes:

    TP_k = sum over j <= k of w_f(j) h_j        n_k = sum over j <= k of w_f(j)
    AP = sum over k of w_f(k) h_k (max over j >= k of TP_j / n_j) / sum over f of w_f N_f

This is the area under the envelope of `dsrc.evaluation.ap`, of each frame copied w_f times; only hits need be looked
at, for precision falls from one to the next. The interval of a difference holds the middle 95 % of its values over the
resamples (the percentile interval), and both methods are evaluated on the same resamples.

Source: B. Efron, Bootstrap methods: another look at the jackknife, Annals of Statistics 7 (1979), 1-26; B. Efron and
R. J. Tibshirani, An Introduction to the Bootstrap (1993), chapter 13.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dsrc.evaluation.ap import Judged
from dsrc.evaluation.report.table import Stat

RESAMPLES = 1000
LEVEL = 0.95
IOUS = (0.5, 0.7)
"""Bird's-eye IoU thresholds of the differences."""


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """Ranked detections of F frames.

    Attributes:
        frame: (D,) number of each detection's frame, the most confident detection of all frames first.
        hit: (T, D) true positives at each of T IoU thresholds.
        truths: (F,) ground-truth boxes of each frame.
    """

    frame: NDArray[np.int32]
    hit: NDArray[np.bool_]
    truths: NDArray[np.int64]

    @classmethod
    def of(cls, judged: Judged, ious: Sequence[float] = IOUS) -> "Hits":
        """Return the detections that were judged, in bird's-eye view; ties stay in the order of the frames."""
        order = np.argsort(-judged.score, kind="stable")
        frame = np.repeat(np.arange(judged.frames, dtype=np.int32), judged.found)
        hit = np.stack([judged.matched["bev", iou] >= 0 for iou in ious])
        return cls(frame[order], hit[:, order], judged.truths)


class Interval(NamedTuple):
    """Bounds of an interval; NaN where it is unknown."""

    low: float
    high: float

    @property
    def excludes_zero(self) -> bool:
        """Whether 0 lies outside; an unknown interval excludes nothing."""
        return self.low > 0.0 or self.high < 0.0


def draw_weights(group: NDArray[np.int64], count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return (count, F) how often each frame is in each resample.

    Args:
        group: (F,) number of what is drawn as a whole, from 0: each frame's own number, or that of its drive.
        count: resamples.
        rng: the only randomness.
    """
    n = int(group.max(initial=-1)) + 1
    if n == 0:
        return np.zeros((count, 0), np.float32)
    drawn = rng.integers(n, size=(count, n)) + n * np.arange(count)[:, None]
    times = np.bincount(drawn.ravel(), minlength=count * n).reshape(count, n)
    return times[:, group].astype(np.float32)


def average_precisions(hits: Hits, weights: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return (T, R) the average precision at each threshold of each resample; NaN where it holds no true box.

    Args:
        hits: ranked detections.
        weights: (R, F) see `draw_weights`.
    """
    return np.stack([_average_precision(hits, ranks, weights) for ranks in map(np.flatnonzero, hits.hit)])


def _average_precision(hits: Hits, ranks: NDArray[np.intp], weights: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return (R,) the average precision of the detections whose (H,) ranks are hits.

    Counts are whole numbers far below 2^24, exact in float32 and in any order of summation.
    """
    total = weights.astype(np.float64) @ hits.truths
    # (F, H): detections of each frame up to each hit, itself included.
    reached = np.zeros((len(hits.truths), len(ranks) + 1), np.float32)
    np.add.at(reached, (hits.frame, np.searchsorted(ranks, np.arange(len(hits.frame)))), 1.0)
    reached = np.cumsum(reached[:, :-1], axis=1)
    own = weights[:, hits.frame[ranks]]
    found, true = weights @ reached, np.cumsum(own, axis=1)
    precision = np.divide(true, found, out=np.zeros(own.shape), where=found > 0, dtype=np.float64)
    envelope = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
    area = np.einsum("rh,rh->r", own, envelope)
    return np.divide(area, total, out=np.full(len(total), math.nan), where=total > 0)


def percentile_interval(values: NDArray[np.float64], level: float = LEVEL) -> Interval:
    """Return the interval of the middle share `level` of (R,) values; undefined ones are left out."""
    known = values[np.isfinite(values)]
    if not known.size:
        return Interval(math.nan, math.nan)
    low, high = np.quantile(known, ((1.0 - level) / 2.0, (1.0 + level) / 2.0))
    return Interval(float(low), float(high))


@dataclass(frozen=True, slots=True)
class Difference:
    """A method less a baseline under one condition.

    Attributes:
        method: its name.
        baseline: likewise.
        condition: `clean`, a corruption, `mean_corrupted` or `mce`, of which less is better.
        iou: bird's-eye IoU threshold.
        value: difference in average precision or mCE, means over the trainings; its spread is that of the trainings'
            own differences, paired by seed, NaN where seeds differ.
        by_frame: interval over resampled frames.
        by_drive: interval over resampled drives.
    """

    method: str
    baseline: str
    condition: str
    iou: float
    value: Stat
    by_frame: Interval
    by_drive: Interval

    @property
    def resolved(self) -> bool:
        """Whether both intervals exclude 0."""
        return self.by_frame.excludes_zero and self.by_drive.excludes_zero

    def listed(self) -> dict[str, Any]:
        """Return it as JSON's types; unknown numbers are None."""
        numbers = {"difference": self.value.mean, "spread": self.value.spread}
        for name, interval in (("by_frame", self.by_frame), ("by_drive", self.by_drive)):
            numbers |= {f"{name}_low": interval.low, f"{name}_high": interval.high}
        known = {name: None if math.isnan(number) else number for name, number in numbers.items()}
        fields = {name: getattr(self, name) for name in ("method", "baseline", "condition", "iou")}
        return {**fields, **known, "resolved": self.resolved}
