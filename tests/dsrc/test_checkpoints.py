"""The shipped detectors are what they say, small enough to ship, and need no teacher."""

from pathlib import Path

import pytest

from dsrc.demo import CHECKPOINTS
from dsrc.models.checkpoint import load_detector


@pytest.mark.parametrize(("name", "switches"), [("small-dsrc", True), ("small-plain", False)])
def test_a_shipped_detector_loads_as_a_student(name: str, switches: bool) -> None:
    path = CHECKPOINTS / f"{name}.pt"
    assert path.stat().st_size <= 8_000_000
    settings = load_detector(path).settings
    assert settings.role == "student"
    assert (settings.sdd, settings.pcp, settings.rec) == (switches,) * 3


def test_only_shipped_detectors_lie_there() -> None:
    assert sorted(p.name for p in Path(CHECKPOINTS).iterdir()) == ["README.md", "small-dsrc.pt", "small-plain.pt"]
