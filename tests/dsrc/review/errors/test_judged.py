"""Matches of detections with true boxes, and their counts."""

import numpy as np
import pytest

from dsrc.evaluation.detection_table import one_frame
from dsrc.ops.detections import Detections
from dsrc.review.errors.judged import Counts, JudgedRun
from dsrc.review.sources.base import Setup
from sim.boxes import Boxes

TURNED = Boxes.from_array([[5.0, 3.0, 1.0, 4.0, 2.0, 1.5, 0.7], [0.0, 0.0, 0.0, 2.0, 2.0, 2.0, -2.0]])


def test_two_detections_of_one_object_are_one_tp_and_one_fp() -> None:
    truth = Boxes.from_array([[0.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0], [20.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]])
    twice = Detections(truth[np.array([0, 0])], np.array([0.8, 0.6], np.float32))
    judged = JudgedRun("", Setup(), one_frame(0, 0, 0, twice, truth))
    assert judged.at(0.5).matched.tolist() == [0, -1]
    assert judged.counts(0.0, 0.5) == Counts(1, 1, 1)
    assert judged.counts(0.7, 0.5) == Counts(1, 0, 1)
    assert judged.found(0.0, 0.5).tolist() == [True, False]
    assert judged.counts(0.9, 0.5) == Counts(0, 0, 2)


@pytest.mark.parametrize("detections", [0, 2])
@pytest.mark.parametrize("objects", [0, 2])
def test_matching_takes_empty_sides(detections: int, objects: int) -> None:
    made = Detections(TURNED[:detections], np.ones(detections, np.float32))
    judged = JudgedRun("", Setup(), one_frame(0, 0, 0, made, TURNED[:objects]))
    found = min(detections, objects)
    assert judged.counts(0.0, 0.5) == Counts(found, detections - found, objects - found)


def test_precision_of_nothing_is_unknown() -> None:
    assert Counts().precision is None and Counts().recall is None
    assert Counts(0, 1, 1).precision == 0.0
