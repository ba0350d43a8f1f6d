"""Intervals of differences in average precision: the paired bootstrap over frames and over drives.

The frames of a benchmark are a sample. A resample draws as many frames, or as many runs of traffic with all frames of
their drives (`dsrc.data.drives.traffic_runs`), as there are, with replacement: frame f is in it w_f times. Its average
precision is computed anew, from the detections k of all frames in the order of falling confidence, in frame f(k), hit
(h_k = 1) or not (0), and from N_f true boxes:

    TP_k = sum over j <= k of w_f(j) h_j        n_k = sum over j <= k of w_f(j)
    AP = sum over k of w_f(k) h_k (max over j >= k of TP_j / n_j) / sum over f of w_f N_f

This is the area under the envelope of `dsrc.evaluation.metrics.ap`, of each frame copied w_f times; only hits need be
looked at, for precision falls from one to the next. The interval of a difference lies between two quantiles of its
values over the resamples, and both methods are evaluated on the same resamples. Where detections are sorted inside
frames, as by OpenCOOD, the sums run over them frame after frame.

Source: B. Efron, Bootstrap methods: another look at the jackknife, Annals of Statistics 7 (1979), 1-26; B. Efron and
R. J. Tibshirani, An Introduction to the Bootstrap (1993), chapter 13, for the percentile interval; T. C. Hesterberg,
What teachers should know about the bootstrap, The American Statistician 69 (2015), 371-386, for its expansion.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dsrc.evaluation.metrics.ap import Matches
from dsrc.tables.table import Stat

RESAMPLES = 1000
_CHUNK = 64  # resamples whose arrays stay in a core's cache
LEVEL = 0.95
IOUS = (0.5, 0.7)
"""Bird's-eye IoU thresholds of the differences."""


@dataclass(frozen=True, slots=True, eq=False)
class RankedDetections:
    """Detections of F frames in their ranking.

    Attributes:
        frame: (D,) number of each detection's frame.
        hit: (T, D) true positives at each of T IoU thresholds.
        truths: (F,) ground-truth boxes of each frame.
    """

    frame: NDArray[np.int32]
    hit: NDArray[np.bool_]
    truths: NDArray[np.int64]

    @classmethod
    def of(
        cls, matches: Matches, ious: Sequence[float] = IOUS, *, inside_frames: bool = False, least_score: float = 0.0
    ) -> "RankedDetections":
        """Rank the detections by their matches in bird's-eye view; ties stay in the order of the frames.

        Args:
            matches: by falling score inside each frame.
            inside_frames: keep that order, frame after frame, as OpenCOOD does, in place of one by score over all.
            least_score: of the detections that count; those left out had suppressed nothing that counts.
        """
        frame = np.repeat(np.arange(matches.frames, dtype=np.int32), matches.detection_counts)
        hit = np.stack([matches.matched["bev", iou] >= 0 for iou in ious])
        order = np.arange(len(frame)) if inside_frames else np.argsort(-matches.score, kind="stable")
        order = order[matches.score[order] >= least_score]
        return cls(frame[order], hit[:, order], matches.truth_counts)


class Interval(NamedTuple):
    """Bounds of an interval; NaN where it is unknown."""

    low: float
    high: float

    @property
    def excludes_zero(self) -> bool:
        """Whether 0 lies outside; an unknown interval excludes nothing."""
        return self.low > 0.0 or self.high < 0.0

    @property
    def points(self) -> str:
        """Bounds in points; one near 0 has a second digit, which tells its side."""
        return f"[{', '.join(map(_points, self))}]"


def _points(bound: float) -> str:
    text = f"{100 * bound:+.1f}"
    return f"{100 * bound:+.2f}" if text[1:] == "0.0" else text


def draw_weights(group: NDArray[np.int64], count: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Draw (count, F) multiplicities of the frames in each resample.

    Args:
        group: (F,) number, from 0, of the unit drawn as a whole: the frame itself or its run of traffic.
    """
    n = int(group.max(initial=-1)) + 1
    if n == 0:
        return np.zeros((count, 0), np.float32)
    drawn = rng.integers(n, size=(count, n)) + n * np.arange(count)[:, None]
    times = np.bincount(drawn.ravel(), minlength=count * n).reshape(count, n)
    return times[:, group].astype(np.float32)


def resampled_ap(ranked: RankedDetections, weights: NDArray[np.float32]) -> NDArray[np.float64]:
    """(T, R) average precision at each threshold in each resample; NaN for one without a true box.

    Args:
        weights: (R, F) see `draw_weights`.
    """
    return np.stack([_resampled_ap(ranked, ranks, weights) for ranks in map(np.flatnonzero, ranked.hit)])


def _resampled_ap(
    ranked: RankedDetections, ranks: NDArray[np.intp], weights: NDArray[np.float32]
) -> NDArray[np.float64]:
    """(R,) average precision of detections whose (H,) ranks are true positives.

    Counts are whole numbers far below 2^24, exact in float32 and in any order of summation.
    """
    total = weights.astype(np.float64) @ ranked.truths
    # (F, H): detections of each frame up to each hit, itself included.
    reached = np.zeros((len(ranked.truths), len(ranks) + 1), np.float32)
    np.add.at(reached, (ranked.frame, np.searchsorted(ranks, np.arange(len(ranked.frame)))), 1.0)
    reached = np.cumsum(reached[:, :-1], axis=1)
    area = np.zeros(len(weights))
    for start in range(0, len(weights), _CHUNK):
        part = weights[start : start + _CHUNK]
        own, found = np.take(part, ranked.frame[ranks], axis=1), part @ reached
        # 0 of 0 before the first drawn detection: such hits have no weight.
        precision = np.cumsum(own, axis=1, dtype=np.float64) / np.maximum(found, 1.0)
        envelope = np.maximum.accumulate(precision[:, ::-1], axis=1)[:, ::-1]
        area[start : start + _CHUNK] = (own * envelope).sum(axis=1)
    return np.divide(area, total, out=np.full(len(total), math.nan), where=total > 0)


def percentile_interval(values: NDArray[np.float64], units: int, level: float = LEVEL) -> Interval:
    """Expanded percentile interval of (R,) values in resamples; undefined values are left out.

    The quantiles lie further out than those of the percentile interval by as much as Student's interval of a mean is
    wider than the resamples of few units: at 7 units 0.4 % and 99.6 % for a level of 95 %.

    Args:
        units: number of frames or runs drawn from; fewer than two have no interval.
        level: share of samples whose interval holds the true value.
    """
    from scipy import stats  # two seconds: a worker that only detects does not need it

    known = values[np.isfinite(values)]
    if not known.size or units < 2:
        return Interval(math.nan, math.nan)
    tail = stats.norm.cdf(math.sqrt(units / (units - 1)) * stats.t.ppf((1.0 - level) / 2.0, units - 1))
    low, high = np.quantile(known, (tail, 1.0 - tail))
    return Interval(float(low), float(high))


@dataclass(frozen=True, slots=True)
class Difference:
    """Difference of a method and its baseline under one condition.

    Attributes:
        method: name of the method.
        baseline: name of the baseline.
        condition: `clean`, a corruption, `mean_corrupted` or `mce`, of which less is better.
        iou: bird's-eye IoU threshold.
        value: difference in average precision or mCE, means over the trainings; its spread is that of the differences
            between trainings of one seed, NaN with fewer than two common seeds.
        by_frame: interval over resampled frames.
        by_drive: interval over resampled runs of traffic, of each drive where no two show the same.
        seeds: of the trainings that count, those that both methods have; empty where all trainings count.
    """

    method: str
    baseline: str
    condition: str
    iou: float
    value: Stat
    by_frame: Interval
    by_drive: Interval
    seeds: tuple[int | None, ...] = ()

    @property
    def resolved(self) -> bool:
        """Whether both intervals exclude 0."""
        return self.by_frame.excludes_zero and self.by_drive.excludes_zero

    @classmethod
    def of_listed(cls, listed: Mapping[str, Any]) -> "Difference":
        """Difference from its fields as `listed` gives them, without the seeds."""
        number = {name: math.nan if value is None else value for name, value in listed.items()}
        by_frame, by_drive = (Interval(number[f"{u}_low"], number[f"{u}_high"]) for u in ("by_frame", "by_drive"))
        value = Stat(number["difference"], number["spread"])
        return cls(listed["method"], listed["baseline"], listed["condition"], listed["iou"], value, by_frame, by_drive)

    def listed(self) -> dict[str, Any]:
        """Fields as JSON types; unknown numbers are None."""
        numbers = {"difference": self.value.mean, "spread": self.value.spread}
        for name, interval in (("by_frame", self.by_frame), ("by_drive", self.by_drive)):
            numbers |= {f"{name}_low": interval.low, f"{name}_high": interval.high}
        known = {name: None if math.isnan(number) else number for name, number in numbers.items()}
        fields = {name: getattr(self, name) for name in ("method", "baseline", "condition", "iou")}
        return {**fields, **known, "resolved": self.resolved, "seeds": " ".join(map(str, self.seeds))}
