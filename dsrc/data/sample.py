"""Sample: one instant seen by one ego and its collaborators, in the ego LiDAR's frame or one ahead of it."""

from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from dsrc.data.points_in_boxes import points_in_boxes
from dsrc.ops.anchors import Users
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from dsrc.ops.ground import Ground
from sensors.frame import Frame, Region
from sim.boxes import Boxes
from sim.errors import DataError, complaint, warn_deprecated
from sim.geometry import invert, transform_points


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """Input of a detector at one instant: A agents, ego first, everything in one frame.

    The frame is the ego LiDAR's, or one shifted ahead of it: the ego's LiDAR stands at `ego_from_agent[0]`.

    Attributes:
        key: `drive/agent/frame`, for messages and seeds.
        agent_ids: (A,) ids, ego first.
        clouds: per agent (P, 4) float32 x, y, z, intensity; own body removed, cropped to the grid's range.
        ego_from_agent: (A, 4, 4) float64 poses of the agents' LiDARs; the ego's own is the identity, but where the
            frame is shifted ahead.
        boxes: ground truth: road users that are to be detected, with a point of any agent that takes part, all corners
            in range; without the ego, unless OpenCOOD judges.
        agent_boxes: per agent the boxes of the ground truth with a point of its own.
        lost: per agent (h, w) bool tiles of its feature map that were lost, (0, 0) for none; empty where no agent lost
            one.
        other_clouds: (P, 4) clouds of agents in range that are not fused; a teacher's objects have their points.
        corrupted: per agent the corrupted cloud of a training sample, in place of that in `clouds`; else empty.
        region: where boxes are judged, in the sample's frame; None for everywhere in range.
        grounds: per agent the surface that was taken off its cloud, see `dsrc.data.level`; empty where clouds and boxes
            lie as the sensors saw them.
    """

    key: str
    agent_ids: tuple[int, ...]
    clouds: tuple[NDArray[np.float32], ...]
    ego_from_agent: NDArray[np.float64]
    boxes: Boxes
    agent_boxes: tuple[Boxes, ...]
    lost: tuple[NDArray[np.bool_], ...] = ()
    other_clouds: tuple[NDArray[np.float32], ...] = ()
    corrupted: tuple[NDArray[np.float32], ...] = ()
    region: Region | None = None
    grounds: tuple[Ground, ...] = ()


Range = tuple[float, float, float, float, float, float]

TeamBy = Literal["range", "folders"]
"""Order of the two rules of who takes part: `range` takes the agents in range and of these the first few; `folders`, as
OpenCOOD, the first few folders and of these the agents in range, so that fewer may be left."""

JudgedBy = Literal["grid", "opencood"]
"""Boxes that count, true or detected: `grid`, those inside the detector's range without the ego's own; `opencood`,
those inside `OPENCOOD_RANGE_M` whatever the detector's range, the ego's own too where a collaborator has a point on
it."""

COMM_RANGE_M = 70.0
"""Communication range of OPV2V's benchmarks, m."""
OPENCOOD_RANGE_M: Range = (-140.0, -40.0, -3.0, 140.0, 40.0, 1.0)
"""Range in which OpenCOOD's evaluation counts boxes, in the ego LiDAR's frame, m."""

# The released code drops an agent's returns on itself in this box of the LiDAR's frame, m; it fits OPV2V's Lincoln.
_OWN_BODY_LOW = np.array([-1.95, -1.1], np.float32)
_OWN_BODY_HIGH = np.array([2.95, 1.1], np.float32)
_OWN_BODY_MARGIN_M = 0.1


@dataclass(frozen=True, slots=True)
class SampleRequest:
    """Rules by which samples are made: who takes part and what counts as the truth. A detector's settings give them.

    Attributes:
        grid: range to which clouds are cropped.
        comm_range_m: communication range of the ego, between LiDARs in the plane, m.
        max_agents: limit on the agents, the ego included, in the order of the folders.
        users: road users of the ground truth.
        team_by: order of the rules of range and number.
        keep_ego_box: the ego's own box counts where a collaborator has a point on it, as in OpenCOOD.
        truth_range_m: range of the ground truth; None is the grid's.
        min_points: points that an agent has on a road user that it has seen.
    """

    grid: GridSpec
    comm_range_m: float = COMM_RANGE_M
    max_agents: int = 5
    users: Users = "vehicles"
    team_by: TeamBy = "range"
    keep_ego_box: bool = False
    truth_range_m: Range | None = None
    min_points: int = 1

    @property
    def judged_m(self) -> Range:
        """Range in which boxes count, true or detected, in the ego LiDAR's frame, m."""
        return self.truth_range_m or self.grid.range_m

    @property
    def request(self) -> "SampleRequest":
        """Itself: a detector without further settings has these."""
        return self


class DetectorSettings(Protocol):
    """Settings of a detector, as far as samples depend on them: `ModelSettings`, or a `SampleRequest`."""

    @property
    def grid(self) -> GridSpec:
        """Bird's-eye grid of the detector."""
        ...

    @property
    def request(self) -> SampleRequest:
        """Rules by which its samples are made, and in whose range its detections count."""
        ...


class SampleDetector(Protocol):
    """Detector of boxes in a sample, such as `dsrc.models.detector.Detector`."""

    @property
    def settings(self) -> DetectorSettings:
        """Settings; a `SampleRequest` is enough."""
        ...

    def detect(self, sample: Sample) -> Detections:
        """Return detections in the sample's frame."""
        ...


def make_sample(
    frame: Frame,
    ego_id: int | None,
    request: SampleRequest | GridSpec,
    *,
    cooperative: bool = True,
    key: str = "",
    ahead_m: float = 0.0,
    recorded: Frame | None = None,
    **rules: Any,
) -> Sample:
    """Make the sample of one ego in a frame.

    Args:
        frame: one instant of all agents.
        ego_id: the ego; None takes the first vehicle in the order of the folders (else the first agent).
        request: rules, `detector.settings.request` for a detector's; a grid stands for the defaults with it.
        cooperative: include the collaborators' clouds. The ground truth is the same either way.
        key: name of the sample; empty for one of ego and frame.
        ahead_m: shift of the sample's frame, and so of the grid, along the ego's heading, m.
        recorded: the frame before it was corrupted, whose places decide which agents are in range; the frame's own
            where it is left out.
        rules: fields of the request, deprecated: they go on 2027-06-01.

    Raises:
        DataError: the frame lacks the ego.
    """
    asked = request if isinstance(request, SampleRequest) else SampleRequest(request)
    if rules:
        warn_deprecated(", ".join(rules), "dsrc.SampleRequest")
        asked = replace(asked, **rules)
    rows = participants(recorded or frame, ego_id, asked)
    ego = frame.agents[rows[0]]
    shift = np.eye(4)
    shift[0, 3] = -ahead_m
    ego_from_world = shift @ invert(ego.sweep.world_from_lidar)
    # Who errs about where it is sees others where they are: truth is relative to the ego's true place.
    true_from_world = shift @ invert((recorded or frame).agents[rows[0]].sweep.world_from_lidar)
    truth = frame.truth.transform(true_from_world)
    region = None if frame.region is None else frame.region.transform(true_from_world)
    eligible = users_in(truth, asked.users) & counted(truth, asked.judged_m, region)
    if not asked.keep_ego_box:
        eligible &= truth.object_id != ego.agent_id
    seen = frame.points_on[rows] >= asked.min_points
    ids = np.array([frame.agents[row].agent_id for row in rows])
    annotated = eligible & seen & (truth.object_id != ids[:, None])
    active = rows if cooperative else rows[:1]
    poses = np.stack([ego_from_world @ frame.agents[row].sweep.world_from_lidar for row in active])
    poses[0] = shift
    return Sample(
        key=key or f"{ego.agent_id}/{frame.index:06d}",
        agent_ids=tuple(frame.agents[row].agent_id for row in active),
        clouds=tuple(cloud_of(frame, row, pose, asked.grid) for row, pose in zip(active, poses, strict=True)),
        ego_from_agent=poses,
        boxes=truth[annotated.any(axis=0)],
        agent_boxes=tuple(truth[annotated[i]] for i in range(len(active))),
        region=region,
    )


class TeamRules(Protocol):
    """Who takes part, see `SampleRequest`."""

    @property
    def comm_range_m(self) -> float:
        """Communication range of the ego, m."""
        ...

    @property
    def max_agents(self) -> int:
        """Limit on the agents, the ego included."""
        ...

    @property
    def team_by(self) -> TeamBy:
        """Order of the rules of range and number."""
        ...


def participants(frame: Frame, ego_id: int | None, request: TeamRules) -> list[int]:
    """Return rows of `frame.agents`: the ego, then the others that take part.

    Raises:
        DataError: the frame lacks the ego, or has no agent.
    """
    if ego_id is None:
        vehicles = [row for row, agent in enumerate(frame.agents) if agent.kind == "vehicle"]
        ego_row = vehicles[0] if vehicles else 0
    else:
        ids = [agent.agent_id for agent in frame.agents]
        if ego_id not in ids:
            raise DataError(complaint(f"frame {frame.index}", "ego", f"one of the agents {ids}", ego_id))
        ego_row = ids.index(ego_id)
    if not frame.agents:
        raise DataError(f"frame {frame.index}: expected at least one agent, found none")
    place = np.array([agent.sweep.world_from_lidar[:2, 3] for agent in frame.agents])
    distance = np.linalg.norm(place - place[ego_row], axis=1)
    rows = [ego_row, *(row for row in range(len(frame.agents)) if row != ego_row)]
    if request.team_by == "folders":
        rows = rows[: request.max_agents]
    return [row for row in rows if distance[row] <= request.comm_range_m][: request.max_agents]


def first_agents(sample: Sample, count: int) -> Sample:
    """Return the sample of the first `count` agents, the ego included; ground truth stays."""
    return replace(
        sample,
        agent_ids=sample.agent_ids[:count],
        clouds=sample.clouds[:count],
        ego_from_agent=sample.ego_from_agent[:count],
        agent_boxes=sample.agent_boxes[:count],
        lost=sample.lost[:count],
        grounds=sample.grounds[:count],
    )


def users_in(boxes: Boxes, users: Users) -> NDArray[np.bool_]:
    """Return the (N,) mask of boxes that a network of these users is to detect."""
    return boxes.is_vehicle if users == "vehicles" else boxes.is_vulnerable


def inside_range(boxes: Boxes, grid: GridSpec) -> NDArray[np.bool_]:
    """Return (N,) whether all 8 corners lie in the grid's range, faces included."""
    return inside(boxes, grid.range_m)


def inside(boxes: Boxes, range_m: Range) -> NDArray[np.bool_]:
    """Return (N,) whether all 8 corners lie in a range, faces included."""
    corners = boxes.corners()
    low, high = np.array(range_m[:3]), np.array(range_m[3:])
    return np.all((corners >= low) & (corners <= high), axis=(1, 2))


def counted(boxes: Boxes, range_m: Range, region: Region | None) -> NDArray[np.bool_]:
    """Return (N,) whether boxes are judged, true or detected: wholly in range and in the region of the labels."""
    judged = inside(boxes, range_m)
    return judged if region is None else judged & region.counts(boxes)


def cloud_of(frame: Frame, row: int, ego_from_agent: NDArray[np.float64], grid: GridSpec) -> NDArray[np.float32]:
    """Return (P, 4) x, y, z, intensity in the ego's frame: without the agent's own body, strictly in range."""
    sweep = frame.agents[row].sweep
    points = transform_points(ego_from_agent, sweep.points)
    inside = ~own_body(frame, row)
    for axis in range(3):
        # Column by column: a comparison of whole rows takes three times as long.
        place = points[:, axis]
        inside &= (place > np.float32(grid.range_m[axis])) & (place < np.float32(grid.range_m[axis + 3]))
    kept = np.flatnonzero(inside)
    cloud = np.zeros((len(kept), 4), np.float32)
    cloud[:, :3] = points.take(kept, axis=0)
    cloud[:, 3] = sweep.intensity[kept]
    return cloud


def own_body(frame: Frame, row: int) -> NDArray[np.bool_]:
    """Return (P,) whether a point lies on the agent itself: in its true box, for other tools' data in OPV2V's."""
    agent = frame.agents[row]
    points = agent.sweep.points
    if agent.sweep.spec is None:
        (x, y), low, high = points[:, :2].T, _OWN_BODY_LOW, _OWN_BODY_HIGH
        return (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
    own = frame.truth[frame.truth.object_id == agent.agent_id].transform(invert(agent.sweep.world_from_lidar))
    mask = np.zeros(len(points), bool)
    mask[points_in_boxes(own, points, margin=_OWN_BODY_MARGIN_M)[0]] = True
    return mask
