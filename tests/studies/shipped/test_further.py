from pathlib import Path

import pytest
import torch

from dsrc.data.datasets.spec import expand, read_dataset
from dsrc.models.storage.checkpoint import load_detector, read_meta, save_detector
from studies.shipped.further import START, further, mean
from studies.shipped.train import BATCH
from tests.paths import ROOT


def test_half_of_its_frames_are_level() -> None:
    path = ROOT / "studies/shipped/further.toml"
    specs = [item.spec for item in expand(read_dataset(path), path)]
    frames = {world: sum(one.frames for one in specs if one.scenario.world == world) for world in (1, 2)}
    assert frames == {1: 196, 2: 196}


def test_it_has_its_steps_and_a_teacher() -> None:
    run = further(300)
    recipe = run.recipe()
    assert recipe.epoch_frames is not None and recipe.epochs * recipe.epoch_frames == BATCH * 300
    assert run.teacher and run.recipe().model.height == "ground"


@pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
def test_a_mean_lies_between_its_networks(share: float, tmp_path: Path) -> None:
    first, second, out = ROOT / START, tmp_path / "second.pt", tmp_path / "mean.pt"
    detector = load_detector(first)
    before = {name: tensor.clone() for name, tensor in detector.state_dict().items()}
    with torch.no_grad():
        for weight in detector.parameters():
            weight.add_(1.0)
    save_detector(second, detector, {"seed": 3, "metrics": {"ap": 1.0}})
    mean(first, second, share, out)
    between = load_detector(out).state_dict()
    for name, _ in detector.named_parameters():
        # Half precision, in which detectors are stored.
        torch.testing.assert_close(between[name], before[name] + share, rtol=2e-3, atol=2e-3)
    assert read_meta(out) == {"seed": 3, "mean_with": START.name, "share_of_trained": share}
