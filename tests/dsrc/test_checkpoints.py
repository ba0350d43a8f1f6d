"""The shipped detectors are what they say, small enough to ship, and need no teacher."""

from pathlib import Path

import pytest

from dsrc.closed_loop.perception.open import SHIPPED_DETECTOR
from dsrc.data.write import generate
from dsrc.evaluation.evaluate import evaluate_drives
from dsrc.models.storage.checkpoint import join_files, load_detector, load_joined
from dsrc.options.detection import Evaluation

FOLDER = SHIPPED_DETECTOR.parent
DOCS = Path(__file__).parents[2] / "docs"
KEPT = DOCS / "results" / "dsrc-sim-small" / "kept"
DRIVEN = DOCS / "closed_loop" / "detectors"


SHIPPED = {"small-dsrc": "dsrc_s0", "small-plain": "attfuse_s0", "small-dsrc-corrupted": "dsrc-corrupted_s0"}
"""Training of the campaign that each shipped detector of vehicles is."""


@pytest.mark.parametrize(("name", "training"), SHIPPED.items())
def test_a_shipped_detector_is_that_of_its_training(name: str, training: str) -> None:
    assert (FOLDER / f"{name}.pt").read_bytes() == (KEPT / training / "student/detector.pt").read_bytes()


@pytest.mark.parametrize(("name", "switches"), [(name, name != "small-plain") for name in SHIPPED])
def test_a_shipped_detector_loads_as_a_student(name: str, switches: bool) -> None:
    path = FOLDER / f"{name}.pt"
    assert path.stat().st_size <= 8_000_000
    settings = load_detector(path).settings
    assert settings.role == "student"
    assert (settings.sdd, settings.pcp, settings.rec) == (switches,) * 3


@pytest.mark.parametrize(
    ("joined", "vehicles", "others"),
    [
        (FOLDER / "small-dsrc-vulnerable.pt", SHIPPED_DETECTOR, "vulnerable"),
        (DRIVEN / "single-vulnerable.pt", KEPT / "single_s0/student/detector.pt", "vulnerable-alone"),
    ],
    ids=lambda value: value.stem if isinstance(value, Path) else value,
)
def test_joined_detectors_are_those_of_vehicles_and_the_kept_networks_of_pedestrians(
    joined: Path, vehicles: Path, others: str, tmp_path: Path
) -> None:
    join_files([vehicles, KEPT / others / "student" / "detector.pt"], tmp_path / "joined.pt")
    assert joined.read_bytes() == (tmp_path / "joined.pt").read_bytes()
    assert {"car", "pedestrian", "bicycle", "motorcycle"} <= set(load_joined(joined).classes)


def test_only_shipped_detectors_lie_there() -> None:
    assert sorted(p.name for p in FOLDER.iterdir()) == [
        "README.md",
        "small-dsrc-corrupted.pt",
        "small-dsrc-vulnerable.pt",
        "small-dsrc.pt",
        "small-plain.pt",
    ]
    assert sum(p.stat().st_size for p in FOLDER.glob("*.pt")) <= 12_000_000


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
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
