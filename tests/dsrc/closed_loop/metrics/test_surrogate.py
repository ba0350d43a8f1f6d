"""Surrogate measures of motions whose values follow by hand."""

import math

import numpy as np
import pytest

from dsrc.closed_loop.metrics.driven import Motion
from dsrc.closed_loop.metrics.surrogate import (
    drac,
    exposure,
    headways,
    nearest_distance,
    post_encroachment_time,
    time_to_collision,
    times_to_collision,
    ttc_series,
)
from sim.boxes import Boxes
from sim.collisions import overlap
from sim.contact import Contact
from tests.dsrc.closed_loop.logged import Mover, ahead, episode

EGO = Boxes.from_array([[0.0, 0.0, 0.8, 4.0, 2.0, 1.6, 0.0]])


def test_a_car_that_closes_in_is_met_when_the_bumpers_touch() -> None:
    other = Boxes.from_array([[24.0, 0.0, 0.8, 4.0, 2.0, 1.6, 0.0]])
    assert time_to_collision(EGO, np.array([10.0, 0.0]), other, np.zeros((1, 2))) == pytest.approx(2.0)
    assert time_to_collision(EGO, np.array([10.0, 0.0]), other, np.zeros((1, 2)), horizon_s=1.9) == math.inf
    far = Boxes.from_array([[64.0, 0.0, 0.8, 4.0, 2.0, 1.6, 0.0]])
    assert time_to_collision(EGO, np.array([5.0, 0.0]), far, np.zeros((1, 2))) == math.inf
    assert time_to_collision(EGO, np.array([5.0, 0.0]), far, np.zeros((1, 2)), horizon_s=20.0) == pytest.approx(12.0)


def test_a_crossing_car_is_met_when_it_is_on_the_path_and_not_when_it_is_slow() -> None:
    # Fronts at 2 and rear corners: the ego reaches x = 19 at 1.7 s, the other reaches y = -1 at 1.7 s.
    other = Boxes.from_array([[20.0, -20.0, 0.8, 4.0, 2.0, 1.6, np.pi / 2]])
    assert time_to_collision(EGO, np.array([10.0, 0.0]), other, np.array([[0.0, 10.0]])) == pytest.approx(1.7)
    assert time_to_collision(EGO, np.array([10.0, 0.0]), other, np.array([[0.0, 2.0]])) == math.inf


def test_cars_that_part_or_pass_side_by_side_never_meet_and_an_overlap_is_now() -> None:
    others = Boxes.from_array(
        [
            [10.0, 0.0, 0.8, 4.0, 2.0, 1.6, 0.0],
            [30.0, 2.0, 0.8, 4.0, 2.0, 1.6, np.pi],
            [30.0, 1.9, 0.8, 4.0, 2.0, 1.6, np.pi],
            [3.0, 0.5, 0.8, 4.0, 2.0, 1.6, 0.0],
        ]
    )
    velocity = np.array([[5.0, 0.0], [-10.0, 0.0], [-10.0, 0.0], [0.0, 0.0]])
    times = times_to_collision(EGO, np.array([3.0, 0.0]), others, velocity)
    assert times.tolist() == pytest.approx([math.inf, math.inf, 2.0, 0.0])
    assert time_to_collision(EGO, np.zeros(2), Boxes.zeros(), np.zeros((0, 2))) == math.inf


def test_the_traffic_on_a_bridge_is_not_in_the_way_and_a_car_up_the_hill_is() -> None:
    for height, found in ((6.8, math.inf), (0.8, 1.7)):
        crossing = Boxes.from_array([[20.0, -20.0, height, 4.0, 2.0, 1.6, np.pi / 2]])
        assert time_to_collision(EGO, np.array([10.0, 0.0]), crossing, np.array([[0.0, 10.0]])) == pytest.approx(found)
    uphill = Boxes.from_array([[40.0, 0.0, 3.2, 4.0, 2.0, 1.6, 0.0]])
    assert time_to_collision(EGO, np.array([10.0, 0.0]), uphill, np.zeros((1, 2))) == pytest.approx(3.6)


def test_exposure_is_the_time_below_the_critical_ttc_and_what_lacks_to_it() -> None:
    ttc = np.array([math.inf, 1.6, 1.4, 1.0, 1.5])
    assert exposure(ttc, 0.1) == (pytest.approx(0.2), pytest.approx(0.1 * (0.1 + 0.5)))


def test_times_to_a_standing_car_shrink_step_by_step_and_end_before_the_contact() -> None:
    """At 10 m/s, 24 m behind the centre of a standing car: 2.0 s, 1.9 s, ...; the step with the contact is no more."""
    hit = Contact(0.3, 1001, "car", 10.0, 10.0, 5.0, "front", True)
    log = episode([Mover("ego", ahead(10.0)), Mover("car", ahead(0.0, x=24.0))], 4, contact=hit)
    motion = Motion.of(log)
    assert len(motion) == 3
    assert ttc_series(motion).tolist() == pytest.approx([2.0, 1.9, 1.8])
    # v^2 / (2 gap) is largest at the last step: 10^2 / (2 x 18).
    assert drac(motion) == pytest.approx(100.0 / 36.0)
    assert nearest_distance(motion) == pytest.approx(18.0)


def test_nobody_needs_to_brake_for_a_faster_car_ahead() -> None:
    motion = Motion.of(episode([Mover("ego", ahead(10.0)), Mover("car", ahead(12.0, x=10.0))], 5))
    assert drac(motion) == 0.0
    assert ttc_series(motion).tolist() == [math.inf] * 5


def test_post_encroachment_time_is_from_leaving_to_reaching() -> None:
    """The ego's rear leaves the crossing lane's square at x = 11 at 1.3 s; the other's front is at y = -1 at 2.05 s."""
    crossing = Mover("other", lambda t: (10.0, 10.0 * t - 23.5))
    motion = Motion.of(episode([Mover("ego", ahead(10.0)), crossing], 40))
    # Boxes are compared at steps: the last overlap of the ego is at 1.2 s, the first of the other at 2.1 s.
    assert post_encroachment_time(motion) == pytest.approx(0.9)
    follower = Mover("other", ahead(10.0, x=-10.0))
    assert post_encroachment_time(Motion.of(episode([Mover("ego", ahead(10.0)), follower], 40))) == math.inf


def test_time_headway_is_the_gap_to_the_car_ahead_on_the_route_over_the_speed() -> None:
    movers = [
        Mover("ego", ahead(10.0)),
        Mover("leader", ahead(8.0, x=24.0)),
        Mover("beside", ahead(10.0, x=8.0, y=3.5)),
        Mover("oncoming", ahead(-10.0, x=12.0)),
    ]
    log = episode(movers, 3)
    found = headways(Motion.of(log), [tick.ego.route for tick in log.ticks])
    assert found.tolist() == pytest.approx([2.0, 1.98, 1.96])
    still = episode([Mover("ego", ahead(0.0), yaw=0.0), Mover("leader", ahead(0.0, x=8.0), yaw=0.0)], 1)
    assert headways(Motion.of(still), [tick.ego.route for tick in still.ticks]).tolist() == [math.inf]


def test_the_nearest_distance_is_between_sides_not_centres() -> None:
    passing = Mover("other", ahead(-10.0, x=5.0, y=3.5))
    assert nearest_distance(Motion.of(episode([Mover("ego", ahead(10.0)), passing], 10))) == pytest.approx(
        1.5, abs=1e-4
    )
    assert nearest_distance(Motion.of(episode([Mover("ego", ahead(10.0))], 2))) == math.inf


def test_the_exact_time_is_the_first_at_which_moved_boxes_overlap() -> None:
    """Random boxes and velocities: no overlap just before the time, an overlap just after it."""
    rng = np.random.default_rng(5)
    n, far = 2000, 20.0
    place, size = rng.uniform(-far, far, (n, 2)), rng.uniform(0.5, 9.0, (n, 3))
    others = Boxes.from_array(np.column_stack([place, np.full(n, 0.8), size, rng.uniform(-3, 3, n)]))
    velocity, own = rng.uniform(-15, 15, (n, 2)), np.array([8.0, -2.0])
    times = times_to_collision(EGO, own, others, velocity)

    def met(at_s: np.ndarray) -> np.ndarray:
        return overlap(
            EGO.bev_polygons() + at_s[:, None, None] * own,
            others.bev_polygons() + at_s[:, None, None] * velocity[:, None, :],
        )

    now, later, never = times == 0.0, np.isfinite(times) & (times > 0.0), np.isinf(times)
    assert min(now.sum(), later.sum(), never.sum()) > 20
    assert met(np.zeros(n))[now].all()
    assert not met(np.where(later, times - 1e-6, 0.0))[later].any()
    assert met(np.where(later, times + 1e-4, 0.0))[later].mean() > 0.97  # others only graze a corner
    assert not any(met(np.full(n, at_s))[never].any() for at_s in np.arange(0.0, 10.0, 0.05))
