"""The shipped detectors are what they say, small enough to ship, and need no teacher."""

from pathlib import Path

import pytest

from dsrc.data.generate import generate
from dsrc.demo import CHECKPOINTS
from dsrc.evaluation.benchmark import Method, run_benchmark
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


@pytest.mark.slow
@pytest.mark.parametrize("name", ["small-dsrc", "small-plain"])
def test_a_shipped_detector_finds_vehicles_on_an_unseen_drive_and_more_of_them_in_company(
    name: str, unseen: Path
) -> None:
    detector = load_detector(CHECKPOINTS / f"{name}.pt")
    methods = [Method("together", detector), Method("alone", detector, cooperative=False)]
    together, alone = run_benchmark(methods, [unseen], ("clean",), severity=3, seed=0)
    ap = "ap_bev_50"
    assert together.metrics[ap] >= 0.6
    assert together.metrics[ap] >= alone.metrics[ap] + 0.05


@pytest.fixture(scope="module")
def unseen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive of a seed that no detector has seen."""
    return generate("braunschweig", tmp_path_factory.mktemp("test"), frames=12, seed=901, interval_s=2.0)
