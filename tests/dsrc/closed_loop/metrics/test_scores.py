"""Driving scores, PDMS, comfort and progress against values computed by hand."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.metrics.comfort import comfort, signals
from dsrc.closed_loop.metrics.driven import Motion
from dsrc.closed_loop.metrics.driving_score import (
    Infractions,
    driving_score_2_0,
    driving_score_2_1,
    infractions_of,
    off_lane_share,
    red_lights_run,
)
from dsrc.closed_loop.metrics.pdms import Pdms, pdms
from dsrc.closed_loop.metrics.progress import free_flow_m, progress
from dsrc.closed_loop.types import Outcome
from sim.contact import Contact
from sim.traffic.base import TrafficLight
from tests.dsrc.closed_loop.logged import LIMITS, Mover, ahead, episode

HIT = Contact(0.5, 1001, "other", 10.0, 10.0, 5.0, "front", True)


@pytest.mark.parametrize(
    ("infractions", "multiplied", "added"),
    [
        (Infractions(), 1.0, 1.0),
        (Infractions(pedestrian=1), 0.5, 1 / 2.0),
        (Infractions(vehicle=1), 0.6, 1 / 1.7),
        (Infractions(static=1), 0.65, 1 / 1.6),
        (Infractions(red_light=1), 0.7, 1 / 1.4),
        (Infractions(stop_sign=1), 0.8, 1 / 1.25),
        (Infractions(timeout=1), 0.7, 1 / 1.4),
        (Infractions(emergency=1), 0.7, 1 / 1.4),
        (Infractions(speed_share=0.5), 0.85, 1 / 1.2),
        (Infractions(off_lane_share=0.25), 0.75, 0.75),
        (Infractions(vehicle=2, red_light=1), 0.6 * 0.6 * 0.7, 1 / (1 + 1.4 + 0.4)),
    ],
)
def test_the_penalties_of_both_leaderboards(infractions: Infractions, multiplied: float, added: float) -> None:
    assert driving_score_2_0(1.0, infractions) == pytest.approx(multiplied)
    assert driving_score_2_1(1.0, infractions) == pytest.approx(added)
    assert driving_score_2_0(0.5, infractions) == pytest.approx(0.5 * multiplied)
    assert driving_score_2_1(0.5, infractions) == pytest.approx(0.5 * added)


def test_only_2_0_rewards_who_stops_before_the_second_collision() -> None:
    """Half the route with one collision, or all of it with two: 2.0 gives 0.30 and 0.36, but three make it 0.216."""
    assert driving_score_2_0(0.5, Infractions(vehicle=1)) > driving_score_2_0(1.0, Infractions(vehicle=3))
    assert driving_score_2_1(0.5, Infractions(vehicle=1)) < driving_score_2_1(1.0, Infractions(vehicle=3))


def crashed(label: str = "car", contact: Contact = HIT) -> EpisodeLog:
    movers = [Mover("ego", ahead(10.0)), Mover("other", ahead(0.0, x=9.0), label=label)]
    return episode(movers, 6, Outcome.CRASHED, contact=contact, route_m=50.0)


def test_a_collision_counts_by_what_was_hit() -> None:
    assert infractions_of(crashed()) == Infractions(vehicle=1)
    assert infractions_of(crashed("bicycle")) == Infractions(vehicle=1)
    assert infractions_of(crashed("pedestrian")) == Infractions(pedestrian=1)
    assert infractions_of(crashed(contact=replace(HIT, other_id=-1, other="world"))) == Infractions(static=1)


def test_only_an_encounter_with_a_goal_can_be_late() -> None:
    ego = [Mover("ego", ahead(10.0))]
    assert infractions_of(episode(ego, 3, Outcome.TIMEOUT, route_m=50.0)) == Infractions(timeout=1)
    assert infractions_of(episode(ego, 3, Outcome.TIMEOUT)) == Infractions()


def with_lights(distances_m: list[float], state: str) -> EpisodeLog:
    log = episode([Mover("ego", ahead(10.0))], len(distances_m))
    ticks = [
        replace(tick, ego=replace(tick.ego, lights=(TrafficLight(state, away),)))
        for tick, away in zip(log.ticks, distances_m, strict=True)
    ]
    return EpisodeLog(log.settings, log.actors[0], ticks, log.outcome)


def test_a_red_light_is_run_when_the_front_crosses_its_line() -> None:
    assert red_lights_run(with_lights([2.5, 1.5, 0.5, 30.0], "red")) == 1
    assert red_lights_run(with_lights([2.5, 1.5, 0.5, 30.0], "red and yellow")) == 1
    assert red_lights_run(with_lights([2.5, 1.5, 0.5, 30.0], "yellow")) == 0
    assert red_lights_run(with_lights([3.5, 2.5, 1.5], "red")) == 0


def test_off_lane_is_the_share_of_the_distance_without_a_lane() -> None:
    log = episode([Mover("ego", ahead(10.0))], 5)
    ticks = [
        replace(tick, actors=replace(tick.actors, lane=("" if k == 4 else "a",))) for k, tick in enumerate(log.ticks)
    ]
    assert off_lane_share(EpisodeLog(log.settings, log.actors[0], ticks, log.outcome)) == pytest.approx(0.25)
    assert off_lane_share(episode([Mover("ego", ahead(10.0), lane="")], 5)) == 0.0


def test_progress_is_a_share_of_the_way_to_the_goal_or_of_what_the_truth_drove() -> None:
    ego = [Mover("ego", ahead(10.0))]
    slow = episode([Mover("ego", ahead(4.0))], 11)
    assert progress(episode(ego, 11, route_m=40.0)).completion == pytest.approx(0.25)
    assert progress(episode(ego, 11, Outcome.ARRIVED, route_m=40.0)).completion == 1.0
    assert progress(slow, episode(ego, 11)).completion == pytest.approx(0.4)
    assert progress(episode(ego, 11), slow).completion == 1.0


def test_free_flow_accelerates_to_the_limit_over_the_planned_duration() -> None:
    """From 10 m/s by 2.6 m/s2: 13.9 m/s after 1.5 s, 0.1 x (15 x 10 + 0.26 x 120) = 18.12 m, then 0.5 s at 13.9."""
    log = episode([Mover("ego", ahead(10.0))], 3, loop={"duration_s": 2.0})
    assert LIMITS.acceleration_mps2 == 2.6
    assert free_flow_m(log) == pytest.approx(18.12 + 0.5 * 13.9)


def test_pdms_weighs_its_terms_as_navsim_does() -> None:
    terms = Pdms(no_collision=1.0, drivable=1.0, time_to_collision=0.0, progress=0.6, comfortable=1.0)
    assert terms.score == pytest.approx((0.0 + 3.0 + 2.0) / 12.0)
    assert Pdms(no_collision=0.5, drivable=1.0, time_to_collision=1.0, progress=1.0, comfortable=1.0).score == 0.5
    assert Pdms(no_collision=1.0, drivable=0.0, time_to_collision=1.0, progress=1.0, comfortable=1.0).score == 0.0


def test_the_extended_score_weighs_its_terms_as_navsim_does() -> None:
    terms = Pdms(no_collision=1.0, drivable=1.0, time_to_collision=1.0, progress=0.6, comfortable=0.0, lane_keeping=0.0)
    assert terms.extended == pytest.approx((5.0 + 3.0) / 14.0)
    assert msgspec.structs.replace(terms, lights=0.0).extended == 0.0


@pytest.mark.parametrize(("aside_m", "kept"), [(0.4, 1.0), (0.6, 0.0)])
@pytest.mark.parametrize(("steps", "long"), [(19, False), (20, True)])
def test_who_drives_beside_the_route_for_two_seconds_does_not_keep_the_lane(
    aside_m: float, kept: float, steps: int, long: bool
) -> None:
    plain = episode([Mover("ego", ahead(10.0))], steps)
    ticks = []
    for tick in plain.ticks:
        x, y = tick.ego.box.center[0, :2]
        route = np.array([[x, y], [x + 2.0, y + aside_m], [x + 30.0, y + aside_m]])
        ticks.append(replace(tick, ego=replace(tick.ego, route=route)))
    log = EpisodeLog(plain.settings, plain.actors[0], ticks, plain.outcome)
    assert pdms(log).lane_keeping == (kept if long else 1.0)


@pytest.mark.parametrize(("outside", "kept"), [(19, 1.0), (20, 0.0)])
def test_in_junctions_nobody_leaves_the_lane_nor_comes_back_to_it(outside: int, kept: float) -> None:
    plain = episode([Mover("ego", ahead(10.0))], 40 + outside)
    ticks = []
    for k, tick in enumerate(plain.ticks):
        x, y = tick.ego.box.center[0, :2]
        route = np.array([[x, y], [x + 2.0, y + 0.8], [x + 30.0, y + 0.8]])
        lane = (":middle_0" if 10 <= k < 50 else "a",)
        ticks.append(replace(tick, ego=replace(tick.ego, route=route), actors=replace(tick.actors, lane=lane)))
    log = EpisodeLog(plain.settings, plain.actors[0], ticks, plain.outcome)
    assert pdms(log).lane_keeping == kept, "ten steps before the junction, the others after it"


def test_pdms_of_episodes() -> None:
    ego = Mover("ego", ahead(10.0))
    free = pdms(episode([ego], 20, Outcome.ARRIVED))
    assert free.score == 1.0
    assert pdms(crashed()).no_collision == 0.0
    assert pdms(crashed(contact=replace(HIT, other_id=-1))).no_collision == 0.5
    assert pdms(crashed(contact=replace(HIT, at_fault=False))).no_collision == 1.0
    assert pdms(episode([ego], 20, Outcome.LEFT)).drivable == 0.0


@pytest.mark.parametrize(("gap_m", "safe"), [(8.5, 0.0), (9.5, 1.0)])
def test_the_projection_of_pdms_looks_nine_tenths_of_a_second_ahead(gap_m: float, safe: float) -> None:
    """At 10 m/s the front moves 9 m; a standing car is `gap_m` beyond it at the end of the episode."""
    standing = Mover("car", ahead(0.0, x=10.0 + 4.0 + gap_m))
    assert pdms(episode([Mover("ego", ahead(10.0)), standing], 11)).time_to_collision == safe


def test_the_projection_of_pdms_does_not_mind_who_comes_from_behind_or_an_ego_that_stands() -> None:
    behind = Mover("car", ahead(20.0, x=-8.0))
    assert pdms(episode([Mover("ego", ahead(10.0)), behind], 3)).time_to_collision == 1.0
    oncoming = Mover("car", ahead(-10.0, x=10.0))
    assert pdms(episode([Mover("ego", ahead(0.0), yaw=0.0), oncoming], 3)).time_to_collision == 1.0


def braking(deceleration: float) -> Motion:
    """Motion at 20 m/s that brakes constantly from the beginning."""
    return lambda t: (20.0 * t - 0.5 * deceleration * t * t, 0.0)


@pytest.mark.parametrize(("deceleration", "comfortable"), [(3.9, 1.0), (4.2, 0.0)])
def test_braking_is_comfortable_to_4_05(deceleration: float, comfortable: float) -> None:
    found = comfort(Motion.of(episode([Mover("ego", braking(deceleration))], 30)), 0.1)
    assert found.comfortable == comfortable
    assert found.worst == pytest.approx(deceleration / 4.05, rel=0.01)


def test_a_circle_has_the_yaw_rate_and_the_lateral_acceleration_of_physics() -> None:
    """10 m/s on a radius of 25 m: 0.4 rad/s and 4 m/s2, all else none."""
    circle = Mover("ego", lambda t: (25.0 * math.sin(0.4 * t), 25.0 - 25.0 * math.cos(0.4 * t)))
    found = signals(Motion.of(episode([circle], 60)), 0.1)
    assert np.abs(found["yaw_rate_radps"] - 0.4).max() < 2e-3
    assert np.abs(found["lateral_mps2"] - 4.0).max() < 0.02
    assert np.abs(found["longitudinal_jerk_mps3"]).max() < 0.2
    assert comfort(Motion.of(episode([circle], 60)), 0.1).comfortable == 1.0


def test_a_second_of_other_steps_is_smoothed_over_the_same_time() -> None:
    """A brake of 4 m/s2 that starts at once: the jerk of a window of 1.5 s is bounded, whatever its samples."""
    log = episode([Mover("ego", lambda t: (20.0 * t - 2.0 * max(t - 3.0, 0.0) ** 2, 0.0))], 60)
    jerk = signals(Motion.of(log), 0.1)["longitudinal_jerk_mps3"]
    assert 3.0 < np.abs(jerk).max() < 8.0


def test_an_episode_of_three_steps_is_too_short_for_comfort() -> None:
    assert math.isnan(comfort(Motion.of(episode([Mover("ego", ahead(5.0))], 3)), 0.1).comfortable)
