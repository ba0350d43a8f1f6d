"""Causes of crashes: an ego that drives at 10 m/s into a standing car, by when it knew of it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from dsrc.closed_loop.causes.braking import braked_way, last_chance
from dsrc.closed_loop.causes.cause import Cause, cause_of
from dsrc.closed_loop.driving.open import open_driver
from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.loop import ClosedLoop, LoopSettings
from dsrc.closed_loop.perception.open import open_perception
from dsrc.closed_loop.types import Decision, EgoState, LaneMap, Outcome, Percept, Tick, Tracks
from dsrc.messages.message import Told
from sim.contact import Contact, first_contact
from sim.traffic.base import Actors
from tests.dsrc.closed_loop.logged import EGO_ID, LIMITS, Mover, actors_at, ahead, episode, no_tracks, percept_of

OTHER = 1001
PARKED_M = 50.0
CRASH = 46
"""Step of the contact: the front of the ego reaches the rear of the car, 48 m ahead, after 4.6 s."""
CHANCE = 39
"""Braking from 10 m/s with 7.5 m/s2 in steps of 0.1 s takes 6.2 m: 7 m are left at 3.9 s, 6 m at 4.0 s."""
NEVER = 1000
MOVERS = (Mover("ego", ahead(10.0)), Mover("conflict", lambda _: (PARKED_M, 0.0), yaw=0.0))


def tracks_of(actors: Actors, rows: list[int]) -> Tracks:
    boxes = actors.boxes[np.array(rows)]
    n = len(rows)
    return replace(
        no_tracks(actors.time_s), boxes=boxes, velocity=np.zeros((n, 2)), yaw_rate=np.zeros(n),
        position_sd=np.zeros(n), score=np.ones(n), unseen_s=np.zeros(n),
    )  # fmt: skip


def crash(
    seen: int = 0, tracked: int = 0, braked: int = NEVER, change: Callable[[Tick], Tick] = lambda tick: tick,
    movers: tuple[Mover, ...] = MOVERS, **contact: object,
) -> EpisodeLog:  # fmt: skip
    """Log of the crash; the first box, the first track and the full braking are in these steps."""
    about = {"time_s": 4.6, "other_id": OTHER, "other": "conflict", "ego_speed_mps": 10.0, "closing_mps": 10.0}
    about |= {"delta_v_mps": 5.0, "side": "front", "at_fault": True}
    log = episode(movers, CRASH + 1, Outcome.CRASHED, contact=Contact(**(about | contact)))  # type: ignore[arg-type]
    ticks = []
    for step, tick in enumerate(log.ticks):
        percept: Percept = percept_of(tick.actors, [1] if step >= seen else [])
        tracks = tracks_of(tick.actors, [1]) if step >= tracked else tick.tracks
        brake = Decision(-LIMITS.deceleration_mps2, "emergency", OTHER) if step >= braked else tick.decision
        ticks.append(change(replace(tick, percept=percept, tracks=tracks, decision=brake)))
    return EpisodeLog(log.settings, log.actors[0], ticks, log.outcome)


def found(log: EpisodeLog, sight: int = 0) -> Cause:
    cause = cause_of(log, lambda now, object_id: now.time_s >= 0.1 * sight - 1e-6 and object_id == OTHER)
    assert cause is not None
    return cause


def test_full_braking_at_the_last_chance_stops_before_the_other_and_a_step_later_does_not() -> None:
    log = crash()
    assert last_chance(log) == CHANCE
    for step, stops in ((CHANCE, True), (CHANCE + 1, False)):
        # Its last metre is that of the textbook: v^2 / 2a, less half a step that SUMO's speeds are ahead.
        for even, way_m in ((True, 10.0**2 / 15.0), (False, 10.0**2 / 15.0 - 0.5)):
            _, boxes = braked_way(log.ticks[step].ego, 0.1, 5.0, even)
            assert boxes.center[-1, 0] - boxes.center[0, 0] == pytest.approx(way_m, abs=0.05)
            assert bool(boxes.center[-1, 0] + 2.0 < PARKED_M - 2.0) is stops


@pytest.mark.slow
@pytest.mark.parametrize("name", ["eebl_chain", "rilsa_1"])
def test_the_braked_way_is_the_one_that_the_traffic_drives(name: str) -> None:
    """An ego that brakes fully, in an encounter's script and in SUMO: the same places, step by step."""

    class Brakes:
        """Drives as the default driver, and brakes fully once it is fast and a second has passed."""

        def reset(self, lanes: LaneMap | None) -> None:
            self.before, self.steps, self.braking = open_driver("planning"), 0, False
            self.before.reset(lanes)

        def decide(self, ego: EgoState, tracks: Tracks) -> Decision:
            self.steps += 1
            self.braking = self.braking or (ego.speed_mps >= 9.0 and self.steps > 10)
            brake = Decision(-ego.limits.deceleration_mps2, "outside")
            return brake if self.braking else self.before.decide(ego, tracks)

    loop = ClosedLoop(name, open_perception("truth"), Brakes(), LoopSettings(duration_s=20.0))
    loop.run(0)
    log = loop.log(perception="truth")
    start = next(k for k, tick in enumerate(log.ticks) if tick.decision.reason == "outside")
    # A command moves the ego from the next step on.
    ego, times = log.ticks[start].ego, [tick.actors.time_s for tick in log.ticks[start:]]
    when, boxes = braked_way(ego, log.actors.step_s, times[-1], log.settings.scenario.conflict is not None)
    driven = np.array([tick.ego.box.center[0, :2] for tick in log.ticks[start:]])
    way = np.column_stack([np.interp(times, when, boxes.center[:, axis]) for axis in (0, 1)])
    assert np.hypot(*(driven[-1] - driven[0])) > 6.0
    assert np.abs(driven - way).max() < 0.1


def test_the_hand_made_crash_is_one() -> None:
    assert first_contact(actors_at(MOVERS, 4.5), actors_at(MOVERS, 4.65), EGO_ID) is not None
    assert first_contact(actors_at(MOVERS, 4.4), actors_at(MOVERS, 4.5), EGO_ID) is None


@pytest.mark.parametrize(
    ("times", "kind", "late_ms"),
    [
        ({"sight": CHANCE + 1, "seen": CHANCE + 1, "tracked": CHANCE + 1}, "unavoidable", None),
        ({"sight": NEVER, "seen": NEVER, "tracked": NEVER}, "unavoidable", None),
        ({"sight": 20, "seen": NEVER, "tracked": NEVER}, "missed", None),
        ({"sight": 20, "seen": CHANCE + 3, "tracked": CHANCE + 3}, "seen late", 300.0),
        ({"sight": 20, "seen": 30, "tracked": CHANCE + 2}, "tracked late", 200.0),
        ({"sight": 20, "seen": 30, "tracked": NEVER}, "tracked late", None),
        ({"sight": 20, "seen": 30, "tracked": 32, "braked": CHANCE + 1}, "braked late", 100.0),
        ({"sight": 20, "seen": 30, "tracked": 32}, "braked late", None),
        ({"sight": 20, "seen": 30, "tracked": 32, "braked": CHANCE - 1}, "braked too little", None),
        ({"sight": 20, "seen": CHANCE, "tracked": CHANCE, "braked": CHANCE + 1}, "braked late", 100.0),
    ],
)
def test_the_first_thing_after_the_last_chance_is_the_cause(
    times: dict[str, int], kind: str, late_ms: float | None
) -> None:
    sight = times.pop("sight")
    cause = found(crash(**times), sight)  # type: ignore[arg-type]
    assert cause.kind == kind
    assert (None if cause.late_s is None else 1000.0 * cause.late_s) == (late_ms and pytest.approx(late_ms))
    assert cause.sentence.startswith(kind) and "\n" not in cause.sentence
    if late_ms is not None:
        assert f"{kind} by {late_ms:.0f} ms: the car 1001" in cause.sentence
    if cause.chance_s is not None:
        assert cause.chance_s == pytest.approx(0.1 * (CRASH - CHANCE))


@pytest.mark.parametrize("tracked", [0, CHANCE + 1, NEVER])
@pytest.mark.parametrize("braked", [0, CHANCE + 1, NEVER])
@pytest.mark.parametrize("sight", [0, NEVER])
def test_with_the_truth_nobody_is_missed(tracked: int, braked: int, sight: int) -> None:
    # The truth has a box of everybody from the first step on, also of those that no LiDAR sees.
    cause = found(crash(0, tracked, braked), sight)
    assert cause.kind in ("tracked late", "braked late", "braked too little") and cause.sight_s == cause.seen_s


def test_where_no_braking_helps_the_crash_is_unavoidable_whatever_was_seen() -> None:
    # Who comes head-on does not stop for an ego that stands.
    oncoming = (MOVERS[0], Mover("conflict", lambda t: (PARKED_M + 20.0 * (4.6 - t), 0.0), yaw=np.pi))
    for braked in (0, NEVER):
        log = crash(0, 0, braked, movers=oncoming)
        assert last_chance(log) is None and found(log).kind == "unavoidable"


def test_a_track_that_was_lost_at_the_last_chance_came_late() -> None:
    def lost(tick: Tick) -> Tick:
        away = 3.0 < tick.actors.time_s < 4.25
        return replace(tick, tracks=no_tracks(tick.actors.time_s)) if away else tick

    cause = found(crash(0, 0, change=lost))
    assert cause.kind == "tracked late" and "was lost, and came back 0.3 s before" in cause.sentence
    assert cause.late_s == pytest.approx(0.4)


def test_a_false_report_that_the_driver_drove_for_is_named_by_its_helper() -> None:
    def told(tick: Tick) -> Tick:
        ghost = actors_at([Mover("ghost", lambda _: (80.0, 0.0), yaw=0.0)], tick.actors.time_s)
        ghost = replace(ghost, boxes=replace(ghost.boxes, object_id=np.array([77])))
        return replace(
            tick,
            claims={"helper": ghost},
            tracks=replace(tracks_of(tick.actors, [1]), boxes=ghost.boxes),
            decision=Decision(-4.0, "follow", 77),
        )

    movers = (*MOVERS, Mover("helper", lambda _: (90.0, 8.0), yaw=0.0))
    behind = crash(change=told, movers=movers, side="rear", at_fault=False)
    assert found(behind).kind == "told wrongly" and "told wrongly by helper 1002:" in found(behind).sentence
    # The same decision without a report is nobody's lie.
    honest = crash(change=lambda t: replace(told(t), claims={}), movers=movers, side="rear", at_fault=False)
    assert found(honest).kind == "hit from behind"

    def attacked(tick: Tick, caught: int) -> Tick:
        said = tuple(Told(helper, 3, 2, caught, caught, True) for helper in (1002, -1))
        assert tick.percept is not None
        return replace(told(tick), claims={}, percept=replace(tick.percept, told=said))

    lie, refused = (
        found(crash(change=lambda t, n=n: attacked(t, n), movers=movers, side="rear", at_fault=False)) for n in (1, 2)
    )
    assert "told wrongly by helpers 1002 and -1:" in lie.sentence and refused.kind == "hit from behind"


def test_the_world_and_a_rear_end_have_causes_of_their_own_and_an_arrival_none() -> None:
    assert found(crash(other_id=-1, other="world")).kind == "hit the world"
    assert found(crash(side="rear", at_fault=False)).kind == "hit from behind"
    assert cause_of(episode(MOVERS, 10, Outcome.ARRIVED), lambda *_: True) is None
