"""Reactions: background drivers stop for what SUMO does not see, after a reaction time."""

import numpy as np
import pytest

from sim.boxes import Boxes
from sim.collisions import overlapping_pairs
from sim.traffic.base import Actors, Limits
from sim.traffic.reactions import NEAR_M, REACTION_S, YieldShim
from sim.traffic.sumo.traffic import SumoTraffic
from tests.sim.traffic.sumo.test_traffic import quick

BODY, DRIVER = 1000, 1001
STEP = 0.1


def street(x: float, speed: float, time_s: float, aside: float = 0.0) -> Actors:
    """A body across the lane at the origin, and a driver who comes along the x axis."""
    boxes = Boxes.from_array(
        [(0.0, aside, 0.75, 4.0, 1.8, 1.5, np.pi / 2), (x, 0.0, 0.75, 4.0, 1.8, 1.5, 0.0)], object_id=[BODY, DRIVER]
    )
    velocity = np.array([[0.0, 0.0], [speed, 0.0]])
    none = np.zeros(2)
    return Actors(time_s, boxes, none, velocity, 0 * velocity, ("",) * 2, ("a", "b"), none.astype(np.int32), ("",) * 2)


def approach(speed: float = 10.0, start: float = -38.0, aside: float = 0.0) -> list[tuple]:
    """Places and speeds of a driver who does what the shim says, until it stands or has passed."""
    shim, x, rows = YieldShim(), start, []
    for step in range(100):
        now = street(x, speed, step * STEP, aside)

        def route(_: int, ahead_m: float, x: float = x) -> np.ndarray:
            return np.array([[x, 0.0], [x + ahead_m, 0.0]])

        slow = shim.speeds(now, [BODY], [BODY, DRIVER], route, lambda _: Limits(15.0, 2.6, 8.0), STEP)
        after = slow.get(DRIVER, speed)
        x += 0.5 * (speed + after) * STEP
        speed = after
        rows.append((step * STEP, x, speed))
        if speed == 0.0 or x > 5.0:
            break
    return rows


def test_an_attentive_driver_stops_before_the_body_within_its_brakes() -> None:
    rows = np.array(approach())
    front = rows[-1, 1] + 2.0
    assert rows[-1, 2] == 0.0 and -4.0 < front + 0.9 < 0.0
    assert np.diff(rows[:, 2]).min() / STEP >= -8.0 - 1e-9
    seen = rows[rows[:, 1] + 2.0 + 25.0 >= -0.9][0, 0]
    braked = rows[np.flatnonzero(np.diff(rows[:, 2]) < 0)[0], 0]
    assert braked - seen == pytest.approx(REACTION_S, abs=0.15)


def test_what_stands_beside_the_way_or_far_off_slows_nobody() -> None:
    assert np.array(approach(aside=3.5))[-1, 2] == 10.0
    assert np.array(approach(start=-NEAR_M - 20.0))[10, 2] == 10.0


def crossing_body() -> tuple[list[float], list[float]]:
    """A car at full speed in SUMO, and another placed across its lane 28 m ahead: speeds before and at the overlap."""
    with SumoTraffic(quick("four_way", 30.0), 1) as traffic:
        car, body, place, yaw = _crossing(traffic)
        clear: list[float] = []
        through: list[float] = []
        for _ in range(50):
            traffic.place(body, place, yaw, 0.0)
            now = traffic.step()
            pair = {now.row(car), now.row(body)}
            np.testing.assert_allclose(now.boxes.center[now.row(body), :2], place, atol=0.02)
            met = any(set(rows) == pair for rows in overlapping_pairs(now.boxes).tolist())
            (through if met else clear).append(float(np.hypot(*now.velocity[now.row(car)])))
    return clear, through


def _crossing(traffic: SumoTraffic) -> tuple[int, int, np.ndarray, float]:
    """Return the id of a car at full speed, that of the farthest other one, and the place across its lane for that."""
    while True:
        now = traffic.step()
        for row in np.flatnonzero((now.boxes.label == 0) & (np.hypot(*now.velocity.T) > 9.0)):
            car = int(now.boxes.object_id[row])
            lights = traffic.signals(car)
            way = traffic.route(car, 28.0)
            whole = np.linalg.norm(np.diff(way, axis=0), axis=1).sum() > 27.0
            if whole and not now.lane[row].startswith(":") and not (lights and lights[0].distance_m < 60.0):
                place, onward = way[-1], way[-1] - way[-2]
                cars = [int(i) for i in now.boxes.object_id[now.boxes.label == 0] if int(i) != car]
                body = max(cars, key=lambda i: np.hypot(*(now.boxes.center[now.row(i), :2] - place)))
                return car, body, place, float(np.arctan2(onward[1], onward[0])) + np.pi / 2


def test_with_the_shim_the_car_stops_before_it() -> None:
    clear, through = crossing_body()
    assert not through
    assert clear[0] > 9.0 and clear[-1] < 0.1
    assert np.diff(clear).min() / STEP > -8.5


def test_who_yielded_drives_on_when_the_body_is_given_back() -> None:
    with SumoTraffic(quick("four_way", 30.0), 1) as traffic:
        car, body = _yielding(traffic)
        slow = traffic.speed(car)
        traffic.command(body, None)
        later = [traffic.step() for _ in range(60)]
        assert slow < 6.0
        assert max(np.hypot(*now.velocity[now.row(car)]) for now in later) > slow + 3.0


def test_who_yielded_and_is_commanded_obeys() -> None:
    with SumoTraffic(quick("four_way", 30.0), 1) as traffic:
        car, _ = _yielding(traffic)
        assert traffic.speed(car) > 4.0
        traffic.command(car, 2.0)
        traffic.step()
        assert traffic.speed(car) < 4.0


def _yielding(traffic: SumoTraffic) -> tuple[int, int]:
    """Place a body across the lane of a car; return the ids of both as soon as the car has braked for it."""
    car, body, place, yaw = _crossing(traffic)
    while traffic.speed(car) > 5.0:
        traffic.place(body, place, yaw, 0.0)
        traffic.step()
    return car, body
