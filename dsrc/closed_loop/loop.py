"""Closed loop of one ego: sense, detect, track, decide, act, move, judge.

Perception and driver never see the ground truth of a step: the perception of a detector gets sweeps, the driver gets
tracks. One seed gives one episode, bit for bit, in every process.
"""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from dsrc.closed_loop.driving.bicycle import bicycle_step, wheels_of
from dsrc.closed_loop.driving.lanes import lanes_of
from dsrc.closed_loop.driving.own.checked import CheckedDriver
from dsrc.closed_loop.driving.planner import PlanningDriver
from dsrc.closed_loop.ego import choose_ego, ego_state, without_ego
from dsrc.closed_loop.ego_faults import EgoFaults
from dsrc.closed_loop.encounter import lost_encounter
from dsrc.closed_loop.log import EpisodeLog, EpisodeSettings
from dsrc.closed_loop.tracking.tracker import Tracker
from dsrc.closed_loop.types import Decision, Driver, EgoState, Outcome, Percept, Perception, Tick
from dsrc.faults.fault import Faults, faults_text
from sensors.recording.encounter_check import CONFLICT_ID, with_proven_encounter
from sensors.recording.static_scene import solid_world
from sim.catalog.load import load_scenario
from sim.contact import Contact, SolidWorld, first_contact, world_contact
from sim.errors import SettingsError, TrafficError, UserError, complaint, raised_text
from sim.scenario import Scenario
from sim.traffic.base import Actors, DrivableTraffic
from sim.world.standing import open_standing

_FARTHEST = 1e6
"""Largest coordinate and speed of a valid percept, m and m/s."""
_STILL_MPS = 0.1
_AT_LIGHT_M = 40.0
"""Distance to a red light within which standing is waiting, m."""


class LoopSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the closed loop.

    Attributes:
        duration_s: longest episode, s.
        detect_every_s: interval of detections, s, a multiple of the traffic's step; tracks are predicted between.
        latency_s: time from a measurement to its percept, s.
        look_ahead_s: reaction time of the stopping distance that a detector's range is shifted ahead to cover, s, by
            half its reach at most; 0 for that of the perception, which is opened with it.
        stuck_s: time of standing without a red light after which an episode ends, s; it must have moved before.
        perception_limit_s: longest computation of one percept, and of one decision, s of wall time.

    Raises:
        SettingsError: a time is not finite, below 0, or 0 where only the latency and the look ahead may be.
    """

    duration_s: float = 20.0
    detect_every_s: float = 0.1
    latency_s: float = 0.0
    look_ahead_s: float = 0.0
    stuck_s: float = 8.0
    perception_limit_s: float = 60.0

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            value, may_be_zero = getattr(self, name), name in ("latency_s", "look_ahead_s")
            if not math.isfinite(value) or value < 0.0 or (value == 0.0 and not may_be_zero):
                expected = "seconds >= 0" if may_be_zero else "seconds > 0"
                raise SettingsError(complaint("loop", name, expected, f"{value:g}"))


class PerceptionClock:
    """Schedule of a perception in one episode: when it measures and when a percept arrives.

    Attributes:
        failure: why the perception failed, "" as long as it works.

    Args:
        settings: interval, latency and limit of time.
        step_s: traffic step, s.
        own: faults of the ego's computing.

    Raises:
        SettingsError: the interval of detections is no multiple of the step.
    """

    def __init__(self, perception: Perception, settings: LoopSettings, step_s: float, own: EgoFaults) -> None:
        self.failure, self._own = "", own
        self._perception, self._settings = perception, settings
        steps = settings.detect_every_s / step_s
        self._every = max(1, round(steps))
        if abs(steps - self._every) > 1e-6:
            expected = f"a multiple of the traffic's step of {step_s:g} s"
            raise SettingsError(complaint("drive", "detect_every_s", expected, f"{settings.detect_every_s:g}"))
        self._steps, self._step_s = 0, step_s
        self._waiting: list[tuple[float, Percept]] = []

    def begin(self, scenario: Scenario, ego_id: int, seed: int) -> None:
        """Reset the perception for an episode.

        Raises:
            UserError: a setting of the perception does not fit the scenario.
        """
        self._ego_id = ego_id
        try:
            self._perception.reset(scenario, ego_id, seed)
        except UserError:
            raise
        except Exception as error:  # a perception of one's own may raise anything, and the campaign goes on
            self.failure = raised_text(error)

    def percept(self, before: Actors, now: Actors, claims: dict[str, Actors], ego: EgoState) -> Percept | None:
        """Return the percept that arrives at the next step: of this instant, or of an earlier one with a latency.

        None without one, and after a failure, such as a fault on an id that is no agent of this episode.

        Args:
            claims: false objects that helpers report.
            ego: as it is now, for attackers.
        """
        if self._steps % self._every == 0 and not self.failure:
            began = time.perf_counter()
            try:
                if (aim := getattr(self._perception, "aim", None)) is not None:
                    aim(ego)
                percept = checked_percept(self._perception.perceive(before, now, claims), now.time_s)
            except Exception as error:  # as in `begin`
                self.failure = raised_text(error)
                return None
            if (took_s := time.perf_counter() - began) > self._settings.perception_limit_s:
                self.failure = f"took {took_s:.0f} s, limit {self._settings.perception_limit_s:g} s"
                return None
            time_s = self._steps * self._step_s
            if not getattr(self._perception, "believes", False):
                row = now.row(self._ego_id)
                percept = self._own.believed_percept(percept, now.boxes[row : row + 1], time_s)
            if not self._own.missed(time_s):
                self._waiting.append((self._own.latency_s(time_s, self._settings.latency_s), percept))
        elif (overhear := getattr(self._perception, "overhear", None)) is not None and not self.failure:
            try:
                overhear(before, now, claims)
            except Exception as error:  # as in `begin`
                self.failure = raised_text(error)
        self._steps += 1
        there = [now.time_s - percept.time_s >= latency_s - 1e-6 for latency_s, percept in self._waiting]
        if not any(there):
            return None
        newest = max(number for number, arrived in enumerate(there) if arrived)
        arrived = self._waiting[newest][1]
        del self._waiting[: newest + 1]  # whoever comes later and is older is of no use
        return arrived


class ClosedLoop:
    """Episodes of one ego with a perception and a driver.

    Attributes:
        scenario: of the current episode, with its proven encounter.
        ticks: everything of the current episode, step by step.
        outcome: how it ended; None while it runs.
        message: explanation of a failed perception or driver.
        seconds: wall time by stage of the current episode, s.

    Args:
        scenario: name, path or struct.
        driver: decides where `advance` is not given an acceleration; default: `PlanningDriver`.
        settings: intervals and limits of time.
    """

    def __init__(
        self,
        scenario: str | Scenario,
        perception: Perception,
        driver: Driver | None = None,
        settings: LoopSettings | None = None,
    ) -> None:
        self.base = load_scenario(scenario) if isinstance(scenario, str) else scenario
        self.scenario = self.base
        self.perception = perception
        self.driver = driver or PlanningDriver()
        self.settings = _agreed(perception, settings or LoopSettings())
        self._faults: Faults = getattr(perception, "faults", ())
        self.ticks: list[Tick] = []
        self.outcome: Outcome | None = None
        self.message = ""
        self.seconds: dict[str, float] = {}
        self._traffic: DrivableTraffic | None = None

    @property
    def traffic(self) -> DrivableTraffic:
        """The running traffic; TrafficError without one."""
        if self._traffic is None:
            raise TrafficError("expected a closed loop that was started, found one without running traffic")
        return self._traffic

    @property
    def tick(self) -> Tick:
        """The present step."""
        return self.ticks[-1]

    def start(self, seed: int) -> Tick:
        """Begin the episode of a seed: open its traffic, choose the ego and perceive for the first time.

        Raises:
            ScenarioError: network, demand or encounter is invalid.
            TrafficError: another simulation runs in this process, or no vehicle can be the ego.
        """
        self.close()
        scenario = with_proven_encounter(self.base, seed)
        self._traffic = traffic = open_standing(scenario, seed)
        self.board(scenario, traffic, choose_ego(traffic, scenario), seed)
        traffic.step()
        return self.look()

    def board(self, scenario: Scenario, traffic: DrivableTraffic, ego_id: int, seed: int) -> None:
        """Begin an episode with a vehicle of traffic that the caller has opened and steps once before `look`.

        Args:
            scenario: of the traffic, with its proven encounter.

        Raises:
            UserError: a setting of the perception does not fit the scenario.
        """
        self.scenario, self._traffic, self.ego_id = scenario, traffic, ego_id
        self.ticks, self.outcome, self.message, self.seconds = [], None, "", {}
        self._tracker, self._stood_s, self._moved = Tracker(), 0.0, False
        self._own = EgoFaults(self._faults, seed, self.ego_id, traffic.step_s)
        self._clock = PerceptionClock(self.perception, self.settings, traffic.step_s, self._own)
        self._world: SolidWorld | None = None
        self._wheel = CheckedDriver(self.driver, self.settings.perception_limit_s)
        self._wheel.reset(lanes_of(self.scenario, seed))
        with self._timed("reset"):
            self._clock.begin(self.scenario, self.ego_id, seed)
        self.seed, self._route_m = seed, traffic.goal_m(self.ego_id)
        self._first = traffic.actors
        traffic.command(self.ego_id, traffic.speed(self.ego_id))

    def look(self) -> Tick:
        """Perceive for the first time, one traffic step after `board`."""
        self.start_s = self.traffic.actors.time_s
        self._observe(self._first, ego_state(self.traffic, self.ego_id, None), None)
        return self.tick

    def advance(self, acceleration_mps2: float | None = None, steering_rad: float | None = None) -> Tick:
        """Act for one traffic step, then move, judge, perceive, track and decide.

        An ego that steers ends its episode where it touches the static world or leaves the lanes.

        Args:
            acceleration_mps2: in place of the driver's decision, m/s2; the vehicle's limits bound it.
            steering_rad: with it, see `Decision`.

        Raises:
            ValueError: the acceleration or the steering is not finite.
            TrafficError: the episode has not begun or has ended.
        """
        self.act(acceleration_mps2, steering_rad)
        before = self.traffic.actors
        with self._timed("move"):
            self.traffic.step()
        return self.arrive(before)

    def act(self, acceleration_mps2: float | None = None, steering_rad: float | None = None) -> None:
        """Command the ego for the next traffic step, see `advance`; `arrive` follows that step."""
        last = self._running()
        if acceleration_mps2 is None and steering_rad is not None:
            raise ValueError(f"steering_rad comes with acceleration_mps2, got {steering_rad} alone")
        if acceleration_mps2 is not None:
            for name, value in (("acceleration_mps2", acceleration_mps2), ("steering_rad", steering_rad or 0.0)):
                if not math.isfinite(value):
                    raise ValueError(f"{name} must be finite, got {value}")
            last = replace(last, decision=Decision(acceleration_mps2, steering_rad=steering_rad))
            self.ticks[-1] = last
        ego, step_s = last.ego, self.traffic.step_s
        wanted = ego.limits.bounded(last.decision.acceleration_mps2), last.decision.steering_rad
        acted, steering = self._own.acted(wanted, last.actors.time_s - self.start_s)
        made = ego.limits.bounded(acted)
        if steering is None:
            self.traffic.command(self.ego_id, max(0.0, ego.speed_mps + made * step_s))
            return
        pose = np.array([[*ego.box.center[0, :2], ego.box.yaw[0]]])
        speed, gained, wanted_rad = (np.array([value]) for value in (ego.speed_mps, made, steering))
        wheels, length_m = wheels_of(self.ticks[-2:][0].ego, ego), float(ego.box.size[0, 0])
        pose, speed, _ = bicycle_step(pose, speed, wheels, gained, wanted_rad, length_m, step_s)
        self.traffic.place(self.ego_id, pose[0, :2], float(pose[0, 2]), float(speed[0]))
        if self._world is None:
            self._world = solid_world(self.scenario, self.seed)

    def _running(self) -> Tick:
        if self.outcome is not None:
            raise TrafficError(f"expected a running episode, found one that ended: {self.outcome.value}")
        return self.tick

    def arrive(self, before: Actors) -> Tick:
        """Judge, perceive, track and decide after a traffic step.

        Args:
            before: actors before the step.
        """
        traffic, last, now = self.traffic, self.tick, self.traffic.actors
        if self.ego_id not in now.boxes.object_id:
            self.ticks.append(Tick(now, last.ego, None, last.tracks, Decision(0.0)))
            self.outcome = self._checked(Outcome.ARRIVED)
            return self.tick
        with self._timed("judge"):
            contact = first_contact(before, now, self.ego_id)
            if contact is None and self._world is not None:
                contact = world_contact(before, now, self.ego_id, self._world)
        self._observe(before, ego_state(traffic, self.ego_id, last.ego), contact)
        self.outcome = self.outcome or self._judge()
        return self.tick

    def run(self, seed: int, watch: Callable[["ClosedLoop"], None] | None = None) -> Outcome:
        """Drive a whole episode by the driver's decisions and return its outcome.

        Args:
            watch: called with the loop after every step.
        """
        self.start(seed)
        try:
            while self.outcome is None:
                if watch is not None:
                    watch(self)
                self.advance()
            if watch is not None:
                watch(self)
        finally:
            self.close()
        assert self.outcome is not None
        return self.outcome

    def log(self, **names: Any) -> EpisodeLog:
        """Return the log of an episode that has ended.

        Args:
            names: further fields of `EpisodeSettings`: perception, detector, driver, corruption, severity, family,
                who, channel, engine, fault and defence (else those of the perception), versions.
        """
        if self.outcome is None:
            raise TrafficError("expected an episode that has ended, found a running one")
        settings = EpisodeSettings(
            scenario=self.scenario,
            seed=self.seed,
            ego_id=self.ego_id,
            loop=msgspec.to_builtins(self.settings),
            route_m=self._route_m,
            **{
                "engine": getattr(self.perception, "engine", "fused"),
                "fault": faults_text(self._faults),
                "defence": ",".join(getattr(self.perception, "defence", ())),
                **names,
            },
        )
        return EpisodeLog(settings, self._first, self.ticks, self.outcome, self.message)

    def close(self) -> None:
        """End the traffic; ticks and outcome stay."""
        if self._traffic is not None:
            self._traffic.close()
            self._traffic = None

    def _observe(self, before: Actors, ego: EgoState, contact: Contact | None) -> None:
        """Perceive, track and decide; append the step."""
        traffic, now = self.traffic, self.traffic.actors
        claims = traffic.claims()
        with self._timed("perceive"):
            percept = self._clock.percept(before, now, claims, ego)
        if self._clock.failure:
            self.outcome, self.message = Outcome.PERCEPTION_FAILED, self._clock.failure
        percept = self._wheel.shown(percept)
        with self._timed("track"):
            others = None if percept is None else without_ego(percept, self._known(self._ego_at(percept.time_s, ego)))
            tracks = self._tracker.update(others, now.time_s)
        with self._timed("decide"):
            decision = self._wheel.decide(self._known(ego), tracks) if contact is None else Decision(0.0)
        if self._wheel.failure and contact is None and self.outcome is None:
            self.outcome, self.message = Outcome.DRIVER_FAILED, self._wheel.failure
        self.ticks.append(Tick(now, ego, percept, tracks, decision, claims, contact))

    def _known(self, ego: EgoState) -> EgoState:
        """Return a state of the ego as it believes it to be."""
        return self._own.believed(ego, ego.time_s - self.start_s)

    def _ego_at(self, time_s: float, now: EgoState) -> EgoState:
        """Return the ego's state at a time of this episode, the nearest one."""
        return min([*(tick.ego for tick in self.ticks[-20:]), now], key=lambda ego: abs(ego.time_s - time_s))

    def _judge(self) -> Outcome | None:
        """Return how the episode ends with the present step; None while it runs."""
        tick, traffic = self.tick, self.traffic
        if tick.contact is not None:
            return Outcome.CRASHED
        if self._world is not None and tick.actors.lane[tick.actors.row(self.ego_id)] == "":
            return Outcome.LEFT
        goal_m = traffic.goal_m(self.ego_id)
        if goal_m is not None and goal_m <= 0.0:
            return self._checked(Outcome.ARRIVED)
        still = tick.ego.speed_mps < _STILL_MPS
        self._moved |= not still
        lights = tick.ego.lights
        held = bool(lights) and lights[0].state != "green" and lights[0].distance_m < _AT_LIGHT_M
        self._stood_s = self._stood_s + traffic.step_s if still and self._moved and not held else 0.0
        if self._stood_s >= self.settings.stuck_s - 1e-6:
            return self._checked(Outcome.STUCK)
        if tick.actors.time_s - self.start_s >= self.settings.duration_s - 1e-6:
            return self._checked(Outcome.TIMEOUT)
        return None

    def _checked(self, outcome: Outcome) -> Outcome:
        """Return the outcome, or that the ego never met its encounter."""
        gap_s = self.traffic.encounter_gap_s(self.ego_id)
        if gap_s is not None and lost_encounter(self.ticks, self.ego_id, CONFLICT_ID, gap_s):
            return Outcome.DESYNCHRONISED
        return outcome

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        began = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - began


def checked_percept(percept: Percept, now_s: float) -> Percept:
    """Return a percept whose values are valid.

    Args:
        percept: as returned by a perception.
        now_s: the present, s.

    Raises:
        ValueError: it is no `Percept`, it is of the future, a value is not finite, beyond `_FARTHEST` or out of its
            range, a size is not positive, or the lengths differ.
    """
    if not isinstance(percept, Percept):
        raise ValueError(f"expected a Percept, found {type(percept).__name__}")
    boxes, n = percept.boxes, len(percept.boxes)
    if not (np.isfinite(boxes.array).all() and np.isfinite(percept.time_s)):
        raise ValueError("expected finite boxes, found NaN or infinity")
    if percept.time_s > now_s + 1e-6:
        raise ValueError(f"expected a percept up to {now_s:g} s, found one of {percept.time_s:g} s")
    if (np.abs(boxes.array) > _FARTHEST).any():
        raise ValueError(f"expected boxes within {_FARTHEST:g} m, found one beyond")
    if (boxes.size <= 0.0).any():
        raise ValueError("expected boxes with sizes > 0, found one without")
    if percept.score.shape != (n,) or not ((percept.score >= 0.0) & (percept.score <= 1.0)).all():
        raise ValueError(f"expected {n} scores between 0 and 1, found {np.shape(percept.score)} or others")
    if percept.velocity.shape != (n, 2) or (np.abs(percept.velocity) > _FARTHEST).any():
        found = f"{percept.velocity.shape} or others"
        raise ValueError(f"expected velocities of shape {(n, 2)}, NaN or finite, found {found}")
    return percept


def _agreed(perception: Perception, settings: LoopSettings) -> LoopSettings:
    """Return the settings with the shift of the range that a perception was opened with.

    Raises:
        SettingsError: they ask for another one, or for another interval than the one that messages are timed by.
    """
    own = getattr(perception, "look_ahead_s", settings.look_ahead_s)
    if settings.look_ahead_s not in (0.0, own):
        expected = f"that of the perception, {own:g}, or 0"
        raise SettingsError(complaint("drive", "look_ahead_s", expected, f"{settings.look_ahead_s:g}"))
    interval_s = getattr(perception, "interval_s", None)
    if interval_s is not None and not math.isclose(interval_s, settings.detect_every_s):
        expected = f"that of the perception, {interval_s:g} (`interval_s` of open_perception)"
        raise SettingsError(complaint("drive", "detect_every_s", expected, f"{settings.detect_every_s:g}"))
    return msgspec.structs.replace(settings, look_ahead_s=own)
