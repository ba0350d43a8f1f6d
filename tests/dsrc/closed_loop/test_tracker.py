"""Tracks keep their number, learn their speed and forget what is gone."""

import numpy as np
import pytest

from dsrc.closed_loop.tracker import Tracker
from sim.boxes import Boxes


def at(*xy: tuple[float, float]) -> Boxes:
    return Boxes.from_array([[x, y, 0.8, 4.0, 2.0, 1.6, 0.0] for x, y in xy])


def test_a_moving_box_gets_its_velocity_and_keeps_its_number() -> None:
    tracker = Tracker()
    for k in range(20):
        boxes, velocity = tracker.update(at((1.0 * k, 0.0), (50.0, 5.0)), 0.1 * k)
    assert sorted(boxes.object_id) == [0, 1]
    moving = int(np.flatnonzero(boxes.object_id == boxes.object_id[np.argmin(boxes.center[:, 1])])[0])
    assert velocity[moving] == pytest.approx([10.0, 0.0], abs=0.1)
    assert np.abs(np.delete(velocity, moving, axis=0)).max() < 1e-9


def test_a_missed_box_coasts_and_is_then_forgotten() -> None:
    tracker = Tracker()
    for k in range(10):
        tracker.update(at((1.0 * k, 0.0)), 0.1 * k)
    boxes, _ = tracker.update(Boxes.zeros(), 1.0)
    assert boxes.center[0, 0] == pytest.approx(10.0, abs=0.2)
    for k in range(1, 8):
        boxes, _ = tracker.update(Boxes.zeros(), 1.0 + 0.1 * k)
    assert len(boxes) == 0


def test_nothing_to_track_is_no_error() -> None:
    boxes, velocity = Tracker().update(Boxes.zeros(), 0.0)
    assert len(boxes) == 0
    assert velocity.shape == (0, 2)


def test_a_detection_beyond_the_gate_is_another_object() -> None:
    tracker = Tracker()
    tracker.update(at((0.0, 0.0)), 0.0)
    boxes, velocity = tracker.update(at((3.1, 0.0)), 0.1)
    assert sorted(boxes.object_id) == [0, 1]
    assert not velocity.any()
