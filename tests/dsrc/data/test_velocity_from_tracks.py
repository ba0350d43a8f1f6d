import numpy as np
import pytest

from dsrc.data.velocity_from_tracks import TimedBoxes, tracked_velocity
from sim.boxes import Boxes


def at(time_s: float, x: dict[int, float]) -> TimedBoxes:
    boxes = Boxes.from_array([[place, 2.0 * place, 0, 4, 2, 1.5, 0] for place in x.values()], object_id=list(x))
    return TimedBoxes(time_s, boxes)


def test_velocity_is_the_central_difference_where_both_sides_are_known() -> None:
    now = at(1.0, {1: 5.0, 2: 0.0, 3: 7.0, 4: 1.0})
    velocity = tracked_velocity(now, at(0.9, {1: 4.0, 2: -0.2}), at(1.2, {1: 7.0, 3: 7.6}))
    assert velocity[0] == pytest.approx([10.0, 20.0])  # both
    assert velocity[1] == pytest.approx([2.0, 4.0])  # before alone
    assert velocity[2] == pytest.approx([3.0, 6.0])  # after alone
    assert np.isnan(velocity[3]).all()


def test_velocity_is_unknown_over_a_long_pause_or_without_neighbours() -> None:
    now = at(1.0, {1: 5.0})
    assert np.isnan(tracked_velocity(now, at(0.4, {1: 4.0}), at(2.0, {1: 7.0}))).all()
    assert np.isnan(tracked_velocity(now, None, None)).all()
    assert np.isnan(tracked_velocity(now, at(1.0, {1: 4.0}), None)).all()  # the same time twice
    empty = TimedBoxes(1.0, Boxes.zeros())
    assert tracked_velocity(empty, now, now).shape == (0, 2)
