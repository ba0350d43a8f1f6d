"""Average precision of cars as KITTI's development kit counts it: by level of difficulty, with boxes to ignore.

What counts at a level: cars high enough in the image, neither too occluded nor too truncated. Other cars and all vans
may be found, which is neither right nor wrong, and so may be detections too low in the image. Precision is taken at
41 confidences at most, those that come nearest to the recalls 0, 1/40, ..., 1; at each, true boxes choose in their
order, the free detection that overlaps most. With fewer than 41 cars there are fewer confidences, and the kit counts
the missing ones as 0. Its don't-care regions are boxes of the image alone, which overlap nothing in bird's-eye view
and in 3D.

Source: A. Geiger et al., CVPR 2012, and the object development kit's evaluate_object; 40 recalls: A. Simonelli et al.,
ICCV 2019.
"""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from dsrc.data.formats.kitti_labels import InImage
from dsrc.evaluation.metrics.ap import Space, overlapping_pairs
from dsrc.ops.detections import Detections
from dsrc.ops.iou import paired_volume_iou
from sim.boxes import CLASSES, Boxes

Level = Literal["easy", "moderate", "hard"]
LEVELS: tuple[Level, ...] = ("easy", "moderate", "hard")
LEAST_PX = (40, 25, 25)
MOST_OCCLUDED = (0, 1, 2)
MOST_TRUNCATED = (0.15, 0.3, 0.5)
"""Height in the image, px, that a true box exceeds and a detection has, greatest occlusion and truncation, by level."""

STEPS = 40
_CAR, _VAN = CLASSES.index("car"), CLASSES.index("van")


@dataclass(frozen=True, slots=True, eq=False)
class RatedFrame:
    """Detections and true vehicles of one frame in one coordinate frame, each with what is known of it in the image."""

    detections: Detections
    found: InImage
    truth: Boxes
    true: InImage


class Counted(NamedTuple):
    """What counts at a level.

    Attributes:
        precision: (41,) envelope of precision at the recalls 0, 1/40, ..., 1; NaN without a car that counts.
        truth: number of cars.
        detections: number of detections.
    """

    precision: NDArray[np.float64]
    truth: int
    detections: int

    def ap(self, recalls: str) -> float:
        """Average precision at 11 recalls from 0 to 1, or at 40 from 1/40 to 1."""
        return float((self.precision[::4] if recalls == "11" else self.precision[1:]).mean())


class _Detection(NamedTuple):
    """Detection that overlaps a true box enough: row, overlap, confidence, and whether it is too low in the image."""

    row: int
    overlap: float
    score: float
    low: bool


class Rated:
    """Overlaps of all frames, from which each level is counted."""

    def __init__(self, frames: Sequence[RatedFrame]) -> None:
        """Overlap the boxes of the frames."""
        found = [frame.detections.boxes.array for frame in frames]
        truth = [frame.truth.array for frame in frames]
        pairs = overlapping_pairs(found, truth)
        order = np.lexsort((pairs.detection, pairs.truth))
        self._detection, self._truth, bev = pairs.detection[order], pairs.truth[order], pairs.iou[order]
        a, b = (np.concatenate([np.zeros((0, 7)), *parts]) for parts in (found, truth))
        volume = paired_volume_iou(a[self._detection], b[self._truth], bev)
        self._overlap: dict[Space, NDArray[np.float64]] = {"bev": bev, "3d": volume}
        self._score = _joined([frame.detections.score for frame in frames])
        self._found_label = _joined([frame.detections.boxes.label for frame in frames])
        self._true_label = _joined([frame.truth.label for frame in frames])
        self._found_px = _joined([frame.found.height_px for frame in frames])
        self._true = InImage(*(_joined(parts) for parts in zip(*(frame.true for frame in frames), strict=True)))
        self._counted: dict[tuple[Level, Space, float], Counted] = {}

    def count(self, level: Level, space: Space, threshold: float) -> Counted:
        """Count a level where overlaps exceed a threshold."""
        key = level, space, threshold
        if key not in self._counted:
            self._counted[key] = self._count(*key)
        return self._counted[key]

    def _count(self, level: Level, space: Space, threshold: float) -> Counted:
        row = LEVELS.index(level)
        low = self._found_px < LEAST_PX[row]
        mine = ~low & (self._found_label == _CAR)
        counts = (
            (self._true_label == _CAR)
            & (self._true.height_px > LEAST_PX[row])
            & (self._true.occluded <= MOST_OCCLUDED[row])
            & (self._true.truncated <= MOST_TRUNCATED[row])
        )
        n_truth, n_found = int(counts.sum()), int(mine.sum())
        if n_truth == 0:
            return Counted(np.full(STEPS + 1, np.nan), 0, n_found)
        near = self._overlap[space] > threshold
        near &= (low | mine)[self._detection] & np.isin(self._true_label, (_CAR, _VAN))[self._truth]
        choices: dict[int, list[_Detection]] = {}
        for box, detection, overlap in zip(
            self._truth[near].tolist(), self._detection[near].tolist(), self._overlap[space][near].tolist(), strict=True
        ):
            one = _Detection(detection, overlap, float(self._score[detection]), bool(low[detection]))
            choices.setdefault(box, []).append(one)
        scored = [(bool(counts[box]), ones) for box, ones in choices.items()]
        ranked = np.sort(self._score[mine]).tolist()
        precision = np.zeros(STEPS + 1)
        for step, least in enumerate(_confidences(scored, n_truth)):
            hits, neither = _matched(scored, least)
            asked = len(ranked) - bisect_left(ranked, least) - neither
            precision[step] = hits / asked if asked else 0.0
        return Counted(np.maximum.accumulate(precision[::-1])[::-1], n_truth, n_found)


def _joined(parts: Sequence[NDArray[np.generic]]) -> NDArray[np.float64]:
    return np.concatenate([np.zeros(0), *parts])


def _confidences(choices: Sequence[tuple[bool, list[_Detection]]], n_truth: int) -> list[float]:
    """Return the confidences, falling, at which recall comes nearest to 0, 1/40, ..., 1.

    Here each true box takes the free detection of the highest confidence.
    """
    taken: set[int] = set()
    scores = []
    for counts, ones in choices:
        free = [one for one in ones if one.row not in taken]
        if free:
            best = max(free, key=lambda one: one.score)
            taken.add(best.row)
            if counts and not best.low:
                scores.append(best.score)
    scores.sort(reverse=True)
    chosen: list[float] = []
    wanted = 0.0
    for place, score in enumerate(scores, 1):
        here, after = place / n_truth, (place + 1) / n_truth
        if place == len(scores) or after - wanted >= wanted - here:
            chosen.append(score)
            wanted += 1 / STEPS
    return chosen


def _matched(choices: Sequence[tuple[bool, list[_Detection]]], least: float) -> tuple[int, int]:
    """Return hits, and detections high enough that count neither way, among those of a confidence or more."""
    taken: set[int] = set()
    hits = neither = 0
    for counts, ones in choices:
        free = [one for one in ones if one.score >= least and one.row not in taken]
        high = [one for one in free if not one.low]
        if high:
            taken.add(max(high, key=lambda one: one.overlap).row)
            hits += counts
            neither += not counts
        elif free:
            taken.add(free[0].row)
    return hits, neither
