"""Recorded percepts with truth, the input of a fit: from logs of episodes, or stored detections of drives."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from dsrc.closed_loop.ego import without_ego
from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.perception.error_model.sight import Viewpoints, sights_of
from dsrc.evaluation.detection_table import DetectionTable
from sim.boxes import Boxes

FRAME_S = 0.1
"""Time between two frames of a drive whose numbers follow each other, s."""
SEEN_POINTS = 5
"""Points on an object from which on an agent sees it, where no share is known."""
MATCH_M = 2.0
"""Largest distance of the centres of a box and its object, or half the object's length where that is more, m."""

DOUBLE_M = 4.0
"""Largest distance of the centres of a second box and its object, m."""


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """Percept and truth of one instant, in one frame that stays where it is or moves with the ego.

    Attributes:
        time_s: of the measurement, s.
        ego: (3,) x, y, m, and yaw, rad.
        truth: N other road users.
        sight: (N,) rows of `SIGHTS`.
        found: M boxes.
        score: (M,) of the boxes.
    """

    time_s: float
    ego: NDArray[np.float64]
    truth: Boxes
    sight: NDArray[np.int64]
    found: Boxes
    score: NDArray[np.float64]

    def matches(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the (K,) rows of `found` and of `truth` that belong together, by the least sum of distances."""
        apart = np.linalg.norm(self.found.center[:, None, :2] - self.truth.center[None, :, :2], axis=2)
        near = apart <= np.maximum(MATCH_M, 0.5 * self.truth.size[None, :, 0])
        found, truth = linear_sum_assignment(np.where(near, apart, 1e6))
        kept = near[found, truth]
        return found[kept], truth[kept]

    def doubles(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the (K,) rows of `found` that are second boxes, and of `truth` that they are of.

        One for each object that was found: the nearest of what is left within `DOUBLE_M`.
        """
        found, truth = self.matches()
        left = np.setdiff1d(np.arange(len(self.found)), found)
        apart = np.linalg.norm(self.found.center[left, None, :2] - self.truth.center[None, truth, :2], axis=2)
        near = apart <= DOUBLE_M
        second, of = linear_sum_assignment(np.where(near, apart, 1e6))
        kept = near[second, of]
        return left[second[kept]], truth[of[kept]]


def observed_episode(log: EpisodeLog, cooperative: bool) -> Iterator[Observed]:
    """Yield the percepts of an episode with the truth at the instants of their measurement, world frame."""
    settings = log.settings
    views = Viewpoints(settings.scenario, settings.seed, settings.ego_id, cooperative)
    at = {round(tick.actors.time_s, 6): row for row, tick in enumerate(log.ticks)}
    for tick in log.ticks:
        row = at.get(round(tick.percept.time_s, 6)) if tick.percept is not None else None
        if tick.percept is None or row is None:
            continue
        then = log.ticks[row]
        if settings.ego_id not in then.actors.boxes.object_id:
            continue
        percept = without_ego(tick.percept, then.ego)
        others = np.flatnonzero(then.actors.boxes.object_id != settings.ego_id)
        before = log.actors[0]
        yield Observed(
            time_s=tick.percept.time_s,
            ego=np.array([*then.ego.box.center[0, :2], then.ego.box.yaw[0]]),
            truth=then.actors.boxes[others],
            sight=views.sight(before, then.actors, others),
            found=percept.boxes,
            score=percept.score,
        )


def observed_table(table: DetectionTable, cooperative: bool) -> Iterator[Observed]:
    """Yield the frames of a drive with stored detections, in the frame of the ego's LiDAR.

    The ego's sight of an object is its visible share, of helpers it is only known whether they have points on it. Both
    are before the corruption: the sight, not what is left of it.

    Args:
        table: of one drive, in order of time.
    """
    for frame in table.frames():
        points = frame.points[:, :2].astype(np.int64)
        share = np.where(np.isnan(frame.ego_share), points[:, 0] >= SEEN_POINTS, frame.ego_share)
        others = (points[:, 1] - points[:, 0] >= SEEN_POINTS) & cooperative
        (result,) = frame.results()
        yield Observed(
            time_s=float(frame.index[0]) * FRAME_S,
            ego=np.zeros(3),
            truth=result.truth,
            sight=sights_of(share.astype(np.float64), others.astype(np.float64)),
            found=result.detections.boxes,
            score=result.detections.score.astype(np.float64),
        )
