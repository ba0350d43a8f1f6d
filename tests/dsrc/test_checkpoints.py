"""The shipped detectors are what they say, small enough to ship, and need no teacher."""

from pathlib import Path

import pytest

from dsrc.closed_loop.perception.open import SHIPPED_DETECTOR
from dsrc.data.write import generate
from dsrc.evaluation.evaluate import evaluate_drives
from dsrc.models.storage.checkpoint import load_detector
from dsrc.options.detection import Evaluation

FOLDER = SHIPPED_DETECTOR.parent


@pytest.mark.parametrize(("name", "switches"), [("small-dsrc", True), ("small-plain", False)])
def test_a_shipped_detector_loads_as_a_student(name: str, switches: bool) -> None:
    path = FOLDER / f"{name}.pt"
    assert path.stat().st_size <= 8_000_000
    settings = load_detector(path).settings
    assert settings.role == "student"
    assert (settings.sdd, settings.pcp, settings.rec) == (switches,) * 3


def test_only_shipped_detectors_lie_there() -> None:
    assert sorted(p.name for p in FOLDER.iterdir()) == ["README.md", "small-dsrc.pt", "small-plain.pt"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["small-dsrc", "small-plain"])
def test_a_shipped_detector_finds_more_vehicles_on_unseen_drives_with_collaborators(
    name: str, unseen: Path, tmp_path: Path
) -> None:
    checkpoints = (str(FOLDER / f"{name}.pt"),)
    config = Evaluation(checkpoints=checkpoints, data=unseen, out=tmp_path, corruptions=("clean",))
    together, alone = evaluate_drives(config)
    ap = "ap_bev_50"
    assert together.metrics[ap] >= 0.6
    assert together.metrics[ap] >= alone.metrics[ap] + 0.05


@pytest.fixture(scope="module")
def unseen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Drives of seeds that no detector has seen; one alone may stand in a queue all the time."""
    out = tmp_path_factory.mktemp("test")
    for seed in (901, 902, 903):
        generate("braunschweig", out, frames=6, seed=seed, interval_s=4.0)
    return out
