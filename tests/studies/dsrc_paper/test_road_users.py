"""Who is found as what."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from dsrc.data.sample import SampleRequest
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from sim.boxes import CLASSES, Boxes
from studies.dsrc_paper import road_users


@pytest.mark.parametrize(("yaw", "along"), [(np.pi + 0.4, "100"), (0.6, "0")])
def test_who_is_found_as_what_is_counted_by_class(monkeypatch: pytest.MonkeyPatch, yaw: float, along: str) -> None:
    """A network that takes all for bicycles, misses what is behind, and sees two of one and somebody who is not."""
    settings = SampleRequest(GridSpec(range_m=(-25.6, -12.8, -3.0, 25.6, 12.8, 1.0)), users="vulnerable")
    people = Boxes.from_array(
        [(x, 2.0, -1.0, 0.5, 0.5, 1.7, 0.0) for x in (8.0, 12.0, -9.0)],
        [CLASSES.index(name) for name in ("pedestrian", "motorcycle", "pedestrian")],
    )
    boxes = Boxes.from_array([(x, y, -1, 1.8, 0.6, 1.7, yaw) for x, y in ((8.9, 2), (12, 2), (12.5, 2), (12, 4))])
    boxes = replace(boxes, label=np.full(4, CLASSES.index("bicycle")))
    sample = SimpleNamespace(boxes=people)
    monkeypatch.setattr(road_users, "make_sample", lambda frame, ego, request: sample)
    detector = SimpleNamespace(
        settings=settings, detect=lambda _: Detections(boxes, np.array([0.9, 0.5, 0.4, 0.3], np.float32))
    )
    rows = list(road_users.counted([pair for frame in range(2) for pair in road_users.pairs(detector, frame)]))
    assert rows == [
        ["pedestrian", "4", "2", "0", "2", "0.90", "-"],
        ["bicycle", "0", "0", "0", "0", "-", "-"],
        ["motorcycle", "2", "2", "0", "2", "0.50", along],
        ["matched already", "-", "2", "0", "2", "0.40", "-"],
        ["nobody", "-", "2", "0", "2", "0.30", "-"],
    ]
