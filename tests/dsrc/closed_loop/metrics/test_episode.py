"""All metrics of an episode: from its log alone, before and after it was a file."""

import math
from pathlib import Path

import msgspec
import pytest

from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.metrics.episode import episode_metrics
from dsrc.closed_loop.types import Outcome
from sim.contact import Contact
from tests.dsrc.closed_loop.logged import Mover, ahead, episode, percept_of

HIT = Contact(0.5, 1001, "conflict", 10.0, 12.0, 6.0, "front", True)


def crash() -> EpisodeLog:
    """At 10 m/s from 10 m behind the rear of a standing car, touched after 0.5 s with 5 m/s2."""
    ego = Mover("ego", lambda t: (10.0 * t - 2.5 * max(t, 0.0) ** 2, 0.0))
    movers = [ego, Mover("conflict", ahead(0.0, x=9.0))]
    return episode(movers, 6, Outcome.CRASHED, contact=HIT, sees=lambda now: percept_of(now, [1]), route_m=45.0)


def test_metrics_of_a_crash() -> None:
    found = episode_metrics(crash())
    assert (found.collision, found.at_fault, found.stuck) == (1.0, 1.0, 0.0)
    assert (found.impact_mps, found.ego_impact_mps, found.delta_v_mps) == (12.0, 10.0, 6.0)
    assert found.duration_s == pytest.approx(0.5)
    assert found.driving_score_2_0 == pytest.approx(0.6 * found.completion)
    assert found.driving_score_2_1 == pytest.approx(found.completion / 1.7)
    assert found.pdms == 0.0
    assert found.hardest_brake_mps2 == pytest.approx(5.0, abs=0.01)
    assert found.tet_s == pytest.approx(0.5)
    assert found.seen_s == 0.0


def test_metrics_of_a_drive_alone_have_no_crash_and_nobody_near() -> None:
    found = episode_metrics(episode([Mover("ego", ahead(10.0))], 20, Outcome.ARRIVED))
    assert (found.collision, found.completion, found.driving_score_2_1, found.pdms) == (0.0, 1.0, 1.0, 1.0)
    assert math.isnan(found.impact_mps) and math.isnan(found.seen_s)
    assert found.min_ttc_s == found.pet_s == found.min_distance_m == found.min_headway_s == math.inf
    assert found.mean_speed_mps == pytest.approx(10.0)


def test_a_file_gives_the_same_metrics_as_the_episode_did(tmp_path: Path) -> None:
    log = crash()
    again = EpisodeLog.load(log.save(tmp_path / "crash.npz"))
    assert msgspec.json.encode(episode_metrics(again)) == msgspec.json.encode(episode_metrics(log))


def test_a_contact_in_the_first_step_leaves_no_motion_to_measure() -> None:
    movers = [Mover("ego", ahead(10.0)), Mover("conflict", ahead(0.0, x=3.0))]
    found = episode_metrics(episode(movers, 1, Outcome.CRASHED, contact=HIT))
    assert found.collision == 1.0 and math.isnan(found.comfort) and found.min_ttc_s == math.inf


def test_an_ego_that_leaves_the_traffic_is_measured_to_its_last_step() -> None:
    log = episode([Mover("ego", ahead(10.0)), Mover("car", ahead(0.0, x=90.0))], 10, Outcome.ARRIVED)
    gone = episode([Mover("ego", ahead(10.0)), Mover("car", ahead(0.0, x=90.0))], 1, ego_id=1001).ticks[0]
    without = msgspec.structs.replace(log.settings)
    last = log.ticks[-1]
    actors = gone.actors
    rest = actors.boxes[1:]
    alone = type(actors)(
        last.actors.time_s + 0.1, rest, actors.pitch[1:], actors.velocity[1:], actors.acceleration[1:],
        actors.model[1:], actors.name[1:], actors.signals[1:], actors.lane[1:],
    )  # fmt: skip
    tick = type(last)(alone, last.ego, None, last.tracks, last.decision)
    found = episode_metrics(EpisodeLog(without, log.actors[0], [*log.ticks, tick], Outcome.ARRIVED))
    assert found.progress_m == pytest.approx(9.0)


def test_a_log_without_steps_has_no_metrics() -> None:
    log = crash()
    with pytest.raises(ValueError, match="at least one step"):
        episode_metrics(EpisodeLog(log.settings, log.actors[0], [], Outcome.PERCEPTION_FAILED))
