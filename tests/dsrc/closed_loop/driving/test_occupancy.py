"""Which stations others block, against the exact overlap of footprints."""

import numpy as np
import pytest

from dsrc.closed_loop.driving.occupancy import ClearanceSettings, occupancy_of
from dsrc.closed_loop.driving.path import STEP_M, path_of
from dsrc.closed_loop.driving.prediction import predict
from sim.boxes import Boxes
from sim.collisions import collide
from tests.dsrc.closed_loop.driving.test_prediction import NoLanes
from tests.dsrc.closed_loop.driving.world import CAR, Other, tracks_of

EXACT = ClearanceSettings(touch_m=0.0, beside_m=0.0, beside_standing_m=0.0, ahead_m=0.0, crossing_s=0.0)
ANGLE = np.linspace(0.0, 1.4, 60)
BEND = np.concatenate(
    [
        [[0.0, 0.0], [30.0, 0.0]],
        np.column_stack([30.0 + 12.0 * np.sin(ANGLE[1:]), 12.0 * (1.0 - np.cos(ANGLE[1:]))]),
    ]
)


@pytest.mark.parametrize("route", [np.array([[0.0, 0.0], [60.0, 0.0]]), BEND])
def test_physical_intervals_hold_exactly_the_stations_of_contact(route: np.ndarray) -> None:
    path = path_of(route, 0.0, 5.0)
    rng = np.random.default_rng(3)
    size = np.array(CAR[:2])
    for _ in range(40):
        heading, speed = rng.uniform(-np.pi, np.pi), rng.choice([0.0, 8.0])
        other = Other(*rng.uniform([8.0, -6.0], [45.0, 12.0]), speed * np.cos(heading), speed * np.sin(heading))
        prediction = predict(tracks_of([other], 0.0), np.zeros(1), NoLanes())
        blocked = occupancy_of(path, size, prediction, EXACT)
        rows = np.column_stack([path.xy, np.full(len(path), 0.75), np.tile(CAR, (len(path), 1)), path.heading])
        there = Boxes.from_array(np.array([[*prediction.xy[0, 0], 0.75, *CAR, prediction.yaw[0, 0]]]))
        touched = path.along[collide(Boxes.from_array(rows), there)]
        if len(touched) == 0:
            assert len(blocked) == 0 or not np.isfinite(blocked.now[0])
            continue
        assert blocked.now[0] == pytest.approx(touched.min() - STEP_M, abs=1e-6)


def test_who_crosses_blocks_longer_and_who_drives_along_does_not() -> None:
    path = path_of(np.array([[0.0, 0.0], [100.0, 0.0]]), 0.0, 5.0)
    others = [Other(50.0, -20.0, 0.0, 10.0), Other(30.0, 0.0, 10.0, 0.0)]
    blocked = occupancy_of(path, np.array(CAR[:2]), predict(tracks_of(others, 0.0), np.zeros(2), NoLanes()), EXACT)
    held = ClearanceSettings(touch_m=0.0, beside_m=0.0, beside_standing_m=0.0, ahead_m=0.0, crossing_s=0.8)
    longer = occupancy_of(path, np.array(CAR[:2]), predict(tracks_of(others, 0.0), np.zeros(2), NoLanes()), held)
    first, more = (np.isfinite(o.wide[:, 0]).sum(axis=1) for o in (blocked, longer))
    assert more[0] == first[0] + 8
    assert more[1] == first[1]
    assert longer.aligned[1, 0]
    assert not longer.aligned[0].any()
