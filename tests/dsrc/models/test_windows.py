"""Windows hold road users, and what a network makes of them is what it makes of these places of the whole map."""

from pathlib import Path

import pytest
import torch
from msgspec.structs import replace

from dsrc.data.sample import make_sample
from dsrc.models.detector import Detector
from dsrc.models.fusion.base import AgentLayout
from dsrc.models.inputs.batch import collate
from dsrc.models.storage.checkpoint import load_detector
from dsrc.models.windows import ALIGNED, Windows
from dsrc.ops.grid import GridSpec
from dsrc.training.module import DetectionModule
from dsrc.training.recipes import Recipe
from dsrc.training.train import train
from sim.errors import SettingsError
from tests.dsrc.training.drive import frame, write_drive
from tests.dsrc.training.runs import tiny


@pytest.mark.parametrize("size", [(16, 32), (8, 8), (64, 96)])
def test_a_window_lies_in_the_map_and_has_a_positive_anchor_of_its_sample(size: tuple[int, int]) -> None:
    torch.manual_seed(0)
    positive = torch.zeros((3, 32, 48, 2), dtype=torch.bool)
    positive[0, 31, 47, 1] = positive[1, 0, 0, 0] = positive[1, 20, 30, 0] = True
    held = set()
    for _ in range(40):
        windows = Windows.around(positive, size, 2)
        for row, column in windows.low:
            assert row % ALIGNED == column % ALIGNED == 0
            assert 0 <= row <= 64 - size[0] and 0 <= column <= 96 - size[1]
        inside = windows.of_samples(positive, 2)
        assert inside.shape == (3, size[0] // 2, size[1] // 2, 2)
        assert inside.flatten(1).any(1).tolist() == [True, True, False]
        held.add(windows.low[1])
    assert len(held) > 1 or size == (64, 96)


def test_a_window_of_the_agents_is_that_of_their_sample() -> None:
    maps = torch.arange(3 * 16 * 24).reshape(3, 1, 16, 24)
    windows = Windows(((8, 0), (0, 16)), (8, 8))
    found = windows.of_agents(maps, AgentLayout((2, 1)))
    expected = [maps[0, :, 8:16, :8], maps[1, :, 8:16, :8], maps[2, :, :8, 16:24]]
    assert torch.equal(found, torch.stack(expected))


def plain(**changes: object) -> Recipe:
    recipe = tiny(**changes)
    return replace(recipe, model=replace(recipe.model, sdd=False, pcp=False, rec=False))


def test_a_network_makes_of_a_window_what_one_of_that_range_makes_of_its_points() -> None:
    settings = plain().model
    torch.manual_seed(1)
    whole = Detector(settings).eval()
    x, y, z, *_, top = settings.grid.range_m
    part = replace(settings, grid=GridSpec(range_m=(x + 9.6, y + 6.4, z, x + 9.6 + 25.6, y + 6.4 + 12.8, top)))
    of_part = Detector(part).eval()
    of_part.load_state_dict(whole.state_dict())
    sample = make_sample(frame(0), 1000, settings.grid)
    batches = [collate([sample], each, training=True) for each in (settings, part)]
    windows = Windows(((16, 24),), (32, 64))
    with torch.no_grad():
        found = whole(batches[0].student, batches[0].layout, windows)
        expected = of_part(batches[1].student, batches[1].layout)
        everything = whole(batches[0].student, batches[0].layout, Windows(((0, 0),), (64, 128)))
        usual = whole(batches[0].student, batches[0].layout)
    assert torch.allclose(found.cls, expected.cls, atol=1e-5) and torch.allclose(found.reg, expected.reg, atol=1e-5)
    assert torch.equal(everything.cls, usual.cls)
    anchors = [network.anchors[..., :2] for network in (whole, of_part)]
    inside = windows.of_samples(torch.from_numpy(anchors[0][None]), 2)[0].numpy()
    assert inside == pytest.approx(anchors[1])


def test_a_training_on_windows_is_the_same_twice_and_differs_from_one_on_the_map(tmp_path: Path) -> None:
    data = tmp_path / "data"
    for number in range(2):
        write_drive(data / f"drive_{number}", 4)
    states = []
    for name, window_m in (("one", (25.6, 12.8)), ("other", (25.6, 12.8)), ("map", None)):
        path = train(plain(epochs=1, validate_every=1, window_m=window_m), data, tmp_path / name, "student")
        states.append(load_detector(path).state_dict())
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])
    assert not all(torch.equal(states[0][name], states[2][name]) for name in states[0])


def test_a_window_that_the_network_cannot_have_is_refused() -> None:
    with pytest.raises(
        ValueError, match=r"window_m: expected multiples of 3.2 m of at most 51.2 x 25.6, found 5 x 6.4"
    ):
        plain(window_m=(5.0, 6.4))
    with pytest.raises(ValueError, match=r"found 51\.2 x 51\.2"):
        plain(window_m=(51.2, 51.2))
    recipe = tiny(window_m=(25.6, 12.8))
    with pytest.raises(SettingsError, match="window_m: expected none with a teacher"):
        DetectionModule(recipe, Detector(recipe.model))
