"""EpisodeSource: an episode of the closed loop, recorded or running: what its ego saw, believed and planned."""

import contextlib
import logging

import msgspec
import numpy as np
from numpy.typing import NDArray

from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.perception.recast import RecastSenses, recast_senses
from dsrc.closed_loop.types import EgoState, Percept, Tick
from dsrc.evaluation.detection_table import DetectionTable, one_frame
from dsrc.ops.detections import Detections
from dsrc.review.sources.base import Kind, MemorySet, Source
from dsrc.review.sources.live import KEPT
from dsrc.review.sources.meeting import meeting_of
from dsrc.review.sources.moment import RUNNING, EpisodeMoment, EpisodeTimeline, Links
from sensors.corruptions import CLEAN
from sensors.frame import AgentFrame, Frame, count_points
from sensors.sweep import make_sweep
from sim.boxes import CLASSES, Boxes, concatenate
from sim.contact import Contact
from sim.errors import DataError, UserError, complaint
from sim.geometry import invert, pose_matrix
from sim.radio.spec import IDEAL
from sim.scenario import Scenario
from sim.traffic.base import Actors

_logger = logging.getLogger(__name__)

PERCEPTS, TRACKS = "percepts", "tracks"
"""Names of the sets of detections of an episode."""
RANGE_M = 70.0
"""Distance from the ego within which percepts and tracks are judged, m: the communication range."""
PLAN_S = 3.0
"""Duration of the drawn plan, s."""
_PLAN_STEP_S = 0.1
_LIDAR_M = 1.9
"""Height of a LiDAR on the ego, where the pose of its sweeps is not handed over, m."""


class EpisodeSource(Source):
    """Frames of an episode, which may still run: road users as ground truth, percepts and tracks as detections.

    Agents have points where sweeps are handed over, in the latest frames.

    Attributes: those of `Source`, and
        protocol: names the scenario, see `place`; empty before that.
        sets: `PERCEPTS` and `TRACKS`.
        senses: casts the sweeps of the log again once they are open; None without a log, or where it has none.
    """

    kind: Kind = "episode"
    labelled = True

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.ended = False
        self._percept_set, self._track_set = MemorySet(PERCEPTS), MemorySet(TRACKS)
        self.sets = {PERCEPTS: self._percept_set, TRACKS: self._track_set}
        self._ticks: list[Tick] = []
        self._percepts: list[Percept | None] = []
        self._lidars: list[NDArray[np.float64]] = []
        self._sensed: dict[int, Frame] = {}
        self._ego_id, self._outcome, self._message = -1, RUNNING, ""
        self.senses: RecastSenses | None = None

    def put(
        self, tick: Tick, ego_id: int, sensed: Frame | None = None, lidar: NDArray[np.float64] | None = None
    ) -> None:
        """Add the next step.

        Args:
            sensed: sweeps behind the newest percept; None without any.
            lidar: (4, 4) world pose of the ego's LiDAR behind it, where they are cast later.
        """
        row, before = len(self._ticks), self._percepts[-1] if self._percepts else None
        newest = tick.percept if tick.percept is not None else before
        boxes, score = (Boxes.zeros(), np.zeros(0)) if newest is None else (newest.boxes, newest.score)
        self._ego_id = ego_id
        usual = _body(tick.ego) @ pose_matrix([0.0, 0.0, _LIDAR_M]) if lidar is None else lidar
        self._lidars.append(usual if sensed is None else sensed.agent(ego_id).sweep.world_from_lidar)
        self._percept_set.put(row, self._judged(row, tick, boxes, score))
        self._track_set.put(row, self._judged(row, tick, tick.tracks.boxes, tick.tracks.score))
        self._percepts.append(newest)
        if sensed is not None:
            self._sensed[row] = sensed
        # Few steps have sweeps, and not every so many: the oldest are known by their number.
        for old in [known for known in self._sensed if known <= row - KEPT]:
            del self._sensed[old]
        self._ticks.append(tick)  # last: whoever counts the steps finds all of them

    def place(self, scenario: Scenario, seed: int) -> None:
        """Name the scenario and the seed whose static world surrounds the episode."""
        self.protocol = {"testbed": {"scenario": msgspec.to_builtins(scenario), "seed": seed}}

    def end(self, outcome: str = "stopped", message: str = "") -> None:
        """Mark that no more steps come; the first outcome stays."""
        if not self.ended:
            self._outcome, self._message = outcome, message
        self.ended = True

    def explain(self) -> None:
        """Build the world of an episode that has ended, cast its sweeps from now on, and find why it crashed."""
        if self.senses is not None:
            with contextlib.suppress(UserError):  # that the world is not drawn is told
                self.senses.open()
                self.version = 1
        if self.log is not None and self.meeting is not None:
            self.meeting.explain(self.log)

    def __len__(self) -> int:
        return len(self._ticks)

    def read(self, row: int) -> Frame:
        """Return the road users of a step, with the sweeps behind the percept where they are known or can be cast.

        Raises:
            DataError: the step has not come yet.
        """
        outline = self.outline(row)
        if self.senses is None or not self.senses.ready:
            return outline
        try:
            return self._frame(row, self.senses.agents(row))
        except UserError as error:
            _logger.warning("%s: %s", self.name, error)
            return outline

    def outline(self, row: int) -> Frame:
        """Return the road users of a step, with sweeps where they were handed over; raises as `read`."""
        if not 0 <= row < len(self):
            expected = f"0 to {len(self) - 1}" if len(self) else "a first frame to come"
            raise DataError(complaint(self.name, "frame", expected, row))
        tick, sensed = self._ticks[row], self._sensed.get(row)
        actors = tick.actors
        empty = make_sweep(np.zeros((0, 3)), self._lidars[row], actors.time_s)
        alone = AgentFrame(self._ego_id, "vehicle", _body(tick.ego), tick.ego.speed_mps, empty)
        return self._frame(row, (alone,) if sensed is None else sensed.agents)

    def _frame(self, row: int, agents: tuple[AgentFrame, ...]) -> Frame:
        actors = self._ticks[row].actors
        return Frame(
            index=row,
            time_s=actors.time_s,
            agents=agents,
            truth=actors.boxes,
            velocity=actors.velocity,
            points_on=np.stack([count_points(agent.sweep, actors.boxes.object_id) for agent in agents]),
            acceleration=actors.acceleration,
            signals=actors.signals,
            lane=actors.lane,
        )

    def moment(self, row: int) -> EpisodeMoment:
        """Return what the ego saw, believed and planned at a step."""
        tick, newest = self._ticks[row], self._percepts[row]
        claims = list(tick.claims.items())
        return EpisodeMoment(
            time_s=tick.ego.time_s,
            plan=planned_way(tick.ego, tick.decision.acceleration_mps2),
            route=tick.ego.route,
            percept_age_s=np.nan if newest is None else tick.ego.time_s - newest.time_s,
            tracks=tick.tracks.boxes,
            track_velocity=tick.tracks.velocity,
            links=_links(newest, tick.actors, tick.ego),
            claims=concatenate([actors.boxes for _, actors in claims]),
            claimed_by=tuple(name for name, actors in claims for _ in range(len(actors))),
            acceleration_mps2=tick.decision.acceleration_mps2,
            reason=tick.decision.reason,
            decisive=tick.decision.track,
            contact=tick.contact,
            touched="" if tick.contact is None else _name(tick.contact, tick.actors),
        )

    def timeline(self) -> EpisodeTimeline:
        """Return the course of the episode so far."""
        ticks = self._ticks[:]
        return EpisodeTimeline(
            time_s=np.array([tick.ego.time_s for tick in ticks]),
            speed_mps=np.array([tick.ego.speed_mps for tick in ticks]),
            wanted_mps2=np.array([tick.decision.acceleration_mps2 for tick in ticks]),
            acceleration_mps2=np.array([tick.ego.acceleration_mps2 for tick in ticks]),
            contact_row=next((row for row, tick in enumerate(ticks) if tick.contact is not None), None),
            closing_mps=next((tick.contact.closing_mps for tick in ticks if tick.contact is not None), 0.0),
            outcome=self._outcome,
            message=self._message,
        )

    def _judged(self, row: int, tick: Tick, boxes: Boxes, score: NDArray[np.float64]) -> DetectionTable:
        """Table of a step: boxes and road users around the ego, in the frame of its LiDAR."""
        body_from_world, lidar_from_world = invert(_body(tick.ego)), invert(self._lidars[row])
        found, truth = (every.transform(body_from_world).center[:, :2] for every in (boxes, tick.actors.boxes))
        # Helpers see the ego, which looks for others: its own box is no object, so a detection of it is no error.
        own = (np.abs(found) <= 0.5 * tick.ego.box.size[0, :2]).all(axis=1)
        near = (np.hypot(*found.T) <= RANGE_M) & ~own
        judged = (np.hypot(*truth.T) <= RANGE_M) & (tick.actors.boxes.object_id != self._ego_id)
        # A score is a confidence of 0 to 1 in the log's resolution.
        kept = np.clip(score[near], 0.0, 1.0).astype(np.float32)
        detections = Detections(boxes[near].transform(lidar_from_world), kept)
        return one_frame(row, row, self._ego_id, detections, tick.actors.boxes[judged].transform(lidar_from_world))


def episode_source(log: EpisodeLog) -> EpisodeSource:
    """Source of an episode that has ended, named by scenario, perception, driver and fault, if not the usual, and seed.

    Raises:
        DataError: the episode has no step.
    """
    settings = log.settings
    channel = "" if settings.channel == IDEAL else settings.channel
    named = [settings.condition.label if settings.corruption != CLEAN else "", channel, settings.fault]
    fault = " + ".join(filter(None, named))
    unusual = "" if settings.driver == "planning" else settings.driver, fault
    parts = settings.scenario.name, settings.perception, *filter(None, unusual), f"seed {settings.seed}"
    source = EpisodeSource(", ".join(parts))
    if len(log) == 0:
        raise DataError(complaint(source.name, "steps", "at least one", "none"))
    source.place(settings.scenario, settings.seed)
    source.fault = fault or CLEAN
    senses = recast_senses(log)
    for row, tick in enumerate(log.ticks):
        there = senses is not None and settings.ego_id in tick.actors.boxes.object_id
        source.put(tick, settings.ego_id, lidar=senses.lidar(row) if senses is not None and there else None)
    source.end(str(log.outcome), log.message)
    source.log, source.senses, source.meeting = log, senses, meeting_of(log)
    return source


def planned_way(ego: EgoState, acceleration_mps2: float) -> NDArray[np.float64]:
    """(K, 4) x, y, z, m, and speed, m/s, of the ego on its route under a constant acceleration, until it stands.

    Args:
        ego: its state; the route begins near its centre.
        acceleration_mps2: of the next `PLAN_S` seconds.
    """
    centre = np.append(ego.box.center[0, :2], ego.box.center[0, 2] - 0.5 * ego.box.size[0, 2])
    if len(ego.route) < 2:
        return np.array([[*centre, ego.speed_mps]])
    times = np.arange(0.0, PLAN_S + 1e-9, _PLAN_STEP_S)
    speed = np.maximum(ego.speed_mps + acceleration_mps2 * times, 0.0)
    way = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * _PLAN_STEP_S)])
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(ego.route, axis=0), axis=1))])
    keep = np.append(True, np.diff(way) > 0.0) & (way <= along[-1])
    x, y = (np.interp(way[keep], along, ego.route[:, axis]) for axis in (0, 1))
    return np.stack([x, y, np.full(len(x), centre[2]), speed[keep]], axis=1)


def _body(ego: EgoState) -> NDArray[np.float64]:
    """World pose of the centre of the ego's footprint."""
    foot = ego.box.center[0] - [0.0, 0.0, 0.5 * ego.box.size[0, 2]]
    return np.asarray(pose_matrix(foot, ego.box.yaw[0]), np.float64)


def _name(contact: Contact, actors: Actors) -> str:
    """Displayed name of what is touched: class and number of a road user."""
    if contact.other_id not in actors.boxes.object_id:
        return contact.other
    return f"{CLASSES[actors.boxes.label[actors.row(contact.other_id)]]} {contact.other_id}"


def _links(percept: Percept | None, actors: Actors, ego: EgoState) -> Links:
    links = () if percept is None else percept.links
    places = dict(zip(actors.boxes.object_id.tolist(), actors.boxes.center, strict=True))
    unknown = np.full(3, np.nan)
    line = [[places.get(link.sender, unknown), ego.box.center[0]] for link in links]
    received = np.array([link.received for link in links], bool)
    names = ["roadside unit" if link.sender < 0 else "helper" for link in links]
    senders = tuple(f"{name} {abs(link.sender)}" for name, link in zip(names, links, strict=True))
    age_s = np.array([link.age_s for link in links], np.float64)
    return Links(np.array(line, np.float64).reshape(-1, 2, 3), received, senders, age_s)
