"""Who helped: the exact Shapley share of each agent in what a cooperative detector finds, and makes up.

The game of one box: its players are the collaborators, and a team's value is the best score of a detection of the ego
with this team that overlaps the box enough, 0 without one. A collaborator's share is its marginal value, averaged over
all orders in which the collaborators may join (L. S. Shapley, A value for n-person games, 1953); the ego's is what it
finds alone. The shares of a box sum to the value of the whole team, an agent that changes nothing has none, and two
that do the same have the same. Boxes are the true ones, and the false detections of the whole team.
"""

from dataclasses import dataclass
from math import factorial

import numpy as np
from numpy.typing import NDArray

from dsrc.data.sample import Sample, SampleDetector, counted
from dsrc.models.teams import team_detections
from dsrc.ops.detections import Detections
from dsrc.ops.iou import bev_iou
from sim.boxes import Boxes, concatenate
from sim.errors import SettingsError, complaint

MOST_AGENTS = 6
"""Most agents whose teams are tried, 32 of them."""


@dataclass(frozen=True, slots=True, eq=False)
class Shares:
    """Shares of A agents in T boxes of one frame, in the ego LiDAR's frame.

    Attributes:
        agent_ids: (A,) int64, the ego first.
        heard: (A,) bool, False for a collaborator whose message did not arrive; its shares are 0.
        boxes: (T,) true boxes, then the false detections of the whole team.
        true: (T,) bool, False for a false detection.
        share: (A, T) float64: what the ego finds alone, then the collaborators' shares; their sum is `team`.
        team: (T,) value of the whole team.
        without: (A, T) value of the whole team without this agent; of the ego, which cannot leave, `team`.
    """

    agent_ids: NDArray[np.int64]
    heard: NDArray[np.bool_]
    boxes: Boxes
    true: NDArray[np.bool_]
    share: NDArray[np.float64]
    team: NDArray[np.float64]
    without: NDArray[np.float64]

    @property
    def needed(self) -> NDArray[np.bool_]:
        """(A, T) True where the team has the box and has it not without this agent."""
        return (self.team > 0) & (self.without == 0)

    @property
    def prevented(self) -> NDArray[np.bool_]:
        """(A, T) True where the team has not the box and has it without this agent."""
        return (self.team == 0) & (self.without > 0)


def check_iou(iou: float) -> None:
    """Raise SettingsError for an overlap that is not in (0, 1]."""
    if not 0 < iou <= 1:
        raise SettingsError(complaint("shares", "iou", "more than 0, at most 1", iou))


def shapley(values: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the (n, ...) Shapley values of n players from the (2^n, ...) values of coalitions.

    Args:
        values: of the coalition of player i for every bit i that is 1 in its row's number.
    """
    values = np.asarray(values, np.float64)
    players = len(values).bit_length() - 1
    rows = np.arange(len(values))
    size = np.array([int(row).bit_count() for row in rows])
    shares = np.zeros((players, *values.shape[1:]))
    for i in range(players):
        apart = rows[rows >> i & 1 == 0]
        orders = [factorial(s) * factorial(players - 1 - s) / factorial(players) for s in size[apart]]
        shares[i] = np.tensordot(orders, values[apart | 1 << i] - values[apart], axes=1)
    return shares


def share_sample(
    detector: SampleDetector, sample: Sample, iou: float = 0.5, agent_ids: tuple[int, ...] | None = None
) -> Shares:
    """Shares of a sample's agents in its true boxes and in the whole team's false detections.

    Args:
        detector: run for every team; see `dsrc.models.teams.team_detections`.
        sample: as the ego has received it.
        iou: least overlap in bird's-eye view of a detection with the box that it is of.
        agent_ids: all agents, the ego first; those that are not in the sample are not heard. None for the sample's.

    Raises:
        SettingsError: there are more than six agents, or the overlap is not in (0, 1].
    """
    check_iou(iou)
    if len(sample.clouds) > MOST_AGENTS:
        raise SettingsError(complaint("shares", "agents", f"at most {MOST_AGENTS}", len(sample.clouds)))
    seen = detector.settings.request.judged_m
    found = [part[counted(part.boxes, seen, sample.region)] for part in team_detections(detector, sample)]
    whole = found[-1]
    hits: NDArray[np.bool_] = np.any(_overlaps(whole.boxes, sample.boxes, iou), axis=1)
    false = whole.boxes[~hits]
    boxes = concatenate([sample.boxes, false])
    values = np.stack([_values(boxes, part, iou) for part in found])
    present = np.array(sample.agent_ids)
    everybody = present if agent_ids is None else np.array(agent_ids)
    rows = [int(np.flatnonzero(everybody == agent)[0]) for agent in present]
    share = np.zeros((len(everybody), len(boxes)))
    without = np.tile(values[-1], (len(everybody), 1))
    share[rows[0]] = values[0]
    share[rows[1:]] = shapley(values)
    last = len(found) - 1
    for bit, row in enumerate(rows[1:]):
        without[row] = values[last ^ 1 << bit]
    return Shares(
        agent_ids=everybody,
        heard=np.isin(everybody, present),
        boxes=boxes,
        true=np.arange(len(boxes)) < len(sample.boxes),
        share=share,
        team=values[-1],
        without=without,
    )


def _overlaps(a: Boxes, b: Boxes, iou: float) -> NDArray[np.bool_]:
    return bev_iou(a.array, b.array) >= iou


def _values(boxes: Boxes, found: Detections, iou: float) -> NDArray[np.float64]:
    """Return the (T,) best scores of detections that overlap each box enough, 0 without one."""
    scores = np.where(_overlaps(boxes, found.boxes, iou), found.score[None].astype(np.float64), 0.0)
    return scores.max(axis=1, initial=0.0)
