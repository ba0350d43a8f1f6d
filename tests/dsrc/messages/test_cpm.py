"""Collective Perception Messages: how finely they state objects, and which ones senders leave out."""

import numpy as np

from dsrc.messages.cpm import quantised, redundant, told_at_once
from dsrc.messages.message import Objects
from sim.boxes import Boxes

CAR_M = (0.8, 4.5, 1.9, 1.6, 0.0)


def cars(*places: tuple[float, float], speed: float = np.nan) -> Objects:
    boxes = Boxes.from_array([[*place, *CAR_M] for place in places])
    return Objects(boxes, np.full(len(places), 0.9), np.full((len(places), 2), [speed, 0.0 * speed]))


def test_numbers_are_as_fine_as_their_data_elements_and_within_their_ranges() -> None:
    rng = np.random.default_rng(0)
    rows = [rng.normal(0, 50, (40, 3)), rng.uniform(0.01, 40, (40, 3)), rng.normal(0, 2, 40)]
    boxes, velocity = Boxes.from_array(np.column_stack(rows)), rng.normal(0, 100, (40, 2))
    given_rate, score = rng.normal(0, 3, 40), rng.random(40)
    objects, rate = quantised(Objects(boxes, score, velocity), given_rate)
    for values, given, step in (
        (objects.boxes.center, boxes.center, 0.01),
        (objects.score, np.clip(score, 0.01, 1.0), 0.01),
        (objects.velocity, np.clip(velocity, -163.82, 163.81), 0.01),
        (objects.boxes.size, np.clip(boxes.size, 0.1, 25.4), 0.1),
        (np.degrees(rate), np.clip(np.degrees(given_rate), -254.0, 254.0), 1.0),
    ):
        np.testing.assert_allclose(values / step, np.rint(values / step), atol=1e-6)
        assert np.abs(values - given).max() <= 0.5 * step + 1e-9
    off = np.degrees(np.angle(np.exp(1j * (objects.boxes.yaw - boxes.yaw))))
    assert np.abs(off).max() <= 0.05 + 1e-9


def test_at_once_every_sender_leaves_out_what_those_before_it_told_and_without_a_rule_nothing() -> None:
    found = {1: cars((0.0, 0.0), (50.0, 0.0)), 2: cars((0.6, 0.3), (80.0, 0.0)), 3: cars((80.0, 0.5))}
    places = {1: np.zeros(2), 2: np.array([5.0, 0.0]), 3: np.array([200.0, 0.0])}
    told = {rule: told_at_once(found, places, 3.0, rule) for rule in ("", "dynamics", "distance")}
    counts = {rule: [len(one.objects) for one in messages.values()] for rule, messages in told.items()}
    assert counts == {"": [2, 2, 1], "dynamics": [2, 1, 0], "distance": [2, 1, 1]}
    assert told["dynamics"][3].bytes == told[""][3].bytes - 35


def test_what_moved_or_braked_since_it_was_told_is_told_again_and_so_is_what_was_told_long_ago() -> None:
    (told,) = told_at_once({1: cars((0.0, 0.0), speed=10.0)}, {1: np.zeros(2)}, 3.0, "").values()

    def left_out(rule: str, x: float, speed: float, time_s: float) -> bool:
        return bool(redundant(rule, cars((x, 0.0), speed=speed), np.zeros(2), [told], time_s)[0])

    assert left_out("dynamics", 3.0, 10.0, 3.3)
    assert not left_out("dynamics", 5.0, 10.0, 3.5), "it moved by more than 4 m"
    assert not left_out("dynamics", 3.0, 9.0, 3.3), "it brakes"
    assert left_out("distance", 5.0, 9.0, 3.5) and not left_out("distance", 15.0, 10.0, 4.5)
