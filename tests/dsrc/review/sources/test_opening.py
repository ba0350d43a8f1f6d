"""Opening of sources and detectors."""

import json
from pathlib import Path

import numpy as np
import pytest

from dsrc.review.model import ReviewModel
from dsrc.review.sources.base import DriveSource
from dsrc.review.sources.opening import add_detectors, open_late, open_sources
from dsrc.review.state import ReviewState
from sim.errors import DataError
from tests.dsrc.review.conftest import FakeDetector, FakeDrive


def test_a_detector_that_may_wait_is_opened_once_it_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []

    def open_detector(text: str, **_: object) -> FakeDetector:
        opened.append(text)
        return FakeDetector()

    monkeypatch.setattr("dsrc.detectors.open.open_detector", open_detector)
    source = DriveSource(FakeDrive())  # type: ignore[arg-type]
    add_detectors([source], ["mine=model.pt"], late=True)
    assert not opened and list(source.sets) == ["mine"]
    open_late([source])
    open_late([source])
    assert opened == ["model.pt"]
    add_detectors([source], ["other=other.pt"])
    assert opened == ["model.pt", "other.pt"]


def test_boxes_alone_are_frames_without_points_and_say_so(tmp_path: Path) -> None:
    boxes = {"frame": 7, "boxes": [[10, 2, -1, 4, 2, 1.5, 0.1], [20, 0, -1, 4, 2, 1.5, 0]], "score": [0.9, 0.2]}
    path = tmp_path / "mine.json"
    path.write_text(json.dumps({"frames": [boxes, {**boxes, "frame": 9}]}))
    model = ReviewModel(open_sources(path))
    assert (model.names, model.methods(0), len(model.sources[0])) == (["mine"], ["mine"], 2)
    view = model.view(ReviewState(frame=1))
    assert (view.index, view.detected, view.labelled, view.counts) == (9, 1, False, None)
    np.testing.assert_allclose(view.layers["detections/unjudged"].center[0], [10.0, 2.0, 0.9])
    assert "without clouds" in view.notice
    assert model.view(ReviewState(corruption="fog")).notice == "mine has no detections in fog 3; it has them in clean."


def test_boxes_that_are_damaged_are_told_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "mine.json"
    path.write_text('{"frames": [{"frame": 7, "boxes": [[1, 2, 3]]}]}')
    with pytest.raises(DataError, match=r"mine\.json: .*"):
        open_sources(path)
    with pytest.raises(DataError, match=r"none\.json: "):
        open_sources(tmp_path / "none.json")
