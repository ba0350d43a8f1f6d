"""AgentFrame and Frame: one synchronised instant of all agents with its ground truth."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sensors.sweep import Sweep, make_sweep
from sim.boxes import Boxes, tilted_poses
from sim.errors import DataError, complaint
from sim.geometry import invert

AgentKind = Literal["vehicle", "roadside"]

BY_EGO, BY_HELPER, BY_NOBODY = range(3)
"""Values of `Frame.seen_by`."""

_RIGID = 1e-3
"""Largest error of a rotation's products; those of files have six digits or so."""


@dataclass(frozen=True, slots=True, eq=False)
class AgentFrame:
    """One agent at one instant: pose, speed and sweep.

    Attributes:
        agent_id: the object id of a vehicle; negative for a roadside unit.
        kind: `vehicle` or `roadside`.
        world_from_body: (4, 4) float64; the body frame's origin is the centre of the footprint at road level.
        speed: m/s.
        sweep: its LiDAR sweep.
    """

    agent_id: int
    kind: AgentKind
    world_from_body: NDArray[np.float64]
    speed: float
    sweep: Sweep


@dataclass(frozen=True, slots=True, eq=False)
class Region:
    """Where a frame's ground truth is complete: outside of it neither true boxes nor detections are judged.

    Everything is in one frame, that of the boxes that are asked for: the world in a `Frame`.

    Attributes:
        projection: (3, 4) to pixels of the image in which objects are labelled; None where they are labelled all
            around.
        image_size: width and height of the image, px.
        ignored_px: (K, 4) left, top, right, bottom of parts of the image that the labels leave out, px.
        ignored: boxes of objects that are neither to be found nor wrong to find.
    """

    projection: NDArray[np.float64] | None = None
    image_size: tuple[int, int] = (0, 0)
    ignored_px: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4)))
    ignored: Boxes = field(default_factory=Boxes.zeros)

    def counts(self, boxes: Boxes, margin_px: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.bool_]:
        """Return (N,) whether boxes are judged: by their centres, in the image and in nothing that is ignored.

        Args:
            margin_px: across and up, by which the ignored parts of the image are grown.
        """
        judged = np.ones(len(boxes), bool)
        if self.projection is not None:
            seen = np.concatenate([boxes.center, np.ones((len(boxes), 1))], axis=1) @ self.projection.T
            ahead = seen[:, 2] > 0.0
            px = seen[:, :2] / np.where(ahead, seen[:, 2], 1.0)[:, None]
            judged = ahead & np.all((px >= 0.0) & (px <= self.image_size), axis=1)
            for part in self.ignored_px:
                judged &= ~np.all((px >= part[:2] - margin_px) & (px <= part[2:] + margin_px), axis=1)
        for row in range(len(self.ignored)):
            one = self.ignored[row : row + 1]
            # The rule is the same from both sides: a box within another, seen from above.
            judged &= ~_in_plan(one, boxes.center)[0] & ~_in_plan(boxes, one.center)[:, 0]
        return judged

    def transform(self, destination_from_source: NDArray[np.float64]) -> Self:
        """Return the region in another frame."""
        back = None if self.projection is None else self.projection @ invert(destination_from_source)
        return replace(self, projection=back, ignored=self.ignored.transform(destination_from_source))


def _in_plan(boxes: Boxes, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return (N, P) whether (P, 3) points lie in the footprints of boxes."""
    flat = replace(boxes, center=boxes.center * [1.0, 1.0, 0.0])
    return flat.contains(points * [1.0, 1.0, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One instant of all agents with ground truth: the unit of storage, training, evaluation and review.

    Attributes:
        index: number of the frame in its drive.
        time_s: simulation time, s.
        agents: A agents, in order of their id as text (the order of their folders), roadside units last.
        truth: N ground-truth boxes in the world frame, agents' own bodies included, rows sorted by object id.
        velocity: (N, 2) float64 ground-truth velocity in the world, m/s.
        points_on: (A, N) int32 LiDAR points that each agent has on each object.
        acceleration: (N, 2) float64 in the world, m/s2; NaN where unknown.
        signals: (N,) int32 lights, bits of `sim.traffic.base.SIGNALS`; 0 where unknown.
        lane: (N,) names of lanes in the road network; "" off the lanes and where unknown.
        visible_fraction: (A, N) float32 share of an agent's rays on an object that nothing else blocks, see
            `sensors.scan.visibility`; NaN where not measured, for an agent's own body, and where no ray would hit even
            the object alone.
        sight: (A, A) int8 `sim.radio.Obstruction` between the agents' antennas; -1 where unknown.
        region: where the ground truth is complete, world frame; None for everywhere.
        tilt: (N, 2) float64 pitch and roll of the objects' bodies, rad, as `sim.traffic.base.Actors` has them: the
            boxes of `truth` are upright all the same; 0 where unknown.

    The last seven may be left out: unknown, and everywhere.
    """

    index: int
    time_s: float
    agents: tuple[AgentFrame, ...]
    truth: Boxes
    velocity: NDArray[np.float64]
    points_on: NDArray[np.int32]
    acceleration: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    signals: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    lane: tuple[str, ...] = ()
    visible_fraction: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    sight: NDArray[np.int8] = field(default_factory=lambda: np.zeros((0, 0), np.int8))
    region: Region | None = None
    tilt: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))

    def __post_init__(self) -> None:
        agents, n = len(self.agents), len(self.truth)
        unknown: dict[str, Any] = {
            "acceleration": np.full((n, 2), np.nan),
            "signals": np.zeros(n, np.int32),
            "lane": ("",) * n,
            "visible_fraction": np.full((agents, n), np.nan, np.float32),
            "sight": np.full((agents, agents), -1, np.int8),
            "tilt": np.zeros((n, 2)),
        }
        for name, value in unknown.items():
            if np.size(getattr(self, name)) == 0:
                object.__setattr__(self, name, value)
        shapes = {
            "velocity": (n, 2),
            "points_on": (agents, n),
            "acceleration": (n, 2),
            "signals": (n,),
            "lane": (n,),
            "visible_fraction": (agents, n),
            "sight": (agents, agents),
            "tilt": (n, 2),
        }
        for name, shape in shapes.items():
            found = np.shape(getattr(self, name))
            if found != shape:
                raise ValueError(f"Frame.{name} must have shape {shape}, got {found}")

    def bodies(self) -> NDArray[np.float64]:
        """Return (N, 4, 4) poses of the middles of the objects' bodies in the world, tilted as they are."""
        return tilted_poses(self.truth, self.tilt)

    @classmethod
    def of_cloud(
        cls,
        points: ArrayLike,
        boxes: Boxes | ArrayLike | None = None,
        pose: ArrayLike | None = None,
        *,
        height: float = 0.0,
        **more: Any,
    ) -> "Frame":
        """Make a frame of one sensor from an array of points, of any source.

        Args:
            points: (P, 3) x forward, y left, z up in the sensor's frame, m; or (P, 4) with intensity from 0 to 1, or
                more columns, which are left out.
            boxes: true objects in the sensor's frame: `Boxes`, or (M, 7) x, y, z of the centre, l, w, h, yaw, m and
                rad, then cars; None without ground truth.
            pose: (4, 4) world_from_lidar; None for a world whose origin is the sensor's, `height` above the ground.
            height: of the sensor above the ground, m.
            more: see `of_clouds`.

        Raises:
            DataError: a value is not finite, or of another shape or range.
        """
        world_from_lidar = np.eye(4) if pose is None else _pose("pose", pose)
        if pose is None:
            world_from_lidar[2, 3] = height
        truth = None if boxes is None else _boxes(boxes).transform(world_from_lidar)
        return cls.of_clouds({0: (points, world_from_lidar)}, truth, height=height, **more)

    @classmethod
    def of_clouds(
        cls,
        clouds: "Mapping[int, tuple[ArrayLike, ArrayLike]]",
        boxes: Boxes | ArrayLike | None = None,
        *,
        velocity: ArrayLike | None = None,
        height: float = 0.0,
        index: int = 0,
        time_s: float = 0.0,
        region: Region | None = None,
    ) -> "Frame":
        """Make a frame of several agents from arrays of points and poses.

        Args:
            clouds: per agent its (P, 3) or (P, 4) points as in `of_cloud`, and its (4, 4) world_from_lidar; negative
                ids are roadside units, and an agent's own box has its id.
            boxes: true objects in the world; ids of -1 become numbers that are free.
            velocity: (M, 2) of the boxes in the world, m/s; None for unknown.
            height: of the sensors above their bodies' footprints, m.
            index: number of the frame.
            time_s: its time, s.
            region: where the boxes are complete, world frame; None for everywhere.

        Raises:
            DataError: a value is not finite, or of another shape or range, or an id stands twice.
        """
        if not clouds:
            raise DataError(complaint("Frame.of_clouds", "clouds", "at least one agent", "none"))
        truth = Boxes.zeros() if boxes is None else _numbered(_boxes(boxes), list(clouds))
        moving = np.full((len(truth), 2), np.nan) if velocity is None else np.asarray(velocity, np.float64)
        if moving.shape != (len(truth), 2):
            raise DataError(complaint("Frame.of_clouds", "velocity", f"shape ({len(truth)}, 2)", moving.shape))
        rows = np.argsort(truth.object_id, kind="stable")
        truth, down = truth[rows], np.eye(4)
        down[2, 3] = -height
        agents, counts = [], []
        for agent_id in agent_order(list(clouds)):
            points, pose = clouds[agent_id]
            sweep = _sweep(f"points of agent {agent_id}", points, _pose(f"pose of agent {agent_id}", pose), time_s)
            kind: AgentKind = "roadside" if agent_id < 0 else "vehicle"
            agents.append(AgentFrame(agent_id, kind, sweep.world_from_lidar @ down, 0.0, sweep))
            counts.append(truth.contains(sweep.world_points).sum(axis=1))
        points_on = np.array(counts, np.int32).reshape(len(agents), len(truth))
        return cls(index, time_s, tuple(agents), truth, moving[rows], points_on, region=region)

    def agent(self, agent_id: int) -> AgentFrame:
        """Return the agent of this id; KeyError when missing."""
        for agent in self.agents:
            if agent.agent_id == agent_id:
                return agent
        raise KeyError(agent_id)

    def seen_by(self, ego_id: int, points: int = 1) -> NDArray[np.uint8]:
        """Return (N,) observers of the objects: `BY_EGO`, `BY_HELPER` (another agent, not the ego) or `BY_NOBODY`.

        Args:
            ego_id: one of the agents; KeyError for any other id.
            points: least number of points on an object for an agent to see it. Counts are those of the recorded
                sweeps, before any corruption.
        """
        enough = self.points_on >= points
        row = self.agents.index(self.agent(ego_id))
        seen = np.full(len(self.truth), BY_NOBODY, np.uint8)
        seen[enough.any(axis=0)] = BY_HELPER
        seen[enough[row]] = BY_EGO
        return seen

    def of_agents(self, rows: list[int]) -> "Frame":
        """Return the frame with some of its agents, by their rows; all ground truth stays."""
        return replace(
            self,
            agents=tuple(self.agents[row] for row in rows),
            points_on=self.points_on[rows],
            visible_fraction=self.visible_fraction[rows],
            sight=self.sight[rows][:, rows],
        )

    def with_sweeps(self, sweeps: list[Sweep]) -> "Frame":
        """Return the frame with the agents' sweeps replaced, in order; ground truth and counts stay."""
        agents = tuple(replace(a, sweep=s) for a, s in zip(self.agents, sweeps, strict=True))
        return replace(self, agents=agents)


def _pose(name: str, pose: ArrayLike) -> NDArray[np.float64]:
    """Return a copy of a (4, 4) rigid transform; DataError for anything else."""
    matrix = np.array(pose, np.float64)
    rigid = matrix.shape == (4, 4) and np.isfinite(matrix).all() and (matrix[3] == [0.0, 0.0, 0.0, 1.0]).all()
    if not rigid or np.abs(matrix[:3, :3].T @ matrix[:3, :3] - np.eye(3)).max() > _RIGID:
        raise DataError(complaint("Frame", name, "a (4, 4) matrix of rotation and translation", matrix.tolist()))
    return matrix


def _boxes(boxes: Boxes | ArrayLike) -> Boxes:
    """Return boxes of (M, 7) numbers; DataError where they are none or have no size."""
    if not isinstance(boxes, Boxes):
        rows = np.asarray(boxes, np.float64)
        rows = rows.reshape(0, 7) if rows.size == 0 else rows
        if rows.ndim != 2 or rows.shape[1] != 7:
            raise DataError(complaint("Frame", "boxes", "shape (M, 7): x, y, z, l, w, h, yaw", rows.shape))
        boxes = Boxes.from_array(rows)
    if not np.isfinite(boxes.array).all() or (boxes.size <= 0.0).any():
        raise DataError(complaint("Frame", "boxes", "finite numbers and positive sizes", "others"))
    return boxes


def _numbered(boxes: Boxes, agents: list[int]) -> Boxes:
    """Return boxes with an id each: unknown ones get the next numbers; DataError where one stands twice."""
    ids, unknown = boxes.object_id.copy(), boxes.object_id == -1
    first = max([0, *agents, *ids.tolist()]) + 1
    ids[unknown] = np.arange(first, first + int(unknown.sum()))
    if len(np.unique(ids)) < len(ids):
        raise DataError(complaint("Frame", "boxes", "each object id once", "one twice"))
    return replace(boxes, object_id=ids)


def _sweep(name: str, points: ArrayLike, pose: NDArray[np.float64], time_s: float) -> Sweep:
    """Return the sweep of an array of points; DataError for another shape or range."""
    rows = np.asarray(points)
    if rows.ndim != 2 or rows.shape[1] < 3 or rows.dtype.kind not in "fiu":
        found = f"{rows.dtype} {rows.shape}"
        raise DataError(complaint("Frame", name, "numbers of shape (P, 3), (P, 4) or more columns", found))
    used = rows[:, :4].astype(np.float32)
    if not np.isfinite(used).all():
        raise DataError(complaint("Frame", name, "finite numbers", "nan or inf"))
    if used.shape[1] == 3:
        return make_sweep(used, pose, time_s)
    intensity = used[:, 3]
    if (intensity < 0.0).any() or (intensity > 1.0).any():
        found, hint = f"{intensity.min():g} to {intensity.max():g}", "; divide it by its full scale, such as 255"
        raise DataError(complaint("Frame", f"intensity of {name}", "0 to 1", found, hint))
    return make_sweep(used[:, :3], pose, time_s, intensity=intensity)


def agent_order(agent_ids: list[int]) -> list[int]:
    """Sort agents as the OPV2V tools do: by folder name as text, roadside units (negative) last."""
    return sorted(agent_ids, key=lambda a: (a < 0, str(a)))


def count_points(sweep: Sweep, object_ids: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return (N,) points of the sweep on each object of `object_ids` (N, sorted ascending)."""
    if len(object_ids) == 0:
        return np.zeros(0, np.int32)
    # Neighbours in a sweep mostly lie on the same object.
    start = np.flatnonzero(np.diff(sweep.object_id, prepend=sweep.object_id[:1] - 1))
    found, points = sweep.object_id[start], np.diff(start, append=len(sweep))
    slot = np.minimum(np.searchsorted(object_ids, found), len(object_ids) - 1)
    on = object_ids[slot] == found
    return np.bincount(slot[on], points[on], len(object_ids)).astype(np.int32)
