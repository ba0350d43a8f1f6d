"""Opening of sources and detectors."""

import pytest

from dsrc.review.sources.base import DriveSource
from dsrc.review.sources.opening import add_detectors, open_late
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
