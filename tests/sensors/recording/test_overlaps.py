"""Road users whose bodies overlap: in a world of version 2 no two of a drive do."""

from dataclasses import replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace as changed

from sensors.recording.overlaps import DEEP_M, overlapping, without
from sensors.recording.record import record
from sim.collisions import overlapping_pairs
from sim.traffic.base import Actors
from tests.sensors.fakes import StraightTraffic, box_body, cars, ground, toy_scenario

ROW = [[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [6.0, 0.0, 0.0], [40.0, 0.0, 0.0], [60.0, 3.0, 0.0]]
"""Cars 4 m long: the second overlaps the first and the third by a metre."""


def named(actors: Actors, *names: str) -> Actors:
    return replace(actors, name=names)


def test_who_overlaps_two_others_goes_alone() -> None:
    assert overlapping([cars(ROW)]) == {1001}
    assert without(cars(ROW), {1001}).boxes.object_id.tolist() == [1000, 1002, 1003, 1004]


def test_a_parked_car_goes_before_who_drives_and_who_is_named_stays() -> None:
    parked = named(cars(ROW), "parked_0", "b", "c", "d", "e")
    assert overlapping([parked]) == {1000, 1002}
    assert overlapping([named(cars(ROW), *"abcde")], kept=("b",)) == {1000, 1002}
    assert overlapping([named(cars(ROW[:2]), *"ab")], kept=("a", "b")) == set()


def test_bodies_that_brush_each_other_stay() -> None:
    for depth, count in ((DEEP_M - 0.01, 0), (DEEP_M + 0.01, 1)):
        assert len(overlapping([cars([[0.0, 0.0, 0.0], [0.0, 1.8 - depth, 0.0]], size=(4.0, 1.8, 1.5))])) == count


@given(st.integers(0, 2**31))
def test_no_two_overlap_at_any_step_and_who_overlaps_nobody_stays(seed: int) -> None:
    rng = np.random.default_rng(seed)
    places = np.column_stack([rng.uniform(0, 40, (12, 2)), rng.uniform(-np.pi, np.pi, 12)])
    steps = [cars(places + np.array([0.4 * k, 0.0, 0.0])) for k in range(3)] + [cars(places[::-1])]
    gone = overlapping(steps)
    for actors in steps:
        assert not len(overlapping_pairs(without(actors, gone).boxes, -0.5 * DEEP_M))
    met = {int(one) for a in steps for one in a.boxes.object_id[overlapping_pairs(a.boxes, -0.5 * DEEP_M)].ravel()}
    assert gone <= met


def test_a_drive_of_version_2_has_no_such_body_and_one_of_version_1_keeps_its_bytes() -> None:
    crossing = [*ROW[3:], [48.0, 0.0, np.pi]]
    for world, ids in ((2, {1000, 1001}), (1, {1000, 1001, 1002})):
        scenario = changed(toy_scenario(), world=world)
        drive = record(StraightTraffic(cars(crossing, speed=10.0)), ground(1000.0), scenario, 1, 6, body_mesh=box_body)
        assert {int(one) for actors in drive.steps for one in actors.boxes.object_id} == ids
        assert set(drive.vehicles) <= ids
