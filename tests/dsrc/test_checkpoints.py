"""The shipped detectors are what they say, small enough to ship, and need no teacher."""

from pathlib import Path

import pytest
import torch

from dsrc.data.write import generate
from dsrc.detectors.texts import SHIPPED_DETECTOR
from dsrc.evaluation.evaluate import evaluate_drives
from dsrc.models.storage.checkpoint import load_detector, load_joined
from dsrc.options.detection import Evaluation
from sim.files import file_sha256
from studies.dsrc_paper.weights import HASHES

FOLDER = SHIPPED_DETECTOR.parent
TRAINED = dict(reversed(line.split()) for line in HASHES.read_text(encoding="utf-8").splitlines())
"""SHA-256 of the kept trainings' files by path."""


SHIPPED = {"small-dsrc": "dsrc_s0", "small-plain": "attfuse_s0", "small-dsrc-corrupted": "dsrc-corrupted_s0"}
"""Training of the campaign that each shipped detector of vehicles is."""

ROAD = [("road-dsrc", "attention", True), ("road-dsrc-alone", "none", True), ("road-plain", "attention", False)]
"""Detectors for real roads: name, fusion, and whether they were distilled."""


@pytest.mark.parametrize(("name", "training"), SHIPPED.items())
def test_a_shipped_detector_is_that_of_its_training(name: str, training: str) -> None:
    assert file_sha256(FOLDER / f"{name}.pt") == TRAINED[f"{training}/student/detector.pt"]


@pytest.mark.parametrize(("name", "switches"), [(name, name != "small-plain") for name in SHIPPED])
def test_a_shipped_detector_loads_as_a_student(name: str, switches: bool) -> None:
    path = FOLDER / f"{name}.pt"
    assert path.stat().st_size <= 8_000_000
    settings = load_detector(path).settings
    assert settings.role == "student"
    assert (settings.sdd, settings.pcp, settings.rec) == (switches,) * 3


@pytest.mark.parametrize(("name", "fusion", "distilled"), ROAD)
def test_a_detector_for_real_roads_reads_heights_above_the_ground(name: str, fusion: str, distilled: bool) -> None:
    settings = load_detector(FOLDER / f"{name}.pt").settings
    assert (settings.role, settings.height, settings.fusion) == ("student", "ground", fusion)
    assert (settings.sdd, settings.pcp, settings.rec) == (distilled,) * 3


def test_the_joined_detector_has_the_shipped_network_for_vehicles_and_one_for_other_road_users() -> None:
    joined = load_joined(FOLDER / "small-dsrc-vulnerable.pt")
    assert {"car", "pedestrian", "bicycle", "motorcycle"} <= set(joined.classes)
    vehicles, _ = joined.detectors
    alone = load_joined(SHIPPED_DETECTOR)
    assert vehicles.state_dict().keys() == alone.state_dict().keys()
    assert all(torch.equal(value, alone.state_dict()[key]) for key, value in vehicles.state_dict().items())


def test_only_shipped_detectors_lie_there() -> None:
    assert sorted(p.name for p in FOLDER.iterdir()) == [
        "README.md",
        "road-dsrc-alone.pt",
        "road-dsrc.pt",
        "road-plain.pt",
        "small-dsrc-corrupted.pt",
        "small-dsrc-vulnerable.pt",
        "small-dsrc.pt",
        "small-plain.pt",
    ]
    assert sum(p.stat().st_size for p in FOLDER.glob("*.pt")) <= 12_000_000


@pytest.mark.slow
@pytest.mark.parametrize("name", [*SHIPPED, "road-dsrc", "road-plain"])
def test_a_shipped_detector_finds_more_vehicles_on_unseen_drives_with_collaborators(
    name: str, unseen: Path, tmp_path: Path
) -> None:
    checkpoints = (str(FOLDER / f"{name}.pt"),)
    config = Evaluation(checkpoint=checkpoints, data=unseen, out=tmp_path, corruption=("clean",))
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
