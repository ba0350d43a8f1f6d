"""First sight of the conflict actor, and age and volume of information, in episodes made by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest

from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.metrics.sight import first_sight, information, tracking_loss
from dsrc.closed_loop.types import Percept
from sim.radio import Link, Obstruction
from sim.traffic.base import Actors
from tests.dsrc.closed_loop.logged import Mover, ahead, episode, percept_of

MOVERS = [Mover("ego", ahead(10.0)), Mover("conflict", ahead(0.0, x=34.0))]


def test_the_first_sight_is_the_first_percept_that_has_a_box_of_the_conflict_actor() -> None:
    log = episode(MOVERS, 10, sees=lambda now: percept_of(now, [1] if now.time_s > 0.45 else []))
    sight = first_sight(log)
    # After 0.5 s the front is 30 - 5 m away from the rear of a standing car, at 10 m/s.
    assert (sight.seen_s, sight.seen_ttc_s) == (pytest.approx(0.5), pytest.approx(2.5))
    assert math.isnan(sight.tracked_s)


@pytest.mark.parametrize(("off_m", "seen"), [(1.9, True), (2.1, False)])
def test_a_box_is_of_the_conflict_actor_within_two_metres(off_m: float, seen: bool) -> None:
    def sees(now: Actors) -> Percept:
        percept = percept_of(now, [1])
        boxes = replace(
            percept.boxes, center=percept.boxes.center + np.array([0.0, off_m, 0.0]), object_id=np.array([-1])
        )
        return replace(percept, boxes=boxes)

    assert math.isnan(first_sight(episode(MOVERS, 3, sees=sees)).seen_s) != seen


def test_a_late_percept_is_compared_with_where_the_actor_was_and_counts_when_it_arrived() -> None:
    """The actor moves 2 m per step: compared with its present place, a percept of three steps ago would not match."""
    movers = [Mover("ego", ahead(1.0)), Mover("conflict", ahead(20.0, x=50.0))]
    bare = episode(movers, 8)
    ticks = [
        replace(tick, percept=percept_of(bare.ticks[k - 3].actors, [1]) if k >= 3 else None)
        for k, tick in enumerate(bare.ticks)
    ]
    log = EpisodeLog(bare.settings, bare.actors[0], ticks, bare.outcome)
    assert first_sight(log).seen_s == pytest.approx(0.3)
    assert information(log).age_s == pytest.approx(0.3)


def test_without_a_conflict_actor_there_is_nothing_to_see() -> None:
    log = episode([Mover("ego", ahead(1.0)), Mover("car", ahead(1.0, x=9.0))], 3, sees=lambda now: percept_of(now, [1]))
    assert math.isnan(first_sight(log).seen_s)


def test_the_risk_of_tracking_loss_is_the_inverse_time_to_collision_over_the_time_without_a_track() -> None:
    """At 10 m/s the rear of a standing car is 30 m ahead of the front: 3.0 s, then 2.9 s, until it has a track."""
    lost = episode(MOVERS, 11)
    assert tracking_loss(lost) == pytest.approx(sum(0.1 / (3.0 - 0.1 * step) for step in range(11)), rel=1e-3)
    tracks = replace(
        lost.ticks[0].tracks,
        boxes=lost.ticks[0].actors.boxes[1:],
        **{name: np.zeros(1) for name in ("yaw_rate", "position_sd", "score", "unseen_s")},
        velocity=np.zeros((1, 2)),
    )
    ticks = [replace(tick, tracks=tracks) if step >= 5 else tick for step, tick in enumerate(lost.ticks)]
    found = EpisodeLog(lost.settings, lost.actors[0], ticks, lost.outcome)
    assert tracking_loss(found) == pytest.approx(sum(0.1 / (3.0 - 0.1 * step) for step in range(5)), rel=1e-3)
    away = [Mover("ego", ahead(10.0)), Mover("conflict", ahead(10.0, x=34.0))]
    assert tracking_loss(episode(away, 5)) == 0.0


def test_information_ages_between_percepts() -> None:
    """Percepts at 0.0 and 0.2 s: ages of 0, 0.1, 0, 0.1, 0.2."""
    log = episode(MOVERS, 5, sees=lambda now: percept_of(now, []) if round(now.time_s, 3) in (0.0, 0.2) else None)
    assert information(log).age_s == pytest.approx(0.08)
    assert math.isnan(information(episode(MOVERS, 5)).age_s)


def test_a_message_that_is_used_twice_was_received_once_and_lost_packets_do_not_count() -> None:
    link = Link(1002, 1000, 7, 0.1, 0.05, 4_000_000, 4, np.array([1, 1, 1, 0], bool), 30.0, Obstruction.FREE, 1.0, 0.0)
    older = replace(link, age_s=0.2)
    lost = replace(link, sent=-1, age_s=math.nan, arrived=np.zeros(4, bool))
    by_step = [(link,), (older,), (lost,)]
    log = episode(MOVERS, 3, sees=lambda now: percept_of(now, [], by_step[round(10 * now.time_s)]))
    found = information(log)
    assert found.received_mb == pytest.approx(3.0)
    assert found.sent_mb == pytest.approx(12.0)
    assert found.message_age_s == pytest.approx(0.15)
    held = episode(MOVERS, 3, sees=lambda now: percept_of(now, [], (replace(link, held=now.time_s > 0.05),)))
    assert information(held).sent_mb == pytest.approx(4.0)
